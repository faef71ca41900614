"""KITTI-360's layout: ``data_2d_raw``, ``data_3d_raw``, ``data_poses`` and ``calibration`` side by side.

Each of the first three has one folder per drive. Source: Liao et al., KITTI-360, TPAMI 2022.
Images are those of the rectified perspective pair, ``image_00`` and ``image_01``. Poses exist only for times at which the
vehicle moved. Scans are not compensated for the vehicle's motion.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.files import read_bytes
from model_training.importing.kitti_calibration import KittiCalibration, calibration_from, read_matrices
from model_training.importing.kitti_folders import above, below, wrong_folder
from model_training.importing.kitti_sequence import RATE_HZ, KittiDepth, KittiFrame, KittiSequence, numbered
from model_training.importing.kitti_times import stamps_of, turn_of
from model_training.importing.trajectory import Trajectory
from service.errors import DatasetError
from service.geometry.rigid import Transform, inverse, transform_from

_PICTURES = (".png", ".jpg")
_PARTS = ("data_3d_raw", "data_2d_raw", "data_poses")


def open_kitti_360(source: Path, *, depth: KittiDepth) -> KittiSequence:
    """Open a drive.

    The stamp of a scan is the time at which the laser faces forward. The times of its points follow from their azimuths.

    Args:
        source: the drive's folder in ``data_3d_raw``, ``data_2d_raw`` or ``data_poses``.
        depth: source of an image's depth; this layout has no stored depth.

    Raises:
        DatasetError: there is no scan or no calibration, or one of their files is broken.
    """
    source = source.absolute()  # do not resolve a link to the drive's folder: the other trees lie beside the link
    root, name = source.parent.parent, source.name
    scans_of = root / "data_3d_raw" / name / "velodyne_points"
    pictures = root / "data_2d_raw" / name
    scans = numbered(scans_of / "data", (".bin",))
    if not scans:
        wanted, otherwise = f"the folder of one drive in {', '.join(_PARTS)}", f"{scans_of}/data has no scan"
        raise wrong_folder(source, wanted, _drives_near(source), otherwise)
    left, right = (numbered(pictures / f"image_{eye}" / "data_rect", _PICTURES) for eye in ("00", "01"))
    calibration = _calibration(root / "calibration")
    numbers = sorted(scans.keys() | left.keys())
    times = scans_of / "timestamps.txt"
    stamps = stamps_of(times, numbers) or {n: n / RATE_HZ for n in numbers}
    frames = tuple(KittiFrame(f"{n:010d}", stamps[n], scans.get(n), left.get(n), right.get(n), None) for n in numbers)
    poses = _poses(root / "data_poses" / name / "poses.txt", stamps, root / "calibration")
    return KittiSequence("kitti-360", source, frames, calibration, depth, poses, turn_s=turn_of(times))


def _drives_near(source: Path) -> list[Path]:
    """Drives with scans below a folder, above it, or in the tree of scans beside it."""

    def is_drive(folder: Path) -> bool:
        return folder.parent.name == _PARTS[0] and (folder / "velodyne_points").is_dir()

    beside = source.parent / _PARTS[0] if source.name in _PARTS else source
    return (
        below(source, "velodyne_points", is_drive)
        or below(beside, "velodyne_points", is_drive)
        or above(source, is_drive)
    )


def _calibration(folder: Path) -> KittiCalibration:
    """Calibration of the left perspective camera."""
    path = folder / "perspective.txt"
    found = read_matrices(
        path, {"P_rect_00": (3, 4), "P_rect_01": (3, 4), "R_rect_00": (3, 3)}, optional=frozenset({"P_rect_01"})
    )
    Tr = inverse(_T_lidar_cam0(folder))[:3]
    return calibration_from(path, P2=found["P_rect_00"], P3=found.get("P_rect_01"), R0=found["R_rect_00"], Tr=Tr)


def _mounting(folder: Path) -> Transform:
    """T_pose_lidar: the poses are those of the inertial system."""
    path = folder / "calib_cam_to_pose.txt"
    rows = read_matrices(path, {"image_00": (3, 4)})["image_00"]
    return _rigid(rows, f"{path}: image_00", path.name) @ inverse(_T_lidar_cam0(folder))


def _T_lidar_cam0(folder: Path) -> Transform:
    """Pose of the left camera before rectification."""
    path = folder / "calib_cam_to_velo.txt"
    try:
        rows = np.array(read_bytes(path).decode("ascii").split(), np.float64).reshape(3, 4)
    except (ValueError, UnicodeDecodeError) as error:
        raise DatasetError(
            f"{path}: not the 12 numbers of a transform; copy the file from the recording again", field=path.name
        ) from error
    return _rigid(rows, str(path), path.name)


def _rigid(rows: NDArray[np.float64], where: str, field: str) -> Transform:
    """Convert rows (3, 4) to a transform.

    Raises:
        DatasetError: they are not finite, or their first three columns are no rotation.
    """
    R = rows[:, :3]
    if not np.isfinite(rows).all() or not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
        raise DatasetError(
            f"{where}: not a rotation and a position; copy the file from the recording again", field=field
        )
    return transform_from(R, rows[:, 3])


def _poses(path: Path, stamps: dict[int, float], calibration: Path) -> Trajectory | None:
    """T_map_lidar at the times that have a frame; None if there is no such time."""
    if not path.is_file():
        return None
    T_pose_lidar = _mounting(calibration)
    poses, times = [], []
    for number, line in enumerate(read_bytes(path).decode("ascii", errors="replace").rstrip().splitlines(), 1):
        try:
            frame, *values = line.split()
            rows = np.array(values, np.float64).reshape(3, 4)
            stamp = stamps.get(int(frame))
        except ValueError as error:
            raise DatasetError(
                f"{path}, line {number}: not a frame's number and the 12 numbers of its pose", field=path.name
            ) from error
        if stamp is not None:
            poses.append(_rigid(rows, f"{path}, line {number}", path.name) @ T_pose_lidar)
            times.append(stamp)
    if not poses:
        return None
    return Trajectory(np.array(times), np.array(poses).reshape(-1, 4, 4), str(path))
