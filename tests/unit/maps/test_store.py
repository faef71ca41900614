"""Maps in object storage: an S3 server over a socket, and files."""

import errno
import hashlib
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.scale.s3_server import BUCKET, CREDENTIALS
from service.errors import BundleError, ExtraMissingError
from service.maps.ahead import Ahead
from service.maps.checked_tiles import Checked, mark_of
from service.maps.content import NOT_SERVED, BundleContent
from service.maps.manifest import Manifest, Tile, read_manifest
from service.maps.reader import MapBundle
from service.maps.store import cache as cache_module
from service.maps.store import fetch, remote, transfer
from service.maps.store.cache import TileCache
from service.maps.store.remote import Remote, checked_url, split_version
from service.maps.store.stored_map import UNUSED_S, StoredMap, StoreTiles
from service.maps.store.transfer import pull, push
from service.maps.tiled_writer import write_tiled
from service.maps.tiles import MOST_SEARCHED, TiledMap, TileSource
from service.maps.writer import write_bundle
from tests.unit.lattice import as_tile

Content = Callable[..., BundleContent]


def write_tiled_map(out: Path, content_of: Content, encoder: bytes, *, tiles: int = 3) -> Manifest:
    """Tiles that differ in their descriptors."""
    squares = {}
    for number in range(tiles):
        squares[number, 0] = out.parent / f"{out.name}-tiles" / str(number)
        write_bundle(
            squares[number, 0], as_tile(content_of(seed=number + 1, encoder=encoder, preview_webp=b"a picture"))
        )
    return write_tiled(out, squares, 100.0, name="town")


@pytest.fixture(scope="module")
def town(content_of: Content, encoder_of: Callable[..., bytes], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiled map that tests only read."""
    path = tmp_path_factory.mktemp("tiled") / "town"
    write_tiled_map(path, content_of, encoder_of())
    return path


@pytest.fixture(params=["s3", "file"])
def url(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A place for a map, on the server or on the disk."""
    if request.param == "file":
        return f"file://{tmp_path}/store/town"
    for key, value in request.getfixturevalue("s3").items():
        monkeypatch.setenv(key, value)
    return f"s3://{BUCKET}/{tmp_path.name}/town"


@pytest.fixture
def file_url(tmp_path: Path) -> str:
    return f"file://{tmp_path}/store/town"


@pytest.fixture
def cache(tmp_path: Path) -> TileCache:
    return TileCache(tmp_path / "cache", 10**9)


def store_of(file_url: str) -> Path:
    return Path(file_url.removeprefix("file://"))


def stored(url: str, cache: TileCache) -> tuple[StoredMap, Path, Manifest, StoreTiles]:
    """A map that the cache has just met, the folder of its version, its manifest and its tiles."""
    found = StoredMap(url, cache)
    found.refresh()
    (version,) = [each for each in found.folder.iterdir() if (each / "manifest.json").exists()]
    return found, version, read_manifest(version), found.tiles(version)


def stored_all(url: str, cache: TileCache) -> tuple[StoredMap, list[Path]]:
    """A map with all its versions in the cache."""
    found = StoredMap(url, cache)
    found.refresh()
    return found, found.versions()


def same_files(one: Path, other: Path) -> bool:
    files = [sorted(each.relative_to(root) for each in root.rglob("*") if each.is_file()) for root in (one, other)]
    return files[0] == files[1] and all((one / each).read_bytes() == (other / each).read_bytes() for each in files[0])


def versions_in(tiles: Path) -> set[str]:
    return {each.name.partition("-")[0] for each in tiles.iterdir()}


class Row:
    """A search that lists the first views, in place of a server."""

    def __init__(self, of_map: Manifest) -> None:
        self.views = of_map.counts.views

    def most_similar(self, _: Any, k: int) -> Any:
        return np.arange(min(k, self.views))

    def shortlist(self, *_: Any) -> Any:
        raise AssertionError("no query asks for it")


def left_over(folder: Path) -> list[Path]:
    return [each for each in folder.rglob("*") if each.name.endswith((".partial", ".deleted"))]


class TestPushAndPull:
    def test_a_tiled_map_comes_back_as_it_was(self, town: Path, url: str, tmp_path: Path) -> None:
        sent = push(town, url)
        assert (sent.tiles, sent.kept) == (3, 0)
        got = pull(url, tmp_path / "back")
        assert same_files(town, tmp_path / "back")
        assert got.tiles == 3
        manifest = read_manifest(town)
        shared = sum(entry.size for entry in manifest.files.values())
        assert got.size == sent.size == shared + sum(tile.size for tile in manifest.tiles)

    def test_a_map_of_one_bundle_comes_back_as_it_was(self, bundle_path: Path, url: str, tmp_path: Path) -> None:
        push(bundle_path, url)
        pull(url, tmp_path / "back")
        assert same_files(bundle_path, tmp_path / "back")
        MapBundle.open(tmp_path / "back")

    def test_a_second_push_sends_nothing(self, town: Path, url: str) -> None:
        push(town, url)
        again = push(town, url)
        assert (again.tiles, again.kept, again.size) == (0, 3, 0)

    def test_only_new_tiles_are_sent_and_the_old_version_stays(
        self, town: Path, url: str, content_of: Content, encoder_of: Callable[..., bytes], tmp_path: Path
    ) -> None:
        push(town, url)
        larger = write_tiled_map(tmp_path / "larger", content_of, encoder_of(), tiles=4)
        sent = push(tmp_path / "larger", url)
        # Tiles that were built again have another date in their manifests, but the same version.
        assert sent.tiles + sent.kept == 4
        store = Remote.open(url)
        assert store.read_if_there("manifest.json") == larger.to_bytes()
        old = read_manifest(town)
        assert store.read_if_there(f"versions/{old.version}/manifest.json") == old.to_bytes()

    def test_a_tile_that_was_built_again_damages_no_earlier_version(
        self,
        town: Path,
        url: str,
        content_of: Content,
        encoder_of: Callable[..., bytes],
        tmp_path: Path,
        cache: TileCache,
    ) -> None:
        """Its content is the same, and so is its version. Its manifest has another date."""
        push(town, url)
        _, old, before, old_tiles = stored(url, cache)
        again = write_tiled_map(tmp_path / "again", content_of, encoder_of())
        assert again.tiles == before.tiles
        assert again.version == before.version
        assert push(tmp_path / "again", url).size == 0
        pull(url, tmp_path / "back")
        assert read_manifest(tmp_path / "back").made_at == again.made_at
        for number in range(3):
            TiledMap.open(old, source=old_tiles).tiles.get(number)

    def test_progress_ends_at_the_size_of_the_map(
        self, town: Path, file_url: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        seen: list[tuple[str, int, int]] = []
        monkeypatch.setattr(transfer, "_MB", 1000)
        push(town, file_url, report=lambda *each: seen.append(each))
        assert seen[-1][0] == "push (MB)"
        assert seen[-1][1] == seen[-1][2] > 0
        assert [done for _, done, _ in seen] == sorted(done for _, done, _ in seen)

    def test_the_manifests_are_stored_last(self, town: Path, file_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
        names: list[str] = []
        put = Remote.put
        monkeypatch.setattr(Remote, "put", lambda self, name, content: names.append(name) or put(self, name, content))
        push(town, file_url)
        assert names[-1] == "manifest.json"
        for tile in read_manifest(town).tiles:
            last = max(number for number, name in enumerate(names) if name.startswith(tile.folder))
            assert names[last] == f"{tile.folder}/manifest.json"

    def test_a_killed_push_continues(self, town: Path, url: str, tmp_path: Path) -> None:
        """The process is killed after the first tile."""
        program = (
            "import os, signal, sys\n"
            "from pathlib import Path\n"
            "from service.maps.store.remote import Remote\n"
            "from service.maps.store.transfer import push\n"
            "put, done = Remote.put, []\n"
            "def counted(self, name, content):\n"
            "    put(self, name, content)\n"
            "    done.append(name)\n"
            "    if sum(each.endswith('manifest.json') for each in done) == 1 and len(done) > 12:\n"
            "        os.kill(os.getpid(), signal.SIGKILL)\n"
            "Remote.put = counted\n"
            "push(Path(sys.argv[1]), sys.argv[2])\n"
        )
        ended = subprocess.run([sys.executable, "-c", program, str(town), url], capture_output=True, text=True)
        assert ended.returncode == -9, ended.stderr
        with pytest.raises(BundleError, match=r"manifest\.json is missing in the store"):
            pull(url, tmp_path / "early")
        sent = push(town, url)
        assert (sent.tiles, sent.kept) == (2, 1)
        pull(url, tmp_path / "back")
        assert same_files(town, tmp_path / "back")

    def test_an_interrupted_pull_continues(self, town: Path, file_url: str, tmp_path: Path) -> None:
        push(town, file_url)
        last = read_manifest(town).tiles[-1]
        broken = store_of(file_url) / last.folder / "places.npy"
        whole = broken.read_bytes()
        broken.write_bytes(whole[:-1] + b"?")
        with pytest.raises(BundleError, match=r"places\.npy: the hash does not match"):
            pull(file_url, tmp_path / "back")
        assert not (tmp_path / "back").exists()
        broken.write_bytes(whole)
        got = pull(file_url, tmp_path / "back")
        assert (got.tiles, got.kept) == (1, 2)
        assert same_files(town, tmp_path / "back")
        assert not (tmp_path / ".back.pulling").exists()

    def test_a_pull_replaces_nothing(self, town: Path, file_url: str, tmp_path: Path) -> None:
        push(town, file_url)
        (tmp_path / "back").mkdir()
        with pytest.raises(BundleError, match="back: already exists; choose another folder"):
            pull(file_url, tmp_path / "back")

    def test_two_pulls_to_one_folder_do_not_mix(self, town: Path, file_url: str, tmp_path: Path) -> None:
        push(town, file_url)
        (tmp_path / ".back.pulling").mkdir()
        with (
            cache_module._locked(tmp_path / ".back.pulling"),
            pytest.raises(BundleError, match="another process pulls"),
        ):
            pull(file_url, tmp_path / "back")

    def test_a_damaged_map_is_not_pushed(self, town: Path, file_url: str, tmp_path: Path) -> None:
        shutil.copytree(town, tmp_path / "own")
        tile = read_manifest(town).tiles[1]
        (tmp_path / "own" / tile.folder / "views.npy").write_bytes(b"damaged")
        with pytest.raises(BundleError, match=r"views\.npy: size or hash do not match"):
            push(tmp_path / "own", file_url)
        assert not (store_of(file_url) / "manifest.json").exists()
        assert not (store_of(file_url) / tile.folder / "manifest.json").exists()

    def test_a_folder_that_another_tool_copied_can_be_read(self, town: Path, tmp_path: Path, cache: TileCache) -> None:
        shutil.copytree(town, tmp_path / "store" / "town")
        _, _, manifest, tiles = stored(f"file://{tmp_path}/store/town", cache)
        MapBundle.open(tiles.folder(manifest.tiles[0]))


class TestTiles:
    def test_a_tile_is_fetched_when_it_is_needed(self, town: Path, url: str, cache: TileCache) -> None:
        push(town, url)
        found, version, manifest, tiles = stored(url, cache)
        assert manifest == read_manifest(town)
        assert not (found.folder / "tiles").exists()
        folder = tiles.folder(manifest.tiles[1])
        assert list((found.folder / "tiles").iterdir()) == [folder]
        assert not (version / "tiles").exists()
        opened = MapBundle.open(folder)
        assert opened.manifest == read_manifest(town / manifest.tiles[1].folder)
        assert opened.cloud is not None

    def test_a_tiled_map_opens_its_tiles_from_the_store(self, town: Path, url: str, cache: TileCache) -> None:
        push(town, url)
        _, version, manifest, tiles = stored(url, cache)
        assert isinstance(tiles, TileSource)
        opened, expected = TiledMap.open(version, source=tiles), TiledMap.open(town)
        assert opened.tiles.get(2).manifest == expected.tiles.get(2).manifest
        assert list((version.parent / "tiles").iterdir()) == [tiles.folder(manifest.tiles[2])]

    def test_a_tile_that_is_deleted_before_it_was_opened_is_fetched_again(
        self, town: Path, file_url: str, cache: TileCache, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        push(town, file_url)
        _, version, _, tiles = stored(file_url, cache)
        folder, times = tiles.folder, iter([True, False])

        def deleted(tile: Tile, **how: bool) -> Path:
            found = folder(tile, **how)
            if next(times):
                cache.delete(found)
            return found

        monkeypatch.setattr(tiles, "folder", deleted)
        TiledMap.open(version, source=tiles).tiles.get(0)

    def test_files_that_the_service_does_not_read_are_left_out(
        self, town: Path, file_url: str, cache: TileCache
    ) -> None:
        push(town, file_url)
        _, _, manifest, tiles = stored(file_url, cache)
        assert "preview.webp" in NOT_SERVED
        assert "preview.webp" in read_manifest(town / manifest.tiles[0].folder).files
        assert not (tiles.folder(manifest.tiles[0]) / "preview.webp").exists()

    def test_files_that_the_map_shares_are_links(self, town: Path, file_url: str, cache: TileCache) -> None:
        push(town, file_url)
        for tile in read_manifest(town).tiles:
            (store_of(file_url) / tile.folder / "encoder.onnx").unlink()
        _, version, manifest, tiles = stored(file_url, cache)
        assert (tiles.folder(manifest.tiles[0]) / "encoder.onnx").samefile(version / "encoder.onnx")

    def test_a_fetched_tile_is_not_fetched_again(self, town: Path, file_url: str, cache: TileCache) -> None:
        push(town, file_url)
        _, _, manifest, tiles = stored(file_url, cache)
        tiles.folder(manifest.tiles[0])
        shutil.rmtree(store_of(file_url))
        MapBundle.open(tiles.folder(manifest.tiles[0]))

    @pytest.mark.parametrize(
        ("damage", "told"),
        [
            (lambda file: file.write_bytes(b"?" + file.read_bytes()[1:]), "the hash does not match the manifest"),
            (lambda file: file.write_bytes(file.read_bytes() + b"more"), r"\d+ bytes instead of \d+"),
            (lambda file: file.write_bytes(file.read_bytes()[:-1]), r"\d+ bytes instead of \d+"),
            (lambda file: file.unlink(), "is missing in the store"),
        ],
        ids=["hash", "larger", "smaller", "missing"],
    )
    @pytest.mark.parametrize("name", ["places.npy", "cloud/surfels.npy"])
    def test_a_damaged_file_leaves_no_tile(
        self, town: Path, file_url: str, cache: TileCache, damage: Callable[[Path], object], told: str, name: str
    ) -> None:
        push(town, file_url)
        found, _, manifest, tiles = stored(file_url, cache)
        tile = manifest.tiles[0]
        file = store_of(file_url) / tile.folder / name
        whole = file.read_bytes()
        damage(file)
        with pytest.raises(BundleError, match=rf"{file_url}/{tile.folder}/{name}:? {told}.*streetfix map push"):
            tiles.folder(tile)
        assert list((found.folder / "tiles").iterdir()) == []
        file.write_bytes(whole)
        MapBundle.open(tiles.folder(tile))

    def test_another_manifest_of_a_tile_is_refused(self, town: Path, file_url: str, cache: TileCache) -> None:
        push(town, file_url)
        _, _, manifest, tiles = stored(file_url, cache)
        one, other = manifest.tiles[:2]
        shutil.copyfile(
            store_of(file_url) / other.folder / "manifest.json", store_of(file_url) / one.folder / "manifest.json"
        )
        with pytest.raises(BundleError, match=r"manifest\.json: not the bundle of tile 0 0, which the map lists"):
            tiles.folder(one)

    @pytest.mark.parametrize("name", ["../../outside", "/srv/outside", "tiles/0123456789abcdef/places.npy"])
    def test_a_manifest_cannot_write_elsewhere(
        self, town: Path, file_url: str, cache: TileCache, tmp_path: Path, name: str
    ) -> None:
        push(town, file_url)
        document = json.loads((store_of(file_url) / "manifest.json").read_text())
        document["files"][name] = document["files"]["streets.geojson"]
        forged = Manifest.model_validate(document).stamped().to_bytes()
        (store_of(file_url) / "manifest.json").write_bytes(forged)
        with pytest.raises(BundleError, match=r"outside the bundle|in the folder of the tiles"):
            StoredMap(file_url, cache).refresh()
        assert not list(cache.folder.rglob("outside"))
        with pytest.raises(BundleError, match=r"outside the bundle|in the folder of the tiles"):
            pull(file_url, tmp_path / "back")

    def test_a_tile_cannot_write_elsewhere(self, town: Path, file_url: str, cache: TileCache) -> None:
        push(town, file_url)
        found, _, manifest, tiles = stored(file_url, cache)
        tile = manifest.tiles[0]
        path = store_of(file_url) / tile.folder / "manifest.json"
        document = json.loads(path.read_text())
        document["files"]["../outside.npy"] = document["files"]["places.npy"]
        data = Manifest.model_validate(document).stamped().to_bytes()
        path.write_bytes(data)
        with pytest.raises(BundleError, match="outside the bundle"):
            tiles.folder(tile)
        assert list((found.folder / "tiles").iterdir()) == []


class TestBound:
    def bounded(self, town: Path, file_url: str, tmp_path: Path, tiles: float) -> tuple[StoreTiles, Manifest, Path]:
        """A cache for a number of tiles."""
        push(town, file_url)
        roomy = TileCache(tmp_path / "roomy", 10**9)
        found, _, manifest, source = stored(file_url, roomy)
        source.folder(manifest.tiles[0])
        size = cache_module._Kept.of(source.folder(manifest.tiles[0])).size
        found, _, _, source = stored(file_url, TileCache(tmp_path / "cache", int(size * tiles)))
        return source, manifest, found.folder / "tiles"

    def test_the_least_recently_used_tile_makes_room(self, town: Path, file_url: str, tmp_path: Path) -> None:
        tiles, manifest, folder = self.bounded(town, file_url, tmp_path, 2.5)
        for tile in (0, 1, 0, 2):  # 0 is used again, so 1 goes
            tiles.folder(manifest.tiles[tile])
            time.sleep(0.02)
        assert versions_in(folder) == {manifest.tiles[tile].version for tile in (0, 2)}
        tiles.folder(manifest.tiles[1])
        assert versions_in(folder) == {manifest.tiles[tile].version for tile in (1, 2)}

    def test_tiles_are_counted_only_if_their_size_is_unknown_or_there_is_no_room(
        self, town: Path, file_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        tiles, manifest, folder = self.bounded(town, file_url, tmp_path, 2.5)
        counted: list[str] = []
        count = cache_module._Kept.of
        monkeypatch.setattr(cache_module._Kept, "of", lambda path: counted.append(path.name) or count(path))
        lock = tmp_path / "cache" / ".lock"

        def counts(tile: int) -> int:
            """Return how many folders the fetch of a tile counts: those that are there, and that of the new tile."""
            counted.clear()
            tiles.folder(manifest.tiles[tile])
            found = len(counted)
            assert int(lock.read_text()) == sum(count(each).size for each in folder.iterdir())
            return found

        assert counts(0) == 1
        assert counts(1) == 0
        assert counts(2) == 3  # no room
        assert len(list(folder.iterdir())) == 2
        shutil.rmtree(tiles.folder(manifest.tiles[2]))
        tiles._cache.delete(tmp_path / "cache" / "another-version")
        assert lock.read_text() == ""
        assert counts(2) == 2
        lock.write_text("")  # an earlier release empties the file
        tiles._cache.delete(tiles.folder(manifest.tiles[1]))
        assert counts(1) == 2

    def test_a_full_cache_is_freed_a_little_beyond_what_a_tile_needs(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A bound of 1,000 bytes, tiles of 10 bytes: every third fetch into the full cache counts, and frees 10 + 20 bytes."""
        cache = TileCache(tmp_path, 1000)
        counted, count = [], cache_module._Kept.of
        monkeypatch.setattr(cache_module._Kept, "of", lambda path: counted.append(path) or count(path))
        walks = []
        for number in range(109):
            counted.clear()
            cache.once(tmp_path / "town" / "tiles" / str(number), lambda into: cache.reserve(into, {"places.npy": 10}))
            os.utime(tmp_path / "town" / "tiles" / str(number), (number, number))
            if counted:
                walks.append(number)
        assert walks == [0, 100, 103, 106]
        left = {int(each.name) for each in (tmp_path / "town" / "tiles").iterdir()}
        assert left == set(range(9, 109))

    def test_a_deleted_tile_stays_readable_where_it_is_open(self, town: Path, file_url: str, tmp_path: Path) -> None:
        tiles, manifest, folder = self.bounded(town, file_url, tmp_path, 1.5)
        opened = MapBundle.open(tiles.folder(manifest.tiles[0]))
        tiles.folder(manifest.tiles[1])
        assert versions_in(folder) == {manifest.tiles[1].version}
        expected = MapBundle.open(town / manifest.tiles[0].folder)
        assert (opened.T_map_place == expected.T_map_place).all()
        assert opened.cloud is not None
        assert expected.cloud is not None
        assert (opened.cloud.surfels == expected.cloud.surfels).all()

    def test_a_bound_below_a_tile_is_an_error_that_names_the_setting(
        self, town: Path, file_url: str, tmp_path: Path
    ) -> None:
        tiles, manifest, folder = self.bounded(town, file_url, tmp_path, 0.5)
        with pytest.raises(BundleError, match="STREETFIX_TILE_CACHE_BYTES"):
            tiles.folder(manifest.tiles[0])
        assert list(folder.iterdir()) == []

    def test_a_full_disk_leaves_nothing(
        self, town: Path, file_url: str, cache: TileCache, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        push(town, file_url)
        found, _, manifest, tiles = stored(file_url, cache)
        usage = shutil.disk_usage(cache.folder)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1000))
        with pytest.raises(
            BundleError, match=r"cache: the disk is full; free disk space, lower STREETFIX_TILE_CACHE_BYTES"
        ):
            tiles.folder(manifest.tiles[0])
        assert list((found.folder / "tiles").iterdir()) == []

    def test_what_a_killed_process_left_is_deleted_at_the_start(
        self, town: Path, file_url: str, cache: TileCache
    ) -> None:
        push(town, file_url)
        found, version, manifest, tiles = stored(file_url, cache)
        whole = tiles.folder(manifest.tiles[0])
        for name in (".0123456789abcdef.partial", ".0123456789abcdef.1-1.deleted", ".fedcba9876543210.partial"):
            (found.folder / "tiles" / name).mkdir()
            (found.folder / "tiles" / name / "places.npy").write_bytes(b"half")
        (found.folder / ".aaaa.partial").mkdir()
        with cache_module._locked(found.folder / "tiles" / ".fedcba9876543210.partial"):  # another process works on it
            cache.clean()
        assert {each.name for each in (found.folder / "tiles").iterdir()} == {whole.name, ".fedcba9876543210.partial"}
        assert {each.name for each in found.folder.iterdir()} == {version.name, "tiles"}

    def test_a_cache_that_nobody_may_write_is_an_error_that_names_the_setting(
        self, town: Path, file_url: str, tmp_path: Path
    ) -> None:
        push(town, file_url)
        (tmp_path / "cache").write_text("a file")
        with pytest.raises(BundleError, match="STREETFIX_TILE_CACHE"):
            StoredMap(file_url, TileCache(tmp_path / "cache", 10**9)).refresh()


def test_two_processes_fetch_each_file_once(town: Path, url: str, tmp_path: Path) -> None:
    push(town, url)
    script, begin = Path(__file__).with_name("fetch_tiles.py"), tmp_path / "begin"
    command = [sys.executable, str(script), url, str(tmp_path / "cache"), str(begin)]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    for each in processes:
        assert each.stdout is not None
        assert each.stdout.readline() == "ready\n"
    begin.touch()
    names = [name for each in processes for name in json.loads(each.communicate(timeout=60)[0])]
    assert [each.returncode for each in processes] == [0, 0]
    assert len(names) == len(set(names)) > 0
    assert left_over(tmp_path / "cache") == []


def test_threads_fetch_a_tile_once(
    town: Path, file_url: str, cache: TileCache, monkeypatch: pytest.MonkeyPatch
) -> None:
    push(town, file_url)
    _, _, manifest, tiles = stored(file_url, cache)
    names: list[str] = []
    save = Remote.save
    monkeypatch.setattr(
        Remote, "save", lambda self, name, *rest, **named: names.append(name) or save(self, name, *rest, **named)
    )
    threads = [threading.Thread(target=tiles.folder, args=(manifest.tiles[0],)) for _ in range(6)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert len(names) == len(set(names)) > 0


def test_who_fetched_a_tile_has_compared_its_hashes(town: Path, file_url: str, cache: TileCache) -> None:
    push(town, file_url)
    found, version, manifest, tiles = stored(file_url, cache)
    tile = manifest.tiles[0]
    folder = tiles.folder(tile)
    assert tiles.checked.get(tile.version, mark_of(folder)) == Checked.HASHES
    again = found.tiles(version)
    assert again.checked is tiles.checked  # all versions of a map share it
    TiledMap.open(version, source=again).tiles.get(0)
    assert tiles.checked.get(tile.version, mark_of(folder)) == Checked.ALL
    views = bytearray((folder / "views.npy").read_bytes())
    views[-1] ^= 1
    (folder / "views.npy").write_bytes(views)
    with pytest.raises(BundleError, match=r"views.npy: the hash does not match the manifest"):
        TiledMap.open(version, source=again).tiles.get(0)


def test_a_fetch_is_followed(town: Path, file_url: str, cache: TileCache) -> None:
    push(town, file_url)
    followed: dict[tuple[str, str, int], list[int]] = {}
    ended: list[str] = []

    @contextmanager
    def follow(kind: str, url: str, total: int) -> Iterator[Callable[[int], None]]:
        yield followed.setdefault((kind, url, total), []).append
        ended.append(kind)

    found = StoredMap(file_url, cache, follow)
    found.refresh()
    (version,) = found.versions()
    tiles, tile = found.tiles(version), read_manifest(version).tiles[0]
    tiles.folder(tile)
    tiles.folder(tile)  # from the cache
    assert [(kind, url) for kind, url, _ in followed] == [("map", file_url), ("tile", f"{file_url}/{tile.folder}")]
    assert ended == ["map", "tile"]
    for (_, _, total), sizes in followed.items():
        assert sum(sizes) == total > 0


def test_expected_tiles_are_fetched_in_the_background(town: Path, file_url: str, cache: TileCache) -> None:
    push(town, file_url)
    found, version, manifest, tiles = stored(file_url, cache)
    shutil.rmtree(store_of(file_url) / manifest.tiles[1].folder)  # a failure does not stop the others
    opened = TiledMap.open(version, source=tiles)
    prepare, done = opened.tiles._prepare, threading.Semaphore(0)

    def counted(number: int) -> None:
        try:
            prepare(number)
        finally:
            done.release()

    opened.tiles._ahead, opened.tiles.opens_ahead = Ahead(counted), True
    opened.expect_next(np.array([50.0, 50.0]), np.array([49.0, 50.0]))  # in tile 0, towards 1 and 2
    assert all(done.acquire(timeout=60) for _ in range(2))
    assert opened.tiles.opened == (2,)
    assert list((found.folder / "tiles").iterdir()) == [found.folder / manifest.tiles[2].folder]
    with pytest.raises(BundleError):
        opened.tiles.get(1)


def test_who_waited_for_a_failed_fetch_tries_itself(town: Path, file_url: str, cache: TileCache) -> None:
    push(town, file_url)
    found, _, manifest, tiles = stored(file_url, cache)
    tile = manifest.tiles[0]
    entered, proceed = threading.Event(), threading.Event()

    def fails(_: Path) -> None:
        entered.set()
        proceed.wait(30)
        raise BundleError("the first fails")

    errors: list[str] = []

    def first() -> None:
        try:
            cache.once(found.folder / tile.folder, fails)
        except BundleError as error:
            errors.append(error.message)

    one = threading.Thread(target=first)
    one.start()
    entered.wait(30)
    other = threading.Thread(target=tiles.folder, args=(tile,))
    other.start()
    proceed.set()
    one.join(30)
    other.join(30)
    assert errors == ["the first fails"]
    MapBundle.open(tiles.folder(tile))


def test_a_folder_that_another_process_removes_at_once_is_made_again(
    cache: TileCache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mkdir, refused = Path.mkdir, []

    def removed_meanwhile(self: Path, *arguments: Any, **named: Any) -> None:
        if self.name.endswith(".partial") and not refused:
            refused.append(self)
            raise FileExistsError(errno.EEXIST, "File exists", str(self))
        mkdir(self, *arguments, **named)

    monkeypatch.setattr(Path, "mkdir", removed_meanwhile)
    cache.once(tmp_path / "cache" / "tile", lambda folder: (folder / "views").touch())
    assert len(refused) == 1
    assert (tmp_path / "cache" / "tile" / "views").exists()


def test_a_file_in_place_of_the_folder_is_named(cache: TileCache, tmp_path: Path) -> None:
    (tmp_path / "cache").mkdir(exist_ok=True)
    (tmp_path / "cache" / ".tile.partial").touch()
    with pytest.raises(BundleError, match=r"\.tile\.partial: the cache of maps cannot be used"):
        cache.once(tmp_path / "cache" / "tile", lambda folder: (folder / "views").touch())


class TestVersions:
    def test_an_unchanged_manifest_is_not_read_again(
        self, town: Path, url: str, cache: TileCache, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        push(town, url)
        found, *_ = stored(url, cache)
        answers: list[object] = []
        read = Remote.read
        monkeypatch.setattr(
            Remote, "read", lambda self, name, **named: answers.append(result := read(self, name, **named)) or result
        )
        found.refresh()
        assert answers == [None]

    def test_a_new_version_comes_beside_the_old_one_and_shares_its_tiles(
        self, town: Path, file_url: str, cache: TileCache, tmp_path: Path
    ) -> None:
        push(town, file_url)
        found, old, manifest, tiles = stored(file_url, cache)
        tile = tiles.folder(manifest.tiles[0])
        changed = Manifest.model_validate(manifest.model_dump() | {"licence": "another"}).stamped()
        shutil.copytree(town, tmp_path / "own")
        (tmp_path / "own" / "manifest.json").write_bytes(changed.to_bytes())
        push(tmp_path / "own", file_url)
        found.refresh()
        new = found.folder / changed.version
        assert read_manifest(new) == changed
        assert found.tiles(new).folder(changed.tiles[0]) == tile
        assert old.exists()
        found.forget([])
        assert not old.exists()
        assert new.exists()
        assert tile.exists()

    def test_a_version_that_was_built_again_has_its_new_date(
        self, town: Path, file_url: str, cache: TileCache, tmp_path: Path
    ) -> None:
        push(town, file_url)
        found, version, manifest, _ = stored(file_url, cache)
        later = manifest.model_copy(update={"made_at": datetime.now(UTC)})
        shutil.copytree(town, tmp_path / "own")
        (tmp_path / "own" / "manifest.json").write_bytes(later.to_bytes())
        push(tmp_path / "own", file_url)
        found.refresh()
        assert read_manifest(version).made_at == later.made_at

    def test_files_that_another_version_has_are_links_unless_they_are_damaged(
        self, town: Path, url: str, cache: TileCache, content_of: Content, encoder_of: Any, tmp_path: Path
    ) -> None:
        push(town, url)
        fetched: list[int] = []

        @contextmanager
        def follow(_: str, __: str, size: int) -> Iterator[Any]:
            fetched.append(size)
            yield lambda _: None

        found = StoredMap(url, cache, follow)
        found.refresh()
        old = found.folder / read_manifest(town).version
        new = write_tiled_map(tmp_path / "larger", content_of, encoder_of(), tiles=4)
        push(tmp_path / "larger", url)
        found.refresh()
        own = found.folder / new.version
        same = {name for name, entry in new.files.items() if entry == read_manifest(town).files.get(name)}
        assert "encoder.onnx" in same
        assert "places.npy" not in same
        assert {name for name in new.files if (own / name).samefile(old / name)} == same
        assert fetched[1] == sum(entry.size for name, entry in new.files.items() if name not in same)
        TiledMap.open(own, source=found.tiles(own))
        cache.delete(own)
        encoder = old / "encoder.onnx"
        encoder.write_bytes(b"?" + encoder.read_bytes()[1:])
        again = StoredMap(url, cache)
        again.refresh()
        assert not (own / "encoder.onnx").samefile(encoder)
        TiledMap.open(own, source=again.tiles(own))

    def test_a_search_index_that_a_server_replaces_is_left_out_until_it_is_needed(
        self, file_url: str, cache: TileCache, content_of: Content, encoder_of: Any, tmp_path: Path
    ) -> None:
        made = write_tiled_map(tmp_path / "large", content_of, encoder_of(), tiles=MOST_SEARCHED + 1)
        push(tmp_path / "large", file_url)
        for url in (file_url, f"{file_url}@{made.version}"):
            found = StoredMap(url, cache, is_searched_elsewhere=True)
            found.refresh()
            version = found.folder / made.version
            assert {name for name in made.files if not (version / name).exists()} == {"search.faiss"}
            opened = TiledMap.open(version, source=found.tiles(version), open_search=Row)
            assert isinstance(opened.search, Row)
            with pytest.raises(BundleError, match=r"search\.faiss: missing"):
                TiledMap.open(version, source=found.tiles(version))
        for url in (file_url, f"{file_url}@{made.version}"):  # the setting is gone
            found = StoredMap(url, cache)
            found.refresh()
            assert TiledMap.open(version, source=found.tiles(version)).search is not None
            assert left_over(found.folder) == []
            assert not list(found.folder.glob(".*"))
            (version / "search.faiss").unlink()

    def test_the_search_index_of_a_map_of_few_tiles_is_fetched_with_a_server_too(
        self, town: Path, file_url: str, cache: TileCache
    ) -> None:
        push(town, file_url)
        found = StoredMap(file_url, cache, is_searched_elsewhere=True)
        found.refresh()
        assert {each for each in read_manifest(town).files if (found.versions()[0] / each).exists()} == set(
            read_manifest(town).files
        ) - NOT_SERVED

    def test_a_pinned_version_is_served_although_the_store_has_a_newer_one(
        self, town: Path, url: str, cache: TileCache, content_of: Content, encoder_of: Any, tmp_path: Path
    ) -> None:
        old = read_manifest(town)
        push(town, url)
        new = write_tiled_map(tmp_path / "larger", content_of, encoder_of(), tiles=4)
        push(tmp_path / "larger", url)
        pinned = StoredMap(f"{url}@{old.version}/", cache)
        assert (pinned.url, pinned.pinned) == (url, old.version)
        pinned.refresh()
        (version,) = pinned.versions()
        assert read_manifest(version) == old
        opened = TiledMap.open(version, source=pinned.tiles(version))
        assert opened.tiles.get(0).manifest.version == old.tiles[0].version
        follows, *_ = stored_all(url, cache)
        assert follows.folder == pinned.folder  # both share the tiles
        assert {each.name for each in follows.versions()} == {old.version, new.version}
        pinned.forget(())  # the other service needs the new version
        assert {each.name for each in follows.versions()} == {old.version, new.version}
        assert pinned.versions() == [version]

    def test_a_service_with_a_pin_deletes_versions_that_no_process_has_used_for_days(
        self, town: Path, file_url: str, cache: TileCache, content_of: Content, encoder_of: Any, tmp_path: Path
    ) -> None:
        versions = [read_manifest(town).version]
        push(town, file_url)
        for tiles in (4, 5):
            out = tmp_path / str(tiles)
            versions.append(write_tiled_map(out, content_of, encoder_of(), tiles=tiles).version)
            push(out, file_url)
        unused, other, own = [StoredMap(f"{file_url}@{version}", cache) for version in versions]
        for each in (unused, other, own):
            each.refresh()
        long_ago = time.time() - UNUSED_S - 60
        for version in versions:
            os.utime(own.folder / version, (long_ago, long_ago))
        other.refresh()  # another process, which starts and marks its version
        own.forget([versions[2]])
        assert {each.parent.name for each in own.folder.glob("*/manifest.json")} == set(versions[1:])
        os.utime(own.folder / versions[1], (long_ago, long_ago))
        other.forget([versions[1]])  # a scan marks it again, and finds that of `own` just marked
        own.forget([versions[2]])
        assert {each.parent.name for each in own.folder.glob("*/manifest.json")} == set(versions[1:])
        unused.refresh()  # it comes back when a service needs it
        assert len(unused.versions()) == 1

    def test_a_pinned_version_in_the_cache_needs_no_store(self, town: Path, file_url: str, cache: TileCache) -> None:
        push(town, file_url)
        pinned = f"{file_url}@{read_manifest(town).version}"
        StoredMap(pinned, cache).refresh()
        shutil.rmtree(store_of(file_url))
        again = StoredMap(pinned, cache)
        again.refresh()
        assert len(again.versions()) == 1

    def test_a_version_that_the_store_lacks_is_an_error_that_names_the_current_one(
        self, town: Path, url: str, cache: TileCache, tmp_path: Path
    ) -> None:
        push(town, url)
        missing = StoredMap(f"{url}@{16 * '0'}", cache)
        told = (
            rf"{url}: version 0{{16}} is not in the store \(manifest.json has version {read_manifest(town).version}\)"
        )
        with pytest.raises(BundleError, match=told):
            missing.refresh()
        assert missing.versions() == []
        with pytest.raises(BundleError, match=told):
            pull(f"{url}@{16 * '0'}", tmp_path / "back")

    def test_the_only_version_of_a_folder_that_another_tool_copied_can_be_pinned(
        self, town: Path, tmp_path: Path, cache: TileCache
    ) -> None:
        shutil.copytree(town, tmp_path / "store" / "town")
        pinned = StoredMap(f"file://{tmp_path}/store/town@{read_manifest(town).version}", cache)
        pinned.refresh()
        (version,) = pinned.versions()
        MapBundle.open(pinned.tiles(version).folder(read_manifest(version).tiles[0]))

    def test_a_version_in_the_folder_of_another_one_is_refused(
        self, town: Path, file_url: str, cache: TileCache
    ) -> None:
        push(town, file_url)
        versions = store_of(file_url) / "versions"
        (versions / read_manifest(town).version).rename(versions / (16 * "0"))
        with pytest.raises(BundleError, match=r"version 0{16} is not in the store \(versions/0{16}/manifest.json has"):
            StoredMap(f"{file_url}@{16 * '0'}", cache).refresh()

    def test_a_pull_copies_the_version_that_the_url_names(
        self, town: Path, file_url: str, content_of: Content, encoder_of: Any, tmp_path: Path
    ) -> None:
        push(town, file_url)
        write_tiled_map(tmp_path / "larger", content_of, encoder_of(), tiles=4)
        push(tmp_path / "larger", file_url)
        pull(f"{file_url}@{read_manifest(town).version}", tmp_path / "back")
        assert same_files(town, tmp_path / "back")

    def test_a_push_to_a_version_is_refused(self, town: Path, file_url: str) -> None:
        with pytest.raises(
            BundleError, match="names a version, but a push writes that of the map; leave out '@VERSION'"
        ):
            push(town, f"{file_url}@{16 * '0'}")
        assert not store_of(file_url).exists()

    def test_tiles_are_fetched_although_the_folder_of_their_version_is_gone(
        self, town: Path, file_url: str, cache: TileCache
    ) -> None:
        """A service with another version of the map, on the same cache, has deleted it."""
        push(town, file_url)
        _, version, manifest, tiles = stored(file_url, cache)
        shutil.rmtree(version)
        MapBundle.open(tiles.folder(manifest.tiles[0]))

    def test_a_map_of_one_bundle_is_fetched_whole(self, bundle_path: Path, url: str, cache: TileCache) -> None:
        push(bundle_path, url)
        _, version, *_ = stored(url, cache)
        assert MapBundle.open(version).manifest == read_manifest(bundle_path)


class TestErrors:
    def test_a_missing_map_is_an_error_that_names_it(self, town: Path, url: str, cache: TileCache) -> None:
        push(town, url)
        with pytest.raises(
            BundleError, match=f"{url}/none(/manifest.json is missing in the store| cannot be opened .*); check the URL"
        ):
            StoredMap(f"{url}/none", cache).refresh()

    def test_a_missing_bucket_is_told_when_a_map_is_pushed(
        self, town: Path, s3: dict[str, str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for key, value in s3.items():
            monkeypatch.setenv(key, value)
        with pytest.raises(BundleError, match=r"s3://nowhere/town/tiles/.* cannot be written \(404: no such bucket\)"):
            push(town, "s3://nowhere/town")

    def test_a_server_that_does_not_answer_is_told_without_credentials(
        self, cache: TileCache, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(remote, "_RETRIES", 1)
        for key, value in CREDENTIALS.items():
            monkeypatch.setenv(key, value)
        monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
        monkeypatch.setenv("AWS_ALLOW_HTTP", "true")
        with pytest.raises(BundleError) as told:
            StoredMap("s3://bucket/town", cache).refresh()
        assert "s3://bucket/town/manifest.json cannot be read" in told.value.message
        assert "error sending request" in told.value.message
        assert CREDENTIALS["AWS_ACCESS_KEY_ID"] not in told.value.message
        assert CREDENTIALS["AWS_SECRET_ACCESS_KEY"] not in told.value.message

    def test_an_endpoint_without_tls_needs_a_variable(self, cache: TileCache, monkeypatch: pytest.MonkeyPatch) -> None:
        for key, value in CREDENTIALS.items():
            monkeypatch.setenv(key, value)
        monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
        monkeypatch.delenv("AWS_ALLOW_HTTP", raising=False)
        with pytest.raises(BundleError, match="set AWS_ALLOW_HTTP=true"):
            StoredMap("s3://bucket/town", cache).refresh()

    @pytest.mark.parametrize(
        ("url", "told"),
        [
            ("ftp://host/town", "no scheme of a store; write one of s3://, gs://, az://, file://"),
            ("s3:///town", "names no bucket"),
            ("file://town", "three slashes"),
            ("file:///", "names no folder"),
            ("s3://bucket/town?versionId=1", r"'\?' or '#'"),
            ("s3://key:secret@bucket/town", "has credentials; give them in environment variables"),
        ],
    )
    def test_a_wrong_url_is_told_without_its_secrets(self, url: str, told: str) -> None:
        with pytest.raises(BundleError, match=told) as error:
            checked_url(url)
        assert "secret" not in error.value.message

    @pytest.mark.parametrize(
        "version", ["", "v2", "3F9C2A7BE01D4586", "3f9c2a7be01d458", f"3f9c2a7be01d4586@{16 * '0'}"]
    )
    def test_what_follows_an_at_sign_must_be_a_version(self, version: str, cache: TileCache) -> None:
        with pytest.raises(
            BundleError, match="has an '@' without a version behind it; write URL@VERSION with the 16 hex"
        ):
            StoredMap(f"s3://bucket/maps/town@{version}", cache)

    def test_a_url_and_its_version_are_told_apart(self) -> None:
        assert split_version("s3://bucket/a@b/town/") == ("s3://bucket/a@b/town", None)
        assert split_version("gs://bucket/town@3f9c2a7be01d4586") == ("gs://bucket/town", "3f9c2a7be01d4586")
        with pytest.raises(BundleError, match="names no folder"):
            split_version("file:///@3f9c2a7be01d4586")

    def test_a_signature_in_an_address_is_not_told(self) -> None:
        error = remote._failed(
            "az://maps/town",
            "cannot be read",
            ValueError("GET https://a.blob.core.windows.net/x?sig=SECRET&sv=1 failed\nmore"),
        )
        assert "SECRET" not in error.message
        assert "https://a.blob.core.windows.net/x failed" in error.message

    def test_the_answer_of_a_server_is_told_by_its_code(self) -> None:
        body = "<Error><Code>SignatureDoesNotMatch</Code><AWSAccessKeyId>AKIA</AWSAccessKeyId></Error>"
        error = remote._failed(
            "s3://b/t", "cannot be read", ValueError(f"Server returned status code: 403 Forbidden: {body}")
        )
        assert "(status 403 Forbidden, SignatureDoesNotMatch)" in error.message
        assert "AKIA" not in error.message

    def test_without_obstore_the_extra_is_named(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "obstore.exceptions", None)
        monkeypatch.setitem(sys.modules, "obstore", None)
        with pytest.raises(ExtraMissingError, match=r"s3://bucket/town.*'obstore'.*\[store\]"):
            Remote.open("s3://bucket/town")

    def test_a_large_manifest_is_not_read(self, town: Path, file_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
        push(town, file_url)
        monkeypatch.setattr(remote, "MOST_READ_BYTES", 100)
        with pytest.raises(BundleError, match=r"manifest\.json: \d+ bytes, more than 100"):
            Remote.open(file_url).read("manifest.json")


def test_a_connection_that_breaks_is_taken_up_again(
    town: Path, tmp_path: Path, cache: TileCache, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server answers half of a file and closes, once for each file; and begins with errors."""
    push(town, f"file://{tmp_path}/store")
    broken: dict[str, int] = {}

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            file = tmp_path / "store" / self.path.split("?")[0].removeprefix("/bucket/town/")
            if not file.is_file():
                self.send_response(404)
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            data, times = file.read_bytes(), broken.setdefault(self.path, 0)
            broken[self.path] = times + 1
            if times == 0:
                self.send_response(503)
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            first = 0
            if asked := self.headers.get("Range"):
                first = int(asked.removeprefix("bytes=").partition("-")[0])
                self.send_response(206)
                self.send_header("Content-Range", f"bytes {first}-{len(data) - 1}/{len(data)}")
            else:
                self.send_response(200)
            self.send_header("ETag", f'"{hashlib.md5(data, usedforsecurity=False).hexdigest()}"')
            self.send_header("Last-Modified", "Thu, 01 Jan 2026 00:00:00 GMT")
            self.send_header("Content-Length", str(len(data) - first))
            self.end_headers()
            if times == 1 and len(data) > 1:
                self.wfile.write(data[: len(data) // 2])
                self.close_connection = True
                return
            self.wfile.write(data[first:])

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    serving = threading.Thread(target=server.serve_forever, daemon=True)
    serving.start()
    try:
        for key, value in CREDENTIALS.items():
            monkeypatch.setenv(key, value)
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.server_port}")
        monkeypatch.setenv("AWS_ALLOW_HTTP", "true")
        _, _, manifest, tiles = stored("s3://bucket/town", cache)
        MapBundle.open(tiles.folder(manifest.tiles[0]))
        assert max(broken.values()) >= 3
    finally:
        server.shutdown()
        server.server_close()
        serving.join()


def test_a_failure_stops_the_other_transfers() -> None:
    begun: list[int] = []

    def work(number: int, go_on: Callable[[], None]) -> None:
        begun.append(number)
        if number == 0:
            raise BundleError("the first")
        for _ in range(1000):
            go_on()
            time.sleep(0.01)

    started = time.monotonic()
    with pytest.raises(BundleError, match="the first"):
        fetch.concurrently(partial(work, number) for number in range(100))
    assert len(begun) < 100
    assert time.monotonic() - started < 8
