"""Read ``sensor_msgs/PointCloud2`` of any field layout."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

#: Datatypes of sensor_msgs/PointField by number.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
#: Names that drivers use for intensity and for the time of a point, the most common first.
_INTENSITY = ("intensity", "intensities", "reflectivity", "i")
_TIME = ("t", "time", "timestamp", "time_stamp", "offset_time", "timeOffset")
#: A larger time counts from 1970, not from the scan's stamp; seconds.
_ABSOLUTE_S = 1e6


def points_of_cloud(
    message: Any, *, stamp_s: float, max_points: int
) -> tuple[Float32[NDArray[np.float32], "N 4"], Float64[NDArray[np.float64], " N"] | None] | str:
    """Read the points of a message and their times, or say why the message is no scan.

    Integer times are nanoseconds (Ouster, Livox), floating-point times are seconds (Velodyne, Hesai). A time since 1970 is
    converted to a time relative to the stamp.

    Args:
        message: sensor_msgs/PointCloud2, of ROS 1 or 2.
        stamp_s: stamp of the message, seconds.
        max_points: a larger scan is refused.

    Returns:
        x y z and intensity (N, 4), and times relative to the stamp, seconds (N,), or None without times; or the reason.
    """
    count = int(message.width) * int(message.height)
    if count == 0:
        return "no points"
    if count > max_points:
        return f"more than {max_points} points"
    fields = {field.name: field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        return f"its fields have no {', '.join(missing)} (they are: {', '.join(fields) or 'none'})"
    intensity = next((name for name in _INTENSITY if name in fields), None)
    time = next((name for name in _TIME if name in fields), None)
    used = [fields[name] for name in ("x", "y", "z", intensity, time) if name is not None]
    unknown = [field.name for field in used if field.datatype not in _TYPES]
    if unknown:
        return f"unknown datatype of field {unknown[0]}"
    rows = _rows(message, used)
    if isinstance(rows, str):
        return rows
    points = np.zeros((count, 4), np.float32)
    for column, name in enumerate(("x", "y", "z", intensity)):
        if name is not None:
            points[:, column] = rows[name].reshape(-1)
    return points, None if time is None else _offsets(rows[time].reshape(-1), stamp_s)


def _rows(message: Any, used: Sequence[Any]) -> NDArray[Any] | str:
    """View the message's bytes as records of the used fields (height, width), without a copy of the padding."""
    order = ">" if message.is_bigendian else "<"
    step, row_step = int(message.point_step), int(message.row_step)
    ends = [field.offset + int(_TYPES[field.datatype][1]) * max(1, field.count) for field in used]
    if step < max(ends) or row_step < step * message.width:
        return (
            f"its point_step of {step} bytes is too small for its fields, or its row_step is too small for its points"
        )
    if len(message.data) < row_step * message.height:
        return "its data have fewer bytes than row_step times height: truncated"
    dtype = np.dtype(
        {
            "names": [field.name for field in used],
            "formats": [order + _TYPES[field.datatype] for field in used],
            "offsets": [field.offset for field in used],
            "itemsize": step,
        }
    )
    shape = (int(message.height), int(message.width))
    return np.ndarray(shape, dtype, np.ascontiguousarray(message.data).data, strides=(row_step, step))


def _offsets(times: NDArray[Any], stamp_s: float) -> Float64[NDArray[np.float64], " N"]:
    seconds = times.astype(np.float64) * (1e-9 if times.dtype.kind in "iu" else 1.0)
    if np.abs(seconds).max(initial=0.0) > 1e15:  # nanoseconds since 1970 as a floating-point number
        seconds = seconds * 1e-9
    return seconds - stamp_s if np.abs(seconds).max(initial=0.0) > _ABSOLUTE_S else seconds
