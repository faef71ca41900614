"""Read one scan from its own file: PCD, PLY, LAS, LAZ, or KITTI's rows of float32."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from model_training.datasets.files import size_of, unreadable
from model_training.importing.scan_file import read_scan

Points = Float32[NDArray[np.float32], "N 4"]
_INTENSITY = ("intensity", "Intensity", "I", "i", "reflectivity", "scalar_Intensity", "scalar_intensity")
#: Greatest coordinate of a scan, metres. Larger ones belong to a map, and float32 is too coarse for them.
_FARTHEST_M = 20_000.0
#: Greatest size of a file that is read.
MAX_BYTES = 1 << 30


def read_cloud(path: Path, *, max_points: int = 5_000_000) -> Points | str:
    """Read the points of a scan, or say why the file is none.

    Args:
        path: of the file; its suffix gives the format.
        max_points: a larger scan is refused.

    Returns:
        x y z in metres, as in the file, and intensity (N, 4); or the reason.

    Raises:
        DatasetError: the file is missing or cannot be read.
    """
    if path.suffix.lower() == ".bin":
        return read_scan(path, max_points=max_points)
    if size_of(path) > MAX_BYTES:
        return f"more than {MAX_BYTES >> 20} MiB"
    try:
        columns = _READERS[path.suffix.lower()](path, max_points)
    except ModuleNotFoundError:
        raise
    except OSError as error:
        if error.errno is not None:  # the system's error; a package's error about the content has no errno
            raise unreadable(path, error) from error
        return f"cannot be read as {path.suffix[1:].upper()}: {type(error).__name__}"
    except Exception as error:  # three packages and NumPy raise errors without a common base on damaged files
        return f"cannot be read as {path.suffix[1:].upper()}: {type(error).__name__}"
    if isinstance(columns, str):
        return columns
    if len(columns) > max_points:
        return f"more than {max_points} points"
    if not len(columns):
        return "no points"
    away = np.abs(columns[:, :3])
    if away.max(initial=0.0, where=np.isfinite(away)) > _FARTHEST_M:
        return (
            f"its points are more than {_FARTHEST_M / 1000:g} km away: expected a scan in the frame of its LiDAR, not "
            "of a map"
        )
    return columns


def _pcd(path: Path, max_points: int) -> Points | str:
    from pypcd4.pypcd4 import PointCloud

    del max_points  # the size of the file was checked, and it is close to the size in memory
    cloud = PointCloud.from_path(path)
    return _columns(cloud.fields, lambda name: cloud.numpy((name,))[:, 0])


def _ply(path: Path, max_points: int) -> Points | str:
    from plyfile import PlyData

    del max_points
    vertices = PlyData.read(str(path))["vertex"].data
    return _columns(vertices.dtype.names, lambda name: vertices[name])


def _las(path: Path, max_points: int) -> Points | str:
    import laspy

    with laspy.open(path) as file:
        if file.header.point_count > max_points:  # LAZ is compressed: its size does not bound the points
            return f"more than {max_points} points"
        cloud = file.read()
    xyz = np.asarray(cloud.xyz)
    return np.asarray(np.c_[xyz, np.asarray(cloud.intensity)], np.float32)


def _columns(names: Sequence[str], column: Callable[[str], Any]) -> Points | str:
    missing = [name for name in "xyz" if name not in names]
    if missing:
        return f"its fields have no {', '.join(missing)} (they are: {', '.join(names)})"
    intensity = next((name for name in _INTENSITY if name in names), None)
    chosen = [np.asarray(column(name), np.float32) for name in "xyz"]
    chosen.append(np.zeros_like(chosen[0]) if intensity is None else np.asarray(column(intensity), np.float32))
    return np.stack(chosen, axis=1)


_READERS: dict[str, Callable[[Path, int], Points | str]] = {".pcd": _pcd, ".ply": _ply, ".las": _las, ".laz": _las}
#: Suffixes of the formats that ``read_cloud`` reads.
SUFFIXES = (".bin", *_READERS)
