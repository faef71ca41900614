"""Write a dataset in KITTI's raw layout.

Scans and images are numbered. Depth has the format of KITTI's depth benchmark. Poses are in a TUM file.
"""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from model_training.datasets.dataset import CameraSensor, Dataset, write_tum
from model_training.datasets.layouts import SCANS_AT_REST
from model_training.datasets.png import write_png
from model_training.datasets.whole_folder import whole_or_not_at_all
from model_training.exporting.moments import Moment, T_vehicle_camera, T_vehicle_lidar, moments, single_camera
from service.geometry.rigid import Transform, inverse

#: Names of the day's folder, of the drive's folder in it, and of the file of poses in that.
DAY, DRIVE, POSES = "2000_01_01", "2000_01_01_drive_0001_sync", "poses.txt"
#: KITTI stores depth as metres x 256: steps of 4 mm.
_STEPS_PER_M = 256


def write_kitti_raw(dataset: Dataset, queries: str | None, out: Path, *, report: Callable[[int, int], None]) -> int:
    """Write survey and query set; ``import kitti-raw OUT/DAY --poses .../poses.txt --depth stored`` reads them.

    Args:
        dataset: to read; its times are written as seconds since 1970.
        queries: name of the query set to write, of one camera; None writes no images.
        out: folder to write; it appears only when it is complete.
        report: called with the moments done and all moments.

    Returns:
        Number of moments that were written.

    Raises:
        DatasetError: ``out`` already exists, or the dataset cannot be written as one traversal.
    """
    camera = None if queries is None else single_camera(dataset, queries)
    total = len(dataset.survey_poses()) + (0 if queries is None else sum(1 for _ in dataset.queries(queries)))
    T_vehicle_scan = T_vehicle_lidar(dataset)
    stamps: list[float] = []
    poses: list[Transform] = []
    with whole_or_not_at_all(out) as part:
        drive = part / DAY / DRIVE
        for folder in ("velodyne_points/data", "image_02/data", "proj_depth/groundtruth/image_02"):
            (drive / folder).mkdir(parents=True)
        for number, moment in enumerate(moments(dataset, queries)):
            _write(drive, number, moment)
            stamps.append(moment.stamp_s)
            poses.append(moment.T_map_vehicle @ T_vehicle_scan)
            report(number + 1, total)
        write_tum(drive / POSES, np.array(stamps), np.stack(poses))
        times = "".join(f"{_time(stamp_s)}\n" for stamp_s in stamps)
        for folder in ("velodyne_points", "image_02"):
            (drive / folder / "timestamps.txt").write_text(times)
        (drive / SCANS_AT_REST).write_text("Each scan was measured at one instant, so it needs no motion correction.\n")
        _write_calibration(part / DAY, T_vehicle_scan, camera)
    return len(stamps)


def _write(drive: Path, number: int, moment: Moment) -> None:
    name = f"{number:010d}"
    if moment.points is not None:
        np.ascontiguousarray(moment.points, np.float32).tofile(drive / "velodyne_points" / "data" / f"{name}.bin")
    if moment.frame is not None:
        steps = np.rint(moment.frame.depth_m() * _STEPS_PER_M)
        depth = np.where(steps <= np.iinfo(np.uint16).max, steps, 0).astype(np.uint16)
        write_png(drive / "image_02" / "data" / f"{name}.png", np.ascontiguousarray(moment.frame.rgb()[:, :, ::-1]))
        write_png(drive / "proj_depth" / "groundtruth" / "image_02" / f"{name}.png", depth)


def _write_calibration(day: Path, T_vehicle_scan: Transform, camera: CameraSensor | None) -> None:
    """Write the calibration. Cameras 0 and 2 have the same frame; rectification is the identity."""
    T_camera_lidar = np.eye(4) if camera is None else inverse(T_vehicle_camera(camera)) @ T_vehicle_scan
    K = np.eye(3) if camera is None else camera.pinhole().matrix
    (day / "calib_velo_to_cam.txt").write_text(_line("R", T_camera_lidar[:3, :3]) + _line("T", T_camera_lidar[:3, 3]))
    (day / "calib_cam_to_cam.txt").write_text(_line("R_rect_00", np.eye(3)) + _line("P_rect_02", np.c_[K, np.zeros(3)]))


def _line(key: str, matrix: np.ndarray) -> str:
    return f"{key}: " + " ".join(f"{value:.15e}" for value in matrix.reshape(-1)) + "\n"


def _time(stamp_s: float) -> str:
    whole, nanoseconds = divmod(round(stamp_s * 1e9), 10**9)
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=whole)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{nanoseconds:09d}"
