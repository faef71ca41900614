"""Measure how much faster the compiled functions are than the same in NumPy (and PNG depth than OpenCV), one thread each.

Every pair of results is compared before it is timed. Processor time; of each query the best of three runs, of all queries the median.

Example: python -m benchmarks.native.against_numpy MAP DATASET --queries recorded
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchmarks.native import plain
from model_training.datasets.dataset import Dataset, QueryFrame
from service.geometry.rigid import R_BODY_OPTICAL
from service.imaging import level
from service.imaging.png16 import read_grey16
from service.imaging.resample import resample
from service.imaging.view_grid import ViewGrid
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.registration import rays
from service.registration.kernel import STATE, align
from service.registration.points import FOCAL_BASELINE_PX_M, PointSettings, blocks_of, inverse_depth_noise
from service.registration.surfel_map import SurfelMap
from service.registration.visibility import SurfelRaycaster
from service.retrieval.query import Query
from service.retrieval.retrieve import turns_on
from service.retrieval.starts import starts_from
from service.scoring.measured import measure, merged_points

Pair = tuple[float, float]
_RUNS = 3


def main() -> None:
    """Print the median time of each function in C and in NumPy, milliseconds, and the ratio."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.native.against_numpy", description=__doc__)
    parser.add_argument("map", type=Path, help="map bundle with a cloud")
    parser.add_argument("dataset", type=Path, help="dataset with queries on this map")
    parser.add_argument("--queries", required=True, help="name of the query set")
    options = parser.parse_args()
    localizer = Localizer.open(MapBundle.open(options.map))
    with threadpool_limits(1):
        cv2.setNumThreads(1)
        found = [times_of(localizer, frame) for frame in Dataset(options.dataset).queries(options.queries)]
    for name in found[0]:
        compiled, other = np.median([each[name] for each in found], axis=0) * 1e3
        print(f"{name:45} {compiled:8.3f} ms {other:8.3f} ms {other / compiled:6.1f} x")


def times_of(localizer: Localizer, frame: QueryFrame) -> dict[str, Pair]:
    """Compare and time all functions on one query; return the seconds in C and without it, by name.

    Args:
        localizer: the map and its encoder.
        frame: the query.

    Raises:
        AssertionError: a compiled function gives another result than NumPy.
        ValueError: the map has no cloud, or is tiled.
    """
    cloud = localizer.bundle.cloud
    if not isinstance(cloud, SurfelMap):
        raise ValueError(f"{localizer.bundle.path} is tiled or has no cloud; build a map of one bundle with one")
    query = frame.query(localizer.bundle.grid)
    return _of_imaging(query, localizer.bundle.grid, frame.depth_path.read_bytes()) | _of_registration(
        localizer, cloud, query
    )


def _of_imaging(query: Query, grid: ViewGrid, file: bytes) -> dict[str, Pair]:
    rgb, depth_m, camera, points = query.rgb, query.depth_m, query.camera, PointSettings()
    R = level.nominal_level(np.array([0.0, 1.0, 0.0]))
    ground = (depth_m, camera, R, level.USUAL_HEIGHT_M, level.HEIGHT_PRIOR_M)
    np.testing.assert_allclose(level._fit_ground(*ground), plain.fit_ground(*ground), rtol=1e-6, atol=1e-6)
    view = (rgb, depth_m, camera, R_BODY_OPTICAL.T, grid.widened(turns_on(grid)[-1]))
    _require_same(resample(*view), plain.resampled(*view))
    noise = inverse_depth_noise(depth_m).total
    np.testing.assert_allclose(noise, plain.noise_of(depth_m), rtol=1e-5)
    thinned = blocks_of(depth_m, camera, points, noise=noise)
    _require_same((thinned.z_m,), (plain.blocks(depth_m, points, noise),))
    found = {
        "level.py: one fit of the ground": _both(lambda: level._fit_ground(*ground), lambda: plain.fit_ground(*ground)),
        "resample.py: one wide view": _both(lambda: resample(*view), lambda: plain.resampled(*view)),
        "points.py: noise": _both(lambda: inverse_depth_noise(depth_m), lambda: plain.noise_of(depth_m)),
        "points.py: blocks": _both(
            lambda: blocks_of(depth_m, camera, points, noise=noise), lambda: plain.blocks(depth_m, points, noise)
        ),
    }
    if file.startswith(b"\x89PNG"):
        packed = np.frombuffer(file, np.uint8)
        values = np.asarray(cv2.imdecode(packed, cv2.IMREAD_UNCHANGED))
        height, width = values.shape
        np.testing.assert_array_equal(values, read_grey16(file, height, width, field="depth"))
        found["depth16.py: depth PNG, against OpenCV"] = _both(
            lambda: read_grey16(file, height, width, field="depth"), lambda: cv2.imdecode(packed, cv2.IMREAD_UNCHANGED)
        )
    return found


def _of_registration(localizer: Localizer, cloud: SurfelMap, query: Query) -> dict[str, Pair]:
    """One solver step of all starts; then the rays from the most similar start, and one step of their adjustment."""
    settings, lidar_height_m = localizer.refining, localizer.bundle.manifest.lidar_height_m
    frame = localizer.encode_and_search(query)
    measured = measure((frame,), settings.points, focal_baseline_px_m=FOCAL_BASELINE_PX_M, is_rig=False)
    points = merged_points(measured).thinned(settings.registration.coarse_points)
    starts = starts_from((frame,), None, lidar_height_m=lidar_height_m, settings=settings.starts)
    states = np.zeros(len(starts), STATE)
    states["R"] = [each.R_map_level for each in starts]
    states["t"] = states["anchor"] = [each.camera_m - cloud.origin_m for each in starts]
    states["up"] = [0.0, 0.0, 1.0]
    step, after = replace(settings.registration.coarse, iterations=1), states.copy()
    align(cloud.pieces, points, after, step)
    H, _ = plain.information(cloud.grid, cloud.surfels, points, states, step)
    np.testing.assert_allclose(after["information"], H, rtol=1e-6, atol=1e-9 * np.abs(H).max())
    picture, raycaster = measured[0].picture, SurfelRaycaster(cloud, settings.rays)
    pose = rays._State(starts[0].R_map_level, starts[0].camera_m - cloud.origin_m, 0.0, 0.0)
    T, camera = pose.camera_of(picture), picture.camera
    hits, near = rays._Hits.of(raycaster, pose, picture), raycaster._collections[0]
    _require_same((hits.indices,), (plain.intersect(near.surfels, near.numbers, T, camera, settings.rays),))
    adjusted = rays._normal_equations([picture], [hits], pose, settings.rays)
    surfels = hits.surfels.reshape(hits.indices.shape)
    expected = plain.normal_equations(surfels, picture, hits.indices, T, settings.rays)
    np.testing.assert_allclose(adjusted.H, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())
    return {
        "kernel.py: one step of all starts": _both(
            lambda: align(cloud.pieces, points, states.copy(), step),
            lambda: plain.information(cloud.grid, cloud.surfels, points, states, step),
        ),
        "rays.py: rays of one image": _both(
            lambda: raycaster._cast(T, camera),
            lambda: plain.intersect(near.surfels, near.numbers, T, camera, settings.rays),
        ),
        "rays.py: one step of the adjustment": _both(
            lambda: rays._normal_equations([picture], [hits], pose, settings.rays),
            lambda: plain.normal_equations(surfels, picture, hits.indices, T, settings.rays),
        ),
    }


def _both(compiled: Callable[[], object], other: Callable[[], object]) -> Pair:
    """Return the processor time of two calls, seconds, each the best of some runs."""
    best = []
    for call in (compiled, other):
        seconds = []
        for _ in range(_RUNS):
            began = time.thread_time()
            call()
            seconds.append(time.thread_time() - began)
        best.append(min(seconds))
    return best[0], best[1]


def _require_same(found: tuple[NDArray[Any], ...], expected: tuple[NDArray[Any], ...]) -> None:
    """Require equal results but for one cell in two hundred: rounding decides about a ray just between two pixels or discs."""
    for one, other in zip(found, expected, strict=True):
        differ = float(np.mean(~np.isclose(one, other, rtol=1e-4, atol=1e-3)))
        if differ > 0.005:
            raise AssertionError(f"{100 * differ:.1f} % of the cells differ between C and NumPy; at most 0.5 % may")


if __name__ == "__main__":
    main()
