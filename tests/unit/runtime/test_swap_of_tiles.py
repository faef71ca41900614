"""A new version of a tiled map checks only the tiles that it changed."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from service.localization.localizer import Localizer
from service.maps import files
from service.maps.content import BundleContent
from service.maps.manifest import TILES_FOLDER, Manifest
from service.maps.store.cache import TileCache
from service.maps.store.remote import Remote
from service.maps.store.stored_map import StoredMap
from service.maps.store.transfer import push
from service.maps.tiled_writer import write_tiled
from service.maps.tiles import TiledMap
from service.maps.writer import write_bundle
from service.runtime.engine import warm_up
from service.runtime.map_registry import MapRegistry
from service.runtime.map_watcher import MapWatcher
from tests.unit.lattice import as_tile

Content = Callable[..., BundleContent]
Write = Callable[[str, list[int]], Manifest]


@pytest.fixture
def write(tmp_path: Path, content_of: Content, encoder_of: Callable[..., bytes]) -> Write:
    """Write a version with the tiles of some seeds. The files of a tile are links to the same files in all versions."""
    encoder = encoder_of()

    def version(name: str, seeds: list[int]) -> Manifest:
        squares = {}
        for column, seed in enumerate(seeds):
            squares[column, 0] = tmp_path / "made" / str(seed)
            if not squares[column, 0].exists():
                write_bundle(squares[column, 0], as_tile(content_of(seed=seed, encoder=encoder)))
        return write_tiled(tmp_path / "maps" / name, squares, 100.0, name="town")

    return version


@pytest.fixture
def hashed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Versions of the tiles whose files are hashed, one entry for each file."""
    found: list[str] = []
    hash_of = files._hash_of

    def counted(file: Path) -> str:
        if TILES_FOLDER in file.parts:
            found.append(file.parts[file.parts.index(TILES_FOLDER) + 1])
        return hash_of(file)

    monkeypatch.setattr(files, "_hash_of", counted)
    return found


def served(registry: MapRegistry) -> str:
    return registry.get("town").bundle.manifest.version


def watcher_on(registry: MapRegistry, folder: Path) -> MapWatcher:
    return MapWatcher(registry, [folder], warm=lambda each: warm_up(0.01, each))  # opens all tiles of a small map


def test_only_the_changed_tile_is_hashed_after_a_swap(write: Write, hashed: list[str], tmp_path: Path) -> None:
    first = write("v1", [1, 2, 3])
    registry = MapRegistry()
    watcher = watcher_on(registry, tmp_path / "maps")
    watcher.open_first()
    files_of_tile = len(hashed) // 3
    assert {version: hashed.count(version) for version in hashed} == {
        tile.version: files_of_tile for tile in first.tiles
    }
    hashed.clear()
    second = write("v2", [1, 2, 4])
    watcher.scan()
    assert served(registry) == second.version
    (changed,) = {tile.version for tile in second.tiles} - {tile.version for tile in first.tiles}
    assert hashed == [changed] * files_of_tile


def test_a_file_that_was_replaced_meanwhile_is_hashed_and_refused(
    write: Write, hashed: list[str], tmp_path: Path
) -> None:
    first = write("v1", [1, 2])
    registry = MapRegistry()
    watcher = watcher_on(registry, tmp_path / "maps")
    watcher.open_first()
    write("v2", [1, 3])
    damaged = tmp_path / "maps" / "v2" / first.tiles[0].folder / "views.npy"
    content = bytearray(damaged.read_bytes())
    content[-1] ^= 1
    damaged.unlink()  # it is a hard link
    damaged.write_bytes(content)
    (event,) = watcher.scan()
    assert "views.npy: the hash does not match the manifest" in event
    assert served(registry) == first.version


def test_a_copy_of_an_unchanged_tile_is_hashed_again(write: Write, hashed: list[str], tmp_path: Path) -> None:
    """The knowledge is about files, not about the names of versions."""
    first = write("v1", [1, 2])
    registry = MapRegistry()
    watcher = watcher_on(registry, tmp_path / "maps")
    watcher.open_first()
    second = write(".v2", [1, 3])
    shutil.copytree(tmp_path / "maps" / ".v2", tmp_path / "maps" / "v2")
    hashed.clear()
    watcher.scan()
    assert served(registry) == second.version
    assert set(hashed) == {tile.version for tile in second.tiles}
    assert first.tiles[0].version in hashed


def test_a_stored_map_hashes_each_cached_tile_once_and_fetches_only_the_changed_one(
    write: Write, hashed: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"file://{tmp_path}/store/town"

    def service() -> tuple[MapRegistry, MapWatcher]:
        registry = MapRegistry()
        stored = StoredMap(url, TileCache(tmp_path / "cache", 10**9))
        return registry, MapWatcher(registry, [], warm=lambda each: warm_up(0.01, each), stored=[stored])

    first = write("v1", [1, 2])
    push(tmp_path / "maps" / "v1", url)
    service()[1].open_first()
    assert hashed == []  # the fetch has compared the hashes
    registry, watcher = service()  # another process finds the tiles in the cache
    watcher.open_first()
    assert set(hashed) == {tile.version for tile in first.tiles}
    hashed.clear()
    fetched: list[str] = []
    save = Remote.save
    monkeypatch.setattr(
        Remote, "save", lambda self, name, *rest, **named: fetched.append(name) or save(self, name, *rest, **named)
    )
    second = write("v2", [1, 3])
    push(tmp_path / "maps" / "v2", url)
    watcher.scan()
    assert served(registry) == second.version
    assert hashed == []
    (changed,) = {tile.version for tile in second.tiles} - {tile.version for tile in first.tiles}
    assert {name.split("/")[1] for name in fetched if name.startswith(TILES_FOLDER)} == {changed}


def test_tiles_are_opened_ahead_after_the_warm_up(write: Write, tmp_path: Path) -> None:
    """The warm-up is a random query, and nobody drives there."""
    write("v1", [1, 2])
    registry, seen = MapRegistry(), []

    def warm(localizer: Localizer) -> None:
        assert isinstance(localizer.bundle, TiledMap)
        seen.append(localizer.bundle.tiles.opens_ahead)

    watcher = MapWatcher(registry, [tmp_path / "maps"], warm=warm)
    watcher.open_first()
    assert seen == [False]
    opened = registry.get("town").bundle
    assert isinstance(opened, TiledMap)
    assert opened.tiles.opens_ahead
