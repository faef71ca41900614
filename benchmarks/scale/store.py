"""Maps in object storage: an S3 server on loopback (moto) beside the same map on the disk."""

import os
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.report import Report
from benchmarks.scale.s3_server import BUCKET, s3_server
from model_training.datasets.dataset import Dataset
from service.localization.localizer import Localizer
from service.maps.manifest import LARGEST_TILE_M, Manifest, read_manifest
from service.maps.store.cache import TileCache
from service.maps.store.stored_map import StoredMap
from service.maps.store.transfer import push
from service.maps.tiled_writer import write_tiled
from service.maps.tiles import TiledMap, TileSource
from service.retrieval.prior import Prior
from service.retrieval.query import Query

#: Rows with a bar, and their limits.
WARM, COLD = ("store.s3_over_local_p99", 1.1), ("store.cold_first_request_s", 1.5)
#: Fetches of a tile into an empty cache, first requests, and requests of each side with a warm cache.
_FETCHES, _FIRST, _REQUESTS = 5, 5, 200
_CACHE_BYTES = 20 * 10**9


def store_rows(report: Report, path: Path, dataset: Dataset, work: Path) -> None:
    """Add the rows.

    Args:
        report: collects the rows.
        path: a map, tiled or not. A map of one bundle becomes a map of one tile.
        dataset: of the map, with queries whose poses are known.
        work: folder for the cache, which is removed again.
    """
    work = work / "store"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    if not read_manifest(path).tiles:
        write_tiled(work / "map", {(0, 0): path}, LARGEST_TILE_M, name=read_manifest(path).name)
        path = work / "map"
    try:
        with s3_server() as environment, _variables(environment):
            url = f"s3://{BUCKET}/map"
            began = time.perf_counter()
            size = push(path, url).size
            report.row("store.push_mb_per_s", size / 1e6 / (time.perf_counter() - began), "MB/s", n=size)
            _fetch_rows(report, url, work)
            _request_rows(report, url, path, _queries(dataset, path), work)
    finally:
        shutil.rmtree(work)


def _stored(url: str, folder: Path) -> tuple[Path, Manifest, TileSource]:
    """Return the folder of the current version in an empty cache, its manifest and its tiles."""
    shutil.rmtree(folder, ignore_errors=True)
    stored = StoredMap(url, TileCache(folder, _CACHE_BYTES))
    stored.refresh()
    (version,) = stored.versions()
    return version, read_manifest(version), stored.tiles(version)


def _fetch_rows(report: Report, url: str, work: Path) -> None:
    seconds, size = [], 0
    for _ in range(_FETCHES):
        _, manifest, tiles = _stored(url, work / "cache")
        tile = max(manifest.tiles, key=lambda each: each.size)
        began = time.perf_counter()
        folder = tiles.folder(tile)
        seconds.append(time.perf_counter() - began)
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    took = float(np.median(seconds))
    report.row(
        "store.fetch_tile_s", took, "s", n=_FETCHES, why=f"a tile of {size / 1e6:.0f} MB, without the sums of voxels"
    )
    report.row("store.fetch_mb_per_s", size / 1e6 / took, "MB/s", n=_FETCHES)


def _request_rows(report: Report, url: str, path: Path, queries: Sequence[Query], work: Path) -> None:
    first = []
    for query in queries[:_FIRST]:
        version, manifest, tiles = _stored(url, work / "cache")
        localizer = Localizer.open(_serving(TiledMap.open(version, source=tiles)))
        began = time.perf_counter()
        localizer.localize(query)
        first.append(time.perf_counter() - began)
    tile_mb = max(tile.size for tile in manifest.tiles) / 1e6
    report.row(
        COLD[0],
        float(np.median(first)),
        "s",
        bar=COLD[1],
        better="lower",
        n=len(first),
        why=f"a query with a prior in a process that has the encoder and the shared files; the largest tile has {tile_mb:.0f} MB",
    )
    stored, local = localizer, Localizer.open(_serving(TiledMap.open(path)))
    took: dict[str, list[float]] = {"local": [], "s3": []}
    for number in range(-len(queries), _REQUESTS):  # the first round warms up
        query = queries[number % len(queries)]
        sides = [("local", local), ("s3", stored)]
        for name, side in sides if number % 2 else reversed(sides):
            began = time.perf_counter()
            side.localize(query)
            if number >= 0:
                took[name].append(time.perf_counter() - began)
    p99 = {name: float(np.quantile(each, 0.99)) for name, each in took.items()}
    for name, value in p99.items():
        report.row(f"store.{name}_p99_ms", 1e3 * value, "ms", n=_REQUESTS)
    report.row(WARM[0], p99["s3"] / p99["local"], "ratio", bar=WARM[1], better="lower", n=_REQUESTS)


def _serving(opened: TiledMap) -> TiledMap:
    """Return a map that prepares the tiles around a query, as in a service."""
    opened.tiles.opens_ahead = True
    return opened


def _queries(dataset: Dataset, path: Path) -> list[Query]:
    """Return queries with a prior at their true positions."""
    grid, found = read_manifest(path).view_grid, []
    for name in dataset.query_sets(with_truth=True)[:1]:
        for frame in list(dataset.queries(name))[:20]:
            if frame.T_map_camera is not None:
                prior = Prior(position_m=frame.T_map_camera[:2, 3], position_std_m=5.0)
                found.append(replace(frame.query(grid), prior=prior))
    return found


@contextmanager
def _variables(environment: dict[str, str]) -> Iterator[None]:
    before = dict(os.environ)
    os.environ.update(environment)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
