"""A dataset as events: scans and track of the survey, then the images of every query set at their poses."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset, QueryFrame
from model_training.viewing.events import Cloud, Event, Poses, Track, View
from service.geometry.rigid import transform_points
from service.imaging.fusion import fuse, picture_of
from service.imaging.view_grid import ViewGrid

#: Time between two queries, seconds. Their own times mostly do not relate to other content.
STEP_S = 1.0
_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 85]


def events_of_dataset(dataset: Dataset, *, most_scans: int, most_points: int) -> Iterator[Event]:
    """Yield scans at their times since the first one, then queries one after the other.

    Args:
        dataset: an open dataset.
        most_scans: largest number of scans; a longer survey shows each n-th scan.
        most_points: largest number of points; a larger scan shows each n-th point.
    """
    stamps, T_map_lidar = dataset.survey_trajectory()
    now_s = 0.0
    if len(stamps):
        yield Track("survey/track", None, T_map_lidar[:, :3, 3])
        for number in range(0, len(stamps), max(1, -(-len(stamps) // most_scans))):
            now_s = float(stamps[number] - stamps[0])
            yield _scan(dataset.scan(number), T_map_lidar[number], now_s, most_points)
    for name in dataset.query_sets():
        truth = [frame.T_map_camera for frame in dataset.queries(name) if frame.T_map_camera is not None]
        if truth:
            yield Track(f"queries/{name}/track", None, np.array(truth)[:, :3, 3])
        for frame in dataset.queries(name):
            now_s += STEP_S
            if frame.T_map_camera is not None:
                yield Poses("query/truth", now_s, frame.T_map_camera[None])
                yield view_of(frame, now_s, frame.T_map_camera)


def _scan(scan: NDArray[np.float32], T_map_lidar: NDArray[np.float64], now_s: float, most_points: int) -> Cloud:
    kept = scan[:: max(1, -(-len(scan) // most_points))]
    origin_m = T_map_lidar[:3, 3].copy()
    points_m = transform_points(T_map_lidar, kept[:, :3].astype(np.float64)) - origin_m
    bright = np.log1p(kept[:, 3]) / max(1e-9, float(np.log1p(kept[:, 3].max(initial=0.0))))
    return Cloud("survey/scan", now_s, origin_m, points_m.astype(np.float32), (60 + 195 * bright).astype(np.uint8))


def view_of(frame: QueryFrame, now_s: float, T_map_camera: NDArray[np.float64]) -> View:
    """Return a query's images at a pose.

    Args:
        frame: the query.
        now_s: time of the event, seconds.
        T_map_camera: pose (4, 4).
    """
    rgb, depth_m = frame.rgb(), frame.depth_m()
    if depth_m.shape != rgb.shape[:2]:
        depth_m = cv2.resize(depth_m, rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST).astype(np.float32)
    fused = picture_of(fuse(rgb, depth_m).planes, ViewGrid().max_range_m)
    camera = frame.camera.pinhole()
    return View("query/camera", now_s, T_map_camera, camera, _jpeg(rgb), depth_m, _jpeg(fused))


def _jpeg(rgb: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), _QUALITY)[1].tobytes()
