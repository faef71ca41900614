"""Rows ``real.peers.*``: other methods on the same queries and map. Their figures are forced. Ours are forced and with status.

Retrieval methods return the most similar place. Registration methods return a pose. If the library of a method is not installed, the
row of an earlier run stays. Without such a row, the row gives the reason.
"""

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Report
from model_training.datasets.dataset import Dataset, QueryFrame
from model_training.evaluation.failures import position_errors
from model_training.evaluation.predict import predict
from model_training.evaluation.raw_range import SETTINGS, raw_best_views
from research.baselines.cloud_registration import (
    FpfhMap,
    GicpMap,
    by_kiss_matcher,
    points_of_depth,
    thinned_to_voxels,
)
from research.baselines.paper.cnn import PaperCnn
from research.baselines.paper.other_map import nearest_scans
from research.baselines.scan_context import ContextSettings, context_of, context_of_depth, similarities
from service.errors import ExtraMissingError
from service.geometry.rigid import Transform
from service.localization.localizer import Localizer
from service.maps.calibration import RIGHT_M
from service.registration.surfel_map import SurfelMap

NEAR_PLACE_M = 5.0
Locate = Callable[[QueryFrame, int], Transform | None]


def pooled_rows(report: Report, drives: list[tuple[float, float, int]]) -> None:
    """Add the shares within 1 m over all drives, weighted by queries: the best other method of each drive, and ours.

    Args:
        report: receives the rows.
        drives: result of ``peer_rows`` for each drive.
    """
    if not drives:
        return
    best, ours, queries = np.array(drives).T
    best_share, our_share = (float((shares * queries).sum() / queries.sum()) for shares in (best, ours))
    report.row("real.peers.best_within_1_m", best_share, "share", n=int(queries.sum()))
    report.row(
        "real.peers.ours_within_1_m", our_share, "share", bar=float(np.nextafter(best_share, 1)), n=int(queries.sum())
    )


def peer_rows(
    report: Report, name: str, dataset: Dataset, localizer: Localizer, query_set: str, network: PaperCnn
) -> tuple[float, float, int]:
    """Run every method on one drive and add its rows.

    Args:
        report: receives the rows.
        name: name of the drive, part of the row ids.
        dataset: dataset of the drive.
        localizer: localizer of its map.
        query_set: name of a query set with ground truth.
        network: the paper's network, trained in the simulator.

    Returns:
        Forced share within 1 m of the best other method, that of our method, and the number of queries.

    Raises:
        ValueError: the map has no cloud, or is tiled.
    """
    frames = list(dataset.queries(query_set))
    true_xy = np.array([frame.T_map_camera[:2, 3] for frame in frames if frame.T_map_camera is not None])
    ours = predict(localizer, dataset, query_set)
    retrieved = predict(localizer, dataset, query_set, refine=False)
    errors = position_errors(ours)
    best = ("", -1.0)
    cloud = localizer.bundle.cloud
    if not isinstance(cloud, SurfelMap):
        raise ValueError(f"the map of {name} is tiled or has no cloud")
    points = cloud.origin_m + cloud.unpacked(np.s_[:])["xyz"].astype(np.float64)
    map_points = thinned_to_voxels(points, 0.25)

    def add(peer: str, xy: NDArray[np.float64], seconds: float | None = None) -> None:
        nonlocal best
        off = np.nan_to_num(np.hypot(*(xy - true_xy).T), nan=np.inf)
        report.share(f"real.peers.{name}.{peer}.within_1_m", off <= RIGHT_M)
        report.share(f"real.peers.{name}.{peer}.within_5_m", off <= NEAR_PLACE_M)
        if seconds is not None:
            report.row(f"real.peers.{name}.{peer}.s_a_query", seconds / len(frames), "s")
        best = max(best, (peer, float((off <= RIGHT_M).mean())), key=lambda each: each[1])

    add("raw_range_image", _by_raw_range(localizer, dataset, query_set, true_xy))
    add("scan_context", _by_scan_context(dataset, frames))
    add("paper_network", nearest_scans(network, dataset, frames))

    def registered(peer: str, prepare: Callable[[], Locate]) -> None:
        try:
            locate = prepare()
            began = time.perf_counter()
            poses = [locate(frame, k) for k, frame in enumerate(frames)]
        except ExtraMissingError as missing:
            report.absent(f"real.peers.{name}.{peer}.within_1_m", "share", str(missing))
            return
        xy = np.array([[np.nan, np.nan] if pose is None else pose[:2, 3] for pose in poses])
        add(peer, xy, time.perf_counter() - began)

    def points_in(frame: QueryFrame) -> NDArray[np.float64]:
        return thinned_to_voxels(points_of_depth(frame.depth_m(), frame.camera.pinhole()), 0.1)

    def with_fpfh() -> Locate:
        prepared = FpfhMap(map_points)
        return lambda frame, _: prepared.locate(points_in(frame))

    def with_gicp() -> Locate:
        prepared = GicpMap(map_points)
        return lambda frame, k: prepared.locate(points_in(frame), retrieved.T_answer[k])

    registered("kiss_matcher", lambda: lambda frame, _: by_kiss_matcher(points_in(frame), map_points))
    registered("fpfh_ransac", with_fpfh)
    registered("small_gicp_from_retrieved_place", with_gicp)
    report.share(f"real.peers.{name}.ours.within_1_m", errors <= RIGHT_M)
    report.share(f"real.peers.{name}.ours.answered_within_1_m", ours.localized & (errors <= RIGHT_M))
    report.share(f"real.peers.{name}.ours.within_5_m", errors <= NEAR_PLACE_M)
    report.row(f"real.peers.{name}.best_within_1_m", best[1], "share", why=f"of {best[0]}")
    return best[1], float((errors <= RIGHT_M).mean()), len(frames)


def _by_raw_range(
    localizer: Localizer, dataset: Dataset, query_set: str, true_xy: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the places (n, 2) of the most similar range views, metres, with the best setting for these queries: an upper bound."""
    found = raw_best_views(localizer.bundle, dataset, [query_set])
    places = localizer.bundle.T_map_place[:, :2, 3]

    def near(setting: str) -> float:
        return float((np.hypot(*(places[found[setting]] - true_xy).T) <= RIGHT_M).mean())

    number = found[max(SETTINGS, key=near)]
    xy: NDArray[np.float64] = np.where((number >= 0)[:, None], places[number], np.nan)
    return xy


def _by_scan_context(dataset: Dataset, frames: list[QueryFrame]) -> NDArray[np.float64]:
    """Return the positions (n, 2) of the scans with the most similar context, metres."""
    settings, poses = ContextSettings(), dataset.survey_poses()
    contexts = []
    for number, T_map_lidar in enumerate(poses):
        points = dataset.scan(number)[:, :3].astype(np.float64) @ T_map_lidar[:3, :3].T
        low = np.percentile(points[np.hypot(*points[:, :2].T) < 10][:, 2], 5)  # the ground around the vehicle
        contexts.append(context_of(points - [0.0, 0.0, low], settings))
    queries = [context_of_depth(frame.depth_m(), frame.camera.pinhole(), settings) for frame in frames]
    nearest = similarities(np.stack(queries), np.stack(contexts)).argmax(axis=1)
    xy: NDArray[np.float64] = poses[nearest, :2, 3]
    return xy
