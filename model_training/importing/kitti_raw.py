"""KITTI's raw layout: ``DATE/DATE_drive_NNNN_sync/{velodyne_points,image_02,image_03,oxts}`` and the day's calibration.

All files of one frame have the same number. An extract may lack some files. Without a colour pair the grey pair is used
(``image_00``, ``image_01``). Stored depth is that of KITTI's depth benchmark, ``proj_depth/groundtruth/image_02``.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.layouts import SCANS_AT_REST
from model_training.importing.kitti_calibration import KittiCalibration, calibration_from, read_matrices
from model_training.importing.kitti_folders import above, below, wrong_folder
from model_training.importing.kitti_sequence import RATE_HZ, KittiDepth, KittiFrame, KittiSequence, numbered
from model_training.importing.kitti_times import stamps_of, turn_of
from model_training.importing.oxts import read_oxts
from model_training.importing.spinning import KITTI_VERTICAL_DEG
from model_training.importing.trajectory import Trajectory
from service.errors import DatasetError
from service.geometry.rigid import Transform, transform_from

_PICTURES = (".png", ".jpg")
#: Left and right camera: the colour pair is preferred to the grey one.
_PAIRS = (("02", "03"), ("00", "01"))


def open_kitti_raw(source: Path, *, depth: KittiDepth, vertical_deg: float = KITTI_VERTICAL_DEG) -> KittiSequence:
    """Open a drive.

    The stamp of a scan is the time at which the laser faces forward. The times of its points follow from their azimuths.
    In a drive that ``streetfix convert`` wrote, each scan was measured at one time. The file ``SCANS_AT_REST`` marks that.

    Args:
        source: the drive's folder, or the day's folder with a single drive in it.
        depth: source of an image's depth.
        vertical_deg: rotation upwards of every point, degrees.

    Raises:
        DatasetError: there is no drive, no scan, or no calibration.
    """
    drive = _drive(source)
    eyes = next((pair for pair in _PAIRS if (drive / f"image_{pair[0]}" / "data").is_dir()), _PAIRS[0])
    calibration = _calibration(drive, *eyes)
    scans = numbered(drive / "velodyne_points" / "data", (".bin",))
    left, right = (numbered(drive / f"image_{eye}" / "data", _PICTURES) for eye in eyes)
    stored = numbered(drive / "proj_depth" / "groundtruth" / f"image_{eyes[0]}", (".png",))
    if not scans:
        raise DatasetError(f"{drive}/velodyne_points/data has no scan; add the scans", field="velodyne_points")
    numbers = sorted(scans.keys() | left.keys())
    times = drive / "velodyne_points" / "timestamps.txt"
    stamps = stamps_of(times, numbers) or {n: n / RATE_HZ for n in numbers}
    at_rest = (drive / SCANS_AT_REST).is_file()
    frames = tuple(
        KittiFrame(f"{n:010d}", stamps[n], scans.get(n), left.get(n), right.get(n), stored.get(n)) for n in numbers
    )
    poses, georeference = _poses(drive)
    return KittiSequence(
        "kitti-raw",
        drive,
        frames,
        calibration,
        depth,
        poses,
        georeference,
        turn_s=None if at_rest else turn_of(times),
        vertical_deg=0.0 if at_rest else vertical_deg,
    )


def _drive(source: Path) -> Path:
    if (source / "velodyne_points").is_dir():
        return source
    drives = below(source, "velodyne_points")
    if len(drives) == 1 and drives[0].parent == source:
        return drives[0]
    drives = drives or above(source, lambda folder: (folder / "velodyne_points").is_dir())
    raise wrong_folder(
        source,
        "the folder of one drive, for example 2011_09_26_drive_0005_sync with velodyne_points",
        drives,
        "no drives found",
    )


def _calibration(drive: Path, left: str, right: str) -> KittiCalibration:
    cameras = _calibration_file(drive, "calib_cam_to_cam.txt")
    Tr = _rigid(_calibration_file(drive, "calib_velo_to_cam.txt"))
    P2, P3 = f"P_rect_{left}", f"P_rect_{right}"
    found = read_matrices(cameras, {"R_rect_00": (3, 3), P2: (3, 4), P3: (3, 4)}, optional=frozenset({P3}))
    return calibration_from(cameras, P2=found[P2], P3=found.get(P3), R0=found["R_rect_00"], Tr=Tr[:3])


def _calibration_file(drive: Path, name: str) -> Path:
    """Find a calibration file of the day: in the drive's folder, beside it, or in a folder ``calib`` in either.

    Raises:
        DatasetError: it is in none of them.
    """
    places = [drive, drive / "calib", drive.parent, drive.parent / "calib"]
    found = next((folder / name for folder in places if (folder / name).is_file()), None)
    if found is None:
        raise DatasetError(
            f"{drive}: {name} not found, neither in the folder of the drive nor next to it; put the "
            "calibration of that day there (KITTI's DATE_calib.zip)",
            field=name,
        )
    return found


def _rigid(path: Path) -> Transform:
    """Read a transform from a file with R and T."""
    found = read_matrices(path, {"R": (3, 3), "T": (3,)})
    return transform_from(found["R"], found["T"])


def _poses(drive: Path) -> tuple[Trajectory | None, dict[str, Any] | None]:
    """T_map_lidar and georeference from the inertial system, if it was recorded."""
    files = numbered(drive / "oxts" / "data", (".txt",))
    if not files:
        return None, None
    stamps = stamps_of(drive / "oxts" / "timestamps.txt", sorted(files)) or {n: n / RATE_HZ for n in files}
    T_lidar_imu = _rigid(_calibration_file(drive, "calib_imu_to_velo.txt"))
    T_map_imu, georeference = read_oxts([files[n] for n in sorted(files)])
    at: NDArray[np.float64] = np.array([stamps[n] for n in sorted(files)])
    return Trajectory(at, T_map_imu, str(drive / "oxts")).moved_by(T_lidar_imu), georeference
