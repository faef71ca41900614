"""KITTI's odometry layout: ``sequences/NN/{velodyne,image_2,image_3,calib.txt,times.txt}`` and ``poses/NN.txt``.

Without a colour pair the grey pair is used (``image_0``, ``image_1``).
"""

from pathlib import Path

import numpy as np

from model_training.datasets.files import read_bytes
from model_training.importing.kitti_calibration import KittiCalibration, calibration_from, read_matrices
from model_training.importing.kitti_folders import above, below, wrong_folder
from model_training.importing.kitti_sequence import RATE_HZ, KittiDepth, KittiFrame, KittiSequence, numbered
from model_training.importing.spinning import KITTI_VERTICAL_DEG
from model_training.importing.trajectory import Trajectory
from service.errors import DatasetError
from service.geometry.rigid import inverse, transform_from

#: Left and right camera: the colour pair is preferred to the grey one.
_PAIRS = (("2", "3"), ("0", "1"))


def open_kitti_odometry(source: Path, *, depth: KittiDepth, vertical_deg: float = KITTI_VERTICAL_DEG) -> KittiSequence:
    """Open a sequence. Its scans are already compensated for the vehicle's motion, so points get no times.

    Args:
        source: its folder, ``.../sequences/NN``.
        depth: source of an image's depth.
        vertical_deg: rotation upwards of every point, degrees.

    Raises:
        DatasetError: a scan, the calibration or a time is missing or broken.
    """
    scans = numbered(source / "velodyne", (".bin",))
    if not scans:
        sequences = below(source, "velodyne", _is_sequence) or above(source, _is_sequence)
        raise wrong_folder(
            source,
            "the folder of one sequence, for example sequences/00 with velodyne/*.bin",
            sequences,
            "no scans found",
        )
    eyes = next((pair for pair in _PAIRS if (source / f"image_{pair[0]}").is_dir()), _PAIRS[0])
    left, right = (numbered(source / f"image_{eye}", (".png", ".jpg")) for eye in eyes)
    stored = numbered(source / f"depth_{eyes[0]}", (".png",))
    calibration, T_lidar_cam0 = _calibration(source / "calib.txt", *eyes)
    numbers = sorted(scans.keys() | left.keys())
    stamps = _times(source / "times.txt", numbers[-1])
    frames = tuple(
        KittiFrame(f"{n:06d}", stamps[n], scans.get(n), left.get(n), right.get(n), stored.get(n)) for n in numbers
    )
    poses = _poses(source.parent.parent / "poses" / f"{source.name}.txt", stamps, T_lidar_cam0)
    return KittiSequence("kitti-odometry", source, frames, calibration, depth, poses, vertical_deg=vertical_deg)


def _is_sequence(folder: Path) -> bool:
    """Whether a folder is a sequence. KITTI's object layout also has a folder ``velodyne``, but no ``calib.txt``."""
    return (folder / "velodyne").is_dir() and (folder.parent.name == "sequences" or (folder / "calib.txt").is_file())


def _calibration(path: Path, left: str, right: str) -> tuple[KittiCalibration, np.ndarray]:
    P2, P3 = f"P{left}", f"P{right}"
    found = read_matrices(path, {P2: (3, 4), P3: (3, 4), "Tr": (3, 4)}, optional=frozenset({P3}))
    calibration = calibration_from(path, P2=found[P2], P3=found.get(P3), R0=np.eye(3), Tr=found["Tr"])
    return calibration, inverse(transform_from(found["Tr"][:, :3], found["Tr"][:, 3]))


def _times(path: Path, last: int) -> list[float]:
    """Seconds of every frame; at ``RATE_HZ`` if the file is missing."""
    if not path.is_file():
        return [n / RATE_HZ for n in range(last + 1)]
    try:
        times = [float(line) for line in read_bytes(path).decode("ascii").split()]
    except ValueError as error:
        raise DatasetError(
            f"{path}: not one number per line: {error}; write the seconds of one frame per line, or remove the file "
            f"to use {RATE_HZ:g} frames/s",
            field=path.name,
        ) from error
    if len(times) <= last:
        raise DatasetError(
            f"{path} has {len(times)} times, but there is a frame {last:06d}; add the missing lines, or remove the file "
            f"to use {RATE_HZ:g} frames/s",
            field=path.name,
        )
    return times


def _poses(path: Path, stamps: list[float], T_lidar_cam0: np.ndarray) -> Trajectory | None:
    """T_map_lidar. The map frame is the LiDAR frame of the first scan: it is level and z is up, unlike camera 0's frame."""
    if not path.is_file():
        return None
    poses, times = [], []
    for number, line in enumerate(read_bytes(path).decode("ascii", errors="replace").splitlines()):
        try:
            values = np.array(line.split(), np.float64).reshape(3, 4)
        except ValueError as error:
            raise DatasetError(
                f"{path}, line {number + 1}: not the 12 numbers of a pose: {line[:60]!r}; write the 3 x 4 matrix "
                "T_world_cam0 row by row, or remove the file to import without poses",
                field=path.name,
            ) from error
        if number < len(stamps):
            poses.append(T_lidar_cam0 @ transform_from(values[:, :3], values[:, 3]) @ inverse(T_lidar_cam0))
            times.append(stamps[number])
    return Trajectory(np.array(times), np.array(poses).reshape(-1, 4, 4), str(path))
