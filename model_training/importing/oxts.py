"""Poses from KITTI's inertial system (OXTS): latitude, longitude, altitude, roll, pitch and yaw of every packet."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.errors import DatasetError
from service.geometry.earth import Georeference
from service.geometry.rigid import rotation_x, rotation_y, rotation_z, transform_from


def read_oxts(files: Sequence[Path]) -> tuple[Float64[NDArray[np.float64], "N 4 4"], dict[str, Any]]:
    """Read T_map_imu of every packet, and the georeference of the map frame.

    The map frame is east, north, up at the first packet. Yaw is 0 to the east and counter-clockwise. Roll and pitch rotate
    about the forward and the left axis (KITTI's description of the format).

    Args:
        files: packets in order of time, at least one.

    Returns:
        Poses (N, 4, 4), and the georeference of the map's origin as in ``dataset.json``.

    Raises:
        DatasetError: a packet is cut off or no place on the Earth; the error names the file.
    """
    rows = [_packet(path) for path in files]
    latitude_deg, longitude_deg, height_m = (float(x) for x in rows[0][:3])
    origin = _georeference(files[0], latitude_deg, longitude_deg, height_m)
    poses = [
        transform_from(
            rotation_z(float(row[5])) @ rotation_y(float(row[4])) @ rotation_x(float(row[3])),
            origin.to_map(*(float(x) for x in row[:3])),
        )
        for row in rows
    ]
    reference = {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg, "height_m": height_m}
    return np.stack(poses), reference


def _packet(path: Path) -> NDArray[np.float64]:
    try:
        values = np.array(path.read_text(encoding="ascii").split()[:6], np.float64)
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"{path}: not a packet of the inertial system: {error}; copy the file again from KITTI's download",
            field=path.name,
        ) from error
    if len(values) < 6 or not np.isfinite(values).all():
        raise DatasetError(
            f"{path}: expected latitude, longitude, altitude, roll, pitch and yaw; the packet has {len(values)} of 6 "
            "numbers, or one is not finite. Copy the file again from KITTI's download",
            field=path.name,
        )
    return values


def _georeference(path: Path, latitude_deg: float, longitude_deg: float, height_m: float) -> Georeference:
    try:
        return Georeference(latitude_deg, longitude_deg, height_m)
    except ValueError as error:
        raise DatasetError(f"{path}: {error}", field=path.name) from error
