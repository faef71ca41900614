"""Latency of requests with a prior on a tiled map: sixteen tiles against one, with the same limit of open tiles."""

import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Report
from benchmarks.runs import Runs
from benchmarks.scale.sources import city_plan
from model_training.datasets.dataset import Dataset
from model_training.mapping.stored_map import content_of
from service.localization.localizer import Localizer
from service.maps.content import BundleContent
from service.maps.reader import MapBundle
from service.maps.tiled_writer import write_tiled
from service.maps.tiles import TiledMap
from service.maps.writer import write_bundle
from service.registration.surfel_map import SurfelMap
from service.retrieval.prior import Prior
from service.retrieval.query import Query

#: Edge of a tile (m), tiles of the large map along one side, and the limit of the open tiles of both maps (bytes).
TILE_M, SIDE, OPEN_BYTES = 500.0, 4, 512 * 2**20
#: Standard deviation of the prior (m), queries of a robot before the next one asks, and robots.
PRIOR_M, RUN, ROBOTS = 5.0, 25, 48


def served_rows(report: Report, runs: Runs, work: Path) -> None:
    """Measure requests with a prior, in the process of the caller.

    The large map has copies of one city, shifted to the squares of a grid. So a request does the same work in both maps. A robot asks
    ``RUN`` times in its square, then another robot asks in another square. So most tiles of the large map are closed when a robot asks for
    the first time.

    Args:
        report: collects the rows.
        runs: simulates and builds the city, or reuses it.
        work: folder of the two maps.
    """
    dataset = runs.dataset(city_plan(0))
    city, folder = runs.bundle(dataset), work / "served"
    queries = _queries(dataset, city)
    shutil.rmtree(folder, ignore_errors=True)
    try:
        home = TILE_M / 2 - city.T_map_place[:, :2, 3].mean(axis=0)  # the city lies in the middle of its square
        shifts = [home + TILE_M * np.array([column, row]) for column in range(SIDE) for row in range(SIDE)]
        one, many = _tiled(city, shifts[:1], folder / "one"), _tiled(city, shifts, folder / "many")
        _measure(report, queries, shifts, one, many)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _measure(
    report: Report,
    queries: list[tuple[Query, NDArray[np.float64]]],
    shifts: list[NDArray[np.float64]],
    one: Path,
    many: Path,
) -> None:
    opened = {path: TiledMap.open(path, open_bytes=OPEN_BYTES) for path in (one, many)}
    localizers = {path: Localizer.open(bundle) for path, bundle in opened.items()}
    rng, right = np.random.default_rng(0), {one: 0, many: 0}
    seconds: dict[Path, list[float]] = {one: [], many: []}
    for number in range(len(shifts)):  # every tile is read and checked once
        opened[many].tiles.get(number)
    opened[one].tiles.get(0)
    for each in opened.values():
        each.tiles.opens_ahead = True  # as in a service
    for _ in range(ROBOTS):
        home = int(rng.integers(len(shifts)))
        for number in rng.integers(len(queries), size=RUN):
            query, xy = queries[number]
            for path in (one, many):
                shift = shifts[home] if path == many else shifts[0]
                asked = replace(query, prior=Prior(position_m=xy + shift, position_std_m=PRIOR_M))
                started = time.perf_counter()
                answer = localizers[path].localize(asked)
                seconds[path].append(time.perf_counter() - started)
                right[path] += int(np.hypot(*(answer.T_map_camera_guess[:2, 3] - xy - shift)) < 1.0)
    ms = {path: 1e3 * np.array(each) for path, each in seconds.items()}
    count = ROBOTS * RUN
    for path, name in ((one, "one_tile"), (many, "sixteen_tiles")):
        report.row(f"serve.with_prior.{name}.p50_ms", float(np.median(ms[path])), "ms", n=count)
        report.row(f"serve.with_prior.{name}.p99_ms", float(np.percentile(ms[path], 99)), "ms", n=count)
        report.row(f"serve.with_prior.{name}.within_1_m", right[path] / count, "share", n=count)
    report.row(
        "serve.p99_with_prior",
        float(np.percentile(ms[many], 99) / np.percentile(ms[one], 99)),
        "ratio",
        bar=1.2,
        better="lower",
        n=count,
        why=f"{len(opened[many].tiles.opened)} of {len(shifts)} tiles were open at the end, the limit is {OPEN_BYTES / 2**20:.0f} MiB",
    )


def _queries(dataset: Dataset, city: MapBundle) -> list[tuple[Query, NDArray[np.float64]]]:
    """Return the queries of the city with their true positions (m)."""
    found = []
    for name in dataset.query_sets(with_truth=True):
        for frame in dataset.queries(name):
            if frame.T_map_camera is not None:
                found.append((frame.query(city.grid), frame.T_map_camera[:2, 3].copy()))
    return found


def _tiled(city: MapBundle, shifts: list[NDArray[np.float64]], out: Path) -> Path:
    """Write a tiled map with a copy of the city at each shift."""
    middle, tiles = city.T_map_place[:, :2, 3].mean(axis=0), {}
    for shift in shifts:
        column, row = (int(each) for each in np.floor((middle + shift) / TILE_M))
        tiles[column, row] = out.parent / f"{out.name}-{column}-{row}"
        write_bundle(tiles[column, row], _shifted(city, shift))
    write_tiled(out, tiles, TILE_M, name="city")
    for each in tiles.values():
        shutil.rmtree(each)
    return out


def _shifted(city: MapBundle, shift: NDArray[np.float64]) -> BundleContent:
    """Return the city at another position, without its streets."""
    content, cloud = content_of(city), city.cloud
    if not isinstance(cloud, SurfelMap):
        raise TypeError(f"{city.path}: the city has no cloud; build it again")
    T_map_place = np.array(content.T_map_place)
    T_map_place[:, :2, 3] += shift
    moved = replace(cloud, origin_m=cloud.origin_m + np.array([*shift, 0.0]))
    return replace(
        content,
        T_map_place=T_map_place,
        place_street=np.full(len(T_map_place), -1, np.int32),
        streets=None,
        cloud=moved,
        statistics=None,
        preview_webp=b"",
    )
