"""Latency of requests with a prior on a tiled map: sixteen cities against one, with the same limit of open tiles."""

import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from benchmarks.report import Report
from benchmarks.runs import Runs
from benchmarks.scale.sources import city_plan
from model_training.datasets.dataset import Dataset
from model_training.mapping.join import of_places
from model_training.mapping.stored_map import content_of
from model_training.mapping.tile_area import Square, TileArea, cloud_of_tile
from service.localization.localizer import Localizer
from service.maps.content import BundleContent
from service.maps.reader import MapBundle
from service.maps.tiled_writer import write_tiled
from service.maps.tiles import TiledMap
from service.maps.writer import write_bundle
from service.registration.surfel_map import SurfelMap
from service.retrieval.prior import Prior
from service.retrieval.query import Query
from service.retrieval.retrieve import near_prior

#: Edge of a tile (m), cities of the large map along one side, and the limit of the open tiles of both maps (bytes).
TILE_M, SIDE, OPEN_BYTES = 500.0, 4, 512 * 2**20
#: Distance of the city's lowest x and y from the corner of four tiles, m. So its places lie in four tiles, most of them in one.
BEYOND_M = 20.0
#: Distance between two cities, tiles. So no tile has places of two cities.
APART = 2
#: Standard deviation of the prior (m), queries of a robot before the next one asks, and robots.
PRIOR_M, RUN, ROBOTS = 5.0, 25, 48
#: Maps by the name in their rows.
ONE, MANY = "one_city", "sixteen_cities"


def served_rows(report: Report, runs: Runs, work: Path) -> None:
    """Measure requests with a prior, in the process of the caller.

    The large map has copies of one city. The city lies across the corner of four tiles, alike in both maps. So a request does the same
    work in both maps, and some priors touch two or four tiles. A robot asks ``RUN`` times in its city, then another robot asks in another
    city. So most tiles of the large map are closed when a robot asks for the first time.

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
        shifts, maps = shifted_maps(city, folder)
        _measure(report, queries, shifts, maps)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def shifted_maps(city: MapBundle, folder: Path) -> tuple[list[Float64[NDArray[np.float64], "2"]], dict[str, Path]]:
    """Write both maps. Return the shift of each city of the large one (m) and the folders. The small map has the first city.

    Args:
        city: the city, a map of one bundle.
        folder: folder of the maps.
    """
    corner = np.full(2, TILE_M - BEYOND_M)
    home = corner - city.T_map_place[:, :2, 3].min(axis=0)
    between = [APART * TILE_M * np.array([column, row]) for column in range(SIDE) for row in range(SIDE)]
    moved = _moved(_served(city), home)
    maps = {ONE: _tiled(moved, between[:1], folder / ONE), MANY: _tiled(moved, between, folder / MANY)}
    return [home + shift for shift in between], maps


def _measure(
    report: Report,
    queries: list[tuple[Query, NDArray[np.float64]]],
    shifts: list[NDArray[np.float64]],
    maps: dict[str, Path],
) -> None:
    opened = {name: TiledMap.open(path, open_bytes=OPEN_BYTES) for name, path in maps.items()}
    localizers = {name: Localizer.open(bundle) for name, bundle in opened.items()}
    rng, right = np.random.default_rng(0), dict.fromkeys(maps, 0)
    seconds: dict[str, list[float]] = {name: [] for name in maps}
    touched: dict[str, list[int]] = {name: [] for name in maps}
    for bundle in opened.values():  # every tile is read and checked once
        for number in range(len(bundle.tiles)):
            bundle.tiles.get(number)
        bundle.tiles.opens_ahead = True  # as in a service
    for _ in range(ROBOTS):
        home = int(rng.integers(len(shifts)))
        for turn, number in enumerate(rng.integers(len(queries), size=RUN)):
            query, xy = queries[number]
            for name in (
                maps if turn % 2 else reversed(maps)
            ):  # neither map is always asked with the images in the cache
                shift = shifts[home] if name == MANY else shifts[0]
                asked = replace(query, prior=Prior(position_m=xy + shift, position_std_m=PRIOR_M))
                started = time.perf_counter()
                answer = localizers[name].localize(asked)
                seconds[name].append(time.perf_counter() - started)
                right[name] += int(np.hypot(*(answer.T_map_camera_guess[:2, 3] - xy - shift)) < 1.0)
                touched[name].append(touched_tiles(opened[name].tiles.squares_m, asked))
    if touched[ONE] != touched[MANY]:
        raise RuntimeError("a prior touches other numbers of tiles in the two maps; the cities do not lie alike")
    ms = {name: 1e3 * np.array(each) for name, each in seconds.items()}
    count, many = ROBOTS * RUN, np.array(touched[MANY])
    for name in maps:
        report.row(f"serve.with_prior.{name}.p50_ms", float(np.median(ms[name])), "ms", n=count)
        report.row(f"serve.with_prior.{name}.p99_ms", float(np.percentile(ms[name], 99)), "ms", n=count)
        report.row(f"serve.with_prior.{name}.within_1_m", right[name] / count, "share", n=count)
    report.row(
        "serve.p99_with_prior",
        float(np.percentile(ms[MANY], 99) / np.percentile(ms[ONE], 99)),
        "ratio",
        bar=1.2,
        better="lower",
        n=count,
        why=f"{len(shifts)} cities over one. Of the priors, {(many > 1).mean():.0%} touch more than one tile, and {(many > 2).mean():.0%} "
        f"more than two. {len(opened[MANY].tiles.opened)} of {len(opened[MANY].tiles)} tiles were open at the end, and "
        f"{len(opened[ONE].tiles.opened)} of {len(opened[ONE].tiles)}; the limit is {OPEN_BYTES / 2**20:.0f} MiB",
    )


def touched_tiles(squares_m: Float64[NDArray[np.float64], "T 4"], query: Query) -> int:
    """Return the number of tiles in the area that a tiled map searches for a query with a prior.

    Args:
        squares_m: x0, y0, x1, y1 of each tile, map frame, m.
        query: query with a prior.

    Raises:
        ValueError: the query has no prior.
    """
    if (near := near_prior(query)) is None:
        raise ValueError("prior: the query has none; give one")
    xy, radius_m = near
    away_m = np.linalg.norm(xy - np.clip(xy, squares_m[:, :2], squares_m[:, 2:]), axis=1)
    return int((away_m <= radius_m).sum())


def _queries(dataset: Dataset, city: MapBundle) -> list[tuple[Query, NDArray[np.float64]]]:
    """Return the queries of the city with their true positions (m)."""
    found = []
    for name in dataset.query_sets(with_truth=True):
        for frame in dataset.queries(name):
            if frame.T_map_camera is not None:
                found.append((frame.query(city.grid), frame.T_map_camera[:2, 3].copy()))
    return found


def tiles_of(content: BundleContent) -> dict[tuple[int, int], BundleContent]:
    """Return the tiles of a city by column and row. The cloud of each has the same ground as that of a built tile.

    Args:
        content: the city.

    Raises:
        TypeError: the city has no cloud.
    """
    cloud = content.cloud
    if not isinstance(cloud, SurfelMap):
        raise TypeError(f"{content.name}: the city has no cloud; build it again")
    cells = np.floor(content.T_map_place[:, :2, 3] / TILE_M).astype(int)
    squares = [(column, row) for column, row in np.unique(cells, axis=0).tolist()]
    tiles = {}
    for column, row in squares:
        own = cloud_of_tile(cloud, TileArea(Square(column, row, TILE_M), set(squares), content.parameters["voxel_m"]))
        tiles[column, row] = replace(of_places(content, (cells == (column, row)).all(axis=1)), cloud=own)
    return tiles


def _tiled(city: BundleContent, shifts: list[NDArray[np.float64]], out: Path) -> Path:
    """Write a tiled map with the city at each shift, which is a multiple of the tile's edge."""
    written = {}
    for shift in shifts:
        for (column, row), content in tiles_of(_moved(city, shift)).items():
            written[column, row] = out.parent / f"{out.name}-{column}-{row}"
            write_bundle(written[column, row], content)
    write_tiled(out, written, TILE_M, name="city")
    for each in written.values():
        shutil.rmtree(each)
    return out


def _served(city: MapBundle) -> BundleContent:
    """Return what requests read of the city, without its streets."""
    content = content_of(city)
    return replace(
        content,
        place_street=np.full(len(content.T_map_place), -1, np.int32),
        streets=None,
        cloud=city.cloud,
        statistics=None,
        preview_webp=b"",
    )


def _moved(content: BundleContent, shift: NDArray[np.float64]) -> BundleContent:
    """Return the content at another position."""
    T_map_place, cloud = np.array(content.T_map_place), content.cloud
    T_map_place[:, :2, 3] += shift
    if isinstance(cloud, SurfelMap):
        cloud = replace(cloud, origin_m=cloud.origin_m + np.array([*shift, 0.0]))
    return replace(content, T_map_place=T_map_place, cloud=cloud)
