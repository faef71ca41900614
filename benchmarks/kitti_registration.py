"""Registration on real stereo frames by the protocol of the data folder's README: 7 frames, 20 disturbed starts each."""

import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Report
from benchmarks.runs import Runs
from model_training.datasets.dataset import Dataset, QueryFrame
from model_training.importing.kitti_object import import_kitti_object
from model_training.mapping.settings import BuildSettings
from service.geometry.rigid import rotation_z, transform_from, transform_points
from service.imaging.level import level_camera
from service.localization.refine import RefineSettings, settings_for_rig
from service.registration.points import blocks_of, inverse_depth_noise, movable_of, points_from
from service.registration.rays import adjust, picture_of
from service.registration.register import Start, register
from service.registration.surfel_map import SurfelMap
from service.registration.visibility import SurfelRaycaster

NOT_HELD_OUT = "not held out: the turned starts and the weights of the last stage were chosen on these frames"
STARTS, AWAY_M, TURN_DEG = 20, 2.0, 10.0
#: Settings of plain GICP, from the prototype: voxel size of both clouds, and the largest depth.
GICP_CELL_M, GICP_REACH_M = 0.2, 40.0
#: Radii of correspondence, one after the other; this order suits GICP best.
GICP_RADII_M = (2.0, 0.5)
KITTI_FOCAL_BASELINE_PX_M = 721.5 * 0.54
BARS = {"median_m": (0.08, "lower"), "p95_m": (0.15, "lower"), "within_1_m": (1.0, "higher")}


def kitti_registration_rows(report: Report, runs: Runs, data: Path) -> None:
    """Add errors of the registered poses; without recordings, each row gives the reason.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
        data: folder with the recording ``kitti_stereo``.

    Raises:
        RuntimeError: the scans give no surface.
    """
    kitti = data / "kitti_stereo"
    prefix = "real.kitti_stereo.registration"
    if not kitti.exists():
        for key, (bar, better) in BARS.items():
            report.row(f"{prefix}.{key}", None, "m", bar=bar, better=better, why=f"no recordings at {data.name}")  # type: ignore[arg-type]
        return
    folder = runs.work / "kitti_sgbm"
    if not folder.exists():
        import_kitti_object(kitti, folder, depth="sgbm")
    dataset = Dataset(folder)
    settings = BuildSettings(name="kitti", expected_lidar_height_m=1.73)
    cloud = runs.bundle(dataset, settings).cloud
    if cloud is None:
        raise RuntimeError(f"{dataset.folder}: its scans do not form a surface")
    errors, own_ms = registration_errors(cloud, dataset)
    found = {"median_m": np.median(errors), "p95_m": np.percentile(errors, 95), "within_1_m": (errors <= 1.0).mean()}
    for key, value in found.items():
        bar, better = BARS[key]
        unit = "share" if key == "within_1_m" else "m"
        report.row(f"{prefix}.{key}", float(value), unit, bar=bar, better=better, n=len(errors), why=NOT_HELD_OUT)  # type: ignore[arg-type]
    plain, gicp_ms = gicp_errors(dataset)
    report.row(f"{prefix}.gicp_median_m", float(np.median(plain)), "m", n=len(plain))
    report.row(f"{prefix}.gicp_p95_m", float(np.percentile(plain, 95)), "m", n=len(plain))
    report.row(f"{prefix}.gicp_within_1_m", float((plain <= 1.0).mean()), "share", n=len(plain))
    report.row(f"{prefix}.cpu_over_gicp", own_ms / gicp_ms, "ratio", better="lower", n=len(plain))


def registration_errors(cloud: SurfelMap, dataset: Dataset) -> tuple[NDArray[np.float64], float]:
    """Return position errors (N,) in metres of every start of every frame, and processor time (ms) of an image and a start.

    Args:
        cloud: map surfaces.
        dataset: frames with ground truth.
    """
    refining = settings_for_rig(RefineSettings(), KITTI_FOCAL_BASELINE_PX_M)
    found, prepared_s, aligned_s = list[float](), list[float](), list[float]()
    for frame, truth in _with_truth(dataset):
        depth_m, camera = frame.depth_m(), frame.camera.pinhole()
        level = level_camera(depth_m, camera, down_camera=None, nominal_height_m=1.65)
        began = time.process_time()
        noise = inverse_depth_noise(depth_m, focal_baseline_px_m=KITTI_FOCAL_BASELINE_PX_M).total
        blocks = blocks_of(depth_m, camera, refining.points, noise=noise)
        points = points_from(
            blocks,
            level.R_level_camera,
            level.height_m,
            refining.points,
            noise=noise,
            focal_baseline_px_m=KITTI_FOCAL_BASELINE_PX_M,
        )
        T_level_camera = transform_from(level.R_level_camera, np.zeros(3))
        movable = movable_of(blocks, level.R_level_camera, level.height_m, refining.points)
        picture = picture_of(
            blocks, T_level_camera, noise=noise, focal_baseline_px_m=KITTI_FOCAL_BASELINE_PX_M, movable=movable
        )
        prepared_s.append(time.process_time() - began)
        rng = np.random.default_rng([140, frame.number])
        R_true = truth[:3, :3] @ level.R_level_camera.T
        for _ in range(STARTS):
            away = rng.uniform(0, AWAY_M) * _direction(rng.uniform(-np.pi, np.pi))
            turn = np.deg2rad(rng.uniform(-TURN_DEG, TURN_DEG))
            upright = _upright(R_true)
            start = Start(rotation_z(turn) @ upright, truth[:3, 3] + away, 0)
            began = time.process_time()
            best = register(cloud, points, [start], level.height_m, refining.registration)[0]
            adjusted = adjust(SurfelRaycaster(cloud, refining.rays), [picture], best, refining.rays)
            best = best if adjusted is None else adjusted[0]
            aligned_s.append(time.process_time() - began)
            found.append(float(np.linalg.norm(transform_from(best.R_map_level, best.camera_m)[:3, 3] - truth[:3, 3])))
    return np.array(found), 1e3 * (median(prepared_s) + median(aligned_s))


def _with_truth(dataset: Dataset) -> Iterator[tuple[QueryFrame, NDArray[np.float64]]]:
    """Yield the frames with ground truth, and their poses (4, 4)."""
    for frame in dataset.queries("frames"):
        if frame.T_map_camera is not None:
            yield frame, frame.T_map_camera


def gicp_errors(dataset: Dataset) -> tuple[NDArray[np.float64], float]:
    """Return the same for small_gicp: all depth against the frame's own scan, unweighted, without the time of the scan's tree.

    The errors have shape (N,).

    Args:
        dataset: frames with ground truth.
    """
    import small_gicp

    poses, found, prepared_s, aligned_s = dataset.survey_poses(), list[float](), list[float](), list[float]()
    for frame, truth in _with_truth(dataset):
        own = int(np.argmin(np.linalg.norm(poses[:, :3, 3] - truth[:3, 3], axis=1)))
        scan = transform_points(poses[own], dataset.scan(own)[:, :3].astype(np.float64))
        depth_m, rays = frame.depth_m(), frame.camera.pinhole().rays_of_pixels()
        seen = (depth_m > 0) & (depth_m < GICP_REACH_M)
        camera = (rays[seen] * depth_m[seen, None]).astype(np.float64)
        target, tree = small_gicp.preprocess_points(scan - truth[:3, 3], downsampling_resolution=GICP_CELL_M)
        began = time.process_time()
        source, _ = small_gicp.preprocess_points(camera, downsampling_resolution=GICP_CELL_M, num_threads=1)
        prepared_s.append(time.process_time() - began)
        rng = np.random.default_rng([140, frame.number])
        for _ in range(STARTS):
            away = rng.uniform(0, AWAY_M) * _direction(rng.uniform(-np.pi, np.pi))
            turn = np.deg2rad(rng.uniform(-TURN_DEG, TURN_DEG))
            start = transform_from(rotation_z(turn) @ truth[:3, :3], away)
            began = time.process_time()
            for radius_m in GICP_RADII_M:
                done = small_gicp.align(
                    target, source, tree, start, max_correspondence_distance=radius_m, num_threads=1
                )
                start = done.T_target_source
            aligned_s.append(time.process_time() - began)
            found.append(float(np.linalg.norm(start[:3, 3])))
    return np.array(found), 1e3 * (median(prepared_s) + median(aligned_s))


def _direction(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _upright(R_map_level: np.ndarray) -> np.ndarray:
    """Keep the heading only: a query does not reveal the camera's tilt against the map."""
    return rotation_z(float(np.arctan2(R_map_level[1, 0], R_map_level[0, 0])))
