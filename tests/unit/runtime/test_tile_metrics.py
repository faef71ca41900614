"""Metrics of the cache of maps in object storage."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from service.maps.content import BundleContent
from service.maps.store.transfer import push
from service.maps.tiled_writer import write_tiled
from service.maps.tiles import TiledMap
from service.maps.writer import write_bundle
from service.runtime.engine import Engine
from service.runtime.settings import MapUrl, Settings
from tests.unit.lattice import as_tile

REQUESTS = "streetfix_tile_requests_total"


def values(text: str) -> dict[tuple[str, ...], float]:
    """Return every sample by its name and the values of its labels, in the order of their names."""
    return {
        (each.name, *(value for _, value in sorted(each.labels.items()))): each.value
        for family in text_string_to_metric_families(text)
        for each in family.samples
    }


@pytest.fixture
def town(tmp_path: Path, content_of: Callable[..., BundleContent], encoder_of: Callable[..., bytes]) -> str:
    """The URL of a map with three tiles."""
    encoder, squares = encoder_of(), {}
    for number in range(3):
        squares[number, 0] = tmp_path / "made" / str(number)
        write_bundle(squares[number, 0], as_tile(content_of(seed=number, encoder=encoder)))
    write_tiled(tmp_path / "town", squares, 100.0, name="town")
    push(tmp_path / "town", f"file://{tmp_path}/store/town")
    return f"file://{tmp_path}/store/town"


def test_requests_and_fetches_of_tiles_are_counted(town: str, tmp_path: Path) -> None:
    engine = Engine.open(Settings(maps=(MapUrl(town),), tile_cache=tmp_path / "cache", threads=1))
    try:
        found = values(engine.metrics.text().decode())
        # The warm-up opens the three tiles of this small map. Labels: cache, caller.
        assert found[REQUESTS, "miss", "query"] == found["streetfix_cached_tiles", "town"] == 3
        assert found[REQUESTS, "hit", "query"] == found[REQUESTS, "hit", "prefetch"] == 0
        assert found["streetfix_fetch_seconds_count", "tile"] == 3
        assert found["streetfix_fetch_seconds_count", "map"] == 1
        (opened,) = (each.bundle for each in engine.registry)
        assert isinstance(opened, TiledMap)
        (folder,) = (tmp_path / "cache").glob("town-*")
        files = [file for file in (folder / "tiles").rglob("*") if file.is_file() and file.name != "manifest.json"]
        fetched = sum(file.stat().st_size for file in files if file.stat().st_nlink == 1)  # the others are shared files
        assert found["streetfix_fetch_bytes_total", "tile"] == fetched > 0
        tiles = opened.manifest.tiles
        shutil.rmtree(folder / tiles[0].folder)
        for number, ahead in ((0, True), (0, True), (1, False), (2, False)):
            opened.tiles._source.folder(tiles[number], ahead=ahead)
        found = values(engine.metrics.text().decode())
        assert found[REQUESTS, "miss", "prefetch"] == found[REQUESTS, "hit", "prefetch"] == 1
        assert (found[REQUESTS, "miss", "query"], found[REQUESTS, "hit", "query"]) == (3, 2)
        shutil.rmtree(folder / tiles[2].folder)
        (folder / "tiles" / ".being-fetched.partial").mkdir()
        assert values(engine.metrics.text().decode())["streetfix_cached_tiles", "town"] == 2
    finally:
        engine.close()


def test_a_service_of_folders_has_the_series_at_zero_and_no_cache(bundle_path: Path) -> None:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1))
    try:
        found = values(engine.metrics.text().decode())
    finally:
        engine.close()
    names = ("streetfix_tile_requests_total", "streetfix_fetch_bytes_total", "streetfix_fetch_seconds_count")
    assert {key[0]: value for key, value in found.items() if key[0] in names} == dict.fromkeys(names, 0)
    assert not any(name == "streetfix_cached_tiles" for name, *_ in found)


COUNTS = """
from service.runtime.tile_metrics import TileMetrics
metrics = TileMetrics()
metrics.requested(False, False)
metrics.requested(True, True)
metrics.fetched("tile", 100, 0.5)
"""
SCRAPES = """
import sys
from service.runtime.engine import Engine
from service.runtime.map_registry import MapRegistry
from service.runtime.settings import Settings
engine = Engine(MapRegistry(), Settings(threads=1))
sys.stdout.write(engine.metrics.text().decode())
engine.close()
"""


def test_the_metrics_of_workers_are_added_up(tmp_path: Path) -> None:
    environment = {**os.environ, "PROMETHEUS_MULTIPROC_DIR": str(tmp_path)}
    told = [
        subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
        for program in (COUNTS, COUNTS, SCRAPES)
    ]
    found = values(told[-1].stdout)
    assert found[REQUESTS, "miss", "query"] == found[REQUESTS, "hit", "prefetch"] == 2
    assert found["streetfix_fetch_bytes_total", "tile"] == 200
    assert (found["streetfix_fetch_seconds_count", "tile"], found["streetfix_fetch_seconds_sum", "tile"]) == (2, 1)


OPENS = """
import sys
from pathlib import Path
from service.runtime.engine import Engine
from service.runtime.settings import Settings
engine = Engine.open(Settings(maps=(Path(sys.argv[1]),), threads=1))
"""


def test_the_open_tiles_of_workers_are_added_up(town: str, tmp_path: Path) -> None:
    """The warm-up of each worker opens the three tiles."""
    shared = tmp_path / "counts"
    shared.mkdir()
    environment = {**os.environ, "PROMETHEUS_MULTIPROC_DIR": str(shared)}
    told = [
        subprocess.run(
            [sys.executable, "-c", program, str(tmp_path / "town")],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        for program in (OPENS, OPENS, SCRAPES)
    ]
    assert values(told[-1].stdout)["streetfix_open_tiles", "town"] == 6


def test_open_tiles_are_counted_when_they_open_and_close_and_are_zero_without_their_map(
    town: str, tmp_path: Path
) -> None:
    del town
    engine = Engine.open(Settings(maps=(tmp_path / "town",), threads=1))

    def counted() -> float:
        return values(engine.metrics.text().decode())["streetfix_open_tiles", "town"]

    try:
        (opened,) = (each.bundle for each in engine.registry)
        assert isinstance(opened, TiledMap)
        assert opened.open_tiles == counted() == 3
        del opened.tiles._opened[2]
        opened.tiles._limit = 1
        opened.tiles.get(2)
        assert opened.open_tiles == counted() == 1
        engine.registry.unmount("town", opened.manifest.version)
        assert len(engine.registry) == 0
        assert counted() == 0
    finally:
        engine.close()
