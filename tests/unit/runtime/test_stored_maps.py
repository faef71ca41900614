"""A service with maps in object storage."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from service.errors import BundleError, RequestError
from service.maps.content import BundleContent
from service.maps.store.cache import TileCache, default_folder
from service.maps.store.stored_map import StoredMap
from service.maps.store.transfer import push
from service.maps.tiled_writer import write_tiled
from service.maps.tiles import TiledMap
from service.maps.writer import write_bundle
from service.runtime.engine import Engine, warm_up
from service.runtime.map_registry import MapRegistry
from service.runtime.map_watcher import MapWatcher
from service.runtime.settings import MapUrl, Settings, load_settings
from tests.unit.lattice import as_tile

Content = Callable[..., BundleContent]


class Town:
    """A map in a store, a cache, and services that use both."""

    def __init__(self, folder: Path, content_of: Content, encoder: bytes) -> None:
        self.folder, self._content_of, self._encoder = folder, content_of, encoder
        self.url = f"file://{folder}/store/town"
        self.versions = 0

    def push(self, *, tiles: int = 2) -> str:
        """Push the next version."""
        self.versions += 1
        squares = {}
        for number in range(tiles):
            squares[number, 0] = self.folder / f"tiles-{self.versions}" / str(number)
            write_bundle(
                squares[number, 0], as_tile(self._content_of(seed=self.versions + number, encoder=self._encoder))
            )
        out = self.folder / f"town-{self.versions}"
        made = write_tiled(out, squares, 100.0, name="town")
        push(out, self.url)
        return made.version

    def service(self, version: str | None = None) -> tuple[MapRegistry, MapWatcher]:
        """A service that follows the current version, or serves only one."""
        registry = MapRegistry()
        url = self.url if version is None else f"{self.url}@{version}"
        stored = StoredMap(url, TileCache(self.folder / "cache", 10**9))
        return registry, MapWatcher(registry, [], warm=lambda each: warm_up(0.01, each), stored=[stored])

    @property
    def cached(self) -> set[str]:
        return {each.parent.name for each in (self.folder / "cache").glob("*/[!.]*/manifest.json")}


@pytest.fixture
def town(tmp_path: Path, content_of: Content, encoder_of: Callable[..., bytes]) -> Town:
    return Town(tmp_path, content_of, encoder_of())


def version_of(registry: MapRegistry) -> str:
    return registry.get("town").bundle.manifest.version


def test_a_stored_map_serves_and_a_new_version_replaces_it(town: Town) -> None:
    first = town.push()
    registry, watcher = town.service()
    watcher.open_first()
    assert version_of(registry) == first
    assert isinstance(registry.get("town").bundle, TiledMap)
    assert watcher.scan() == []
    second = town.push()
    assert watcher.scan() == [f"mounted town {second}"]
    assert version_of(registry) == second
    assert len(registry.versions("town")) == 2
    assert town.cached == {first, second}


def test_a_restart_serves_the_version_that_the_store_was_rolled_back_to(town: Town) -> None:
    first = town.push()
    registry, watcher = town.service()
    watcher.open_first()
    second = town.push()
    watcher.scan()
    assert version_of(registry) == second
    push(town.folder / "town-1", town.url)
    watcher.scan()
    again, watcher = town.service()
    watcher.open_first()
    assert version_of(again) == first
    assert town.cached == {first}


def test_a_pinned_version_is_rolled_out_and_back_service_by_service(town: Town) -> None:
    """The cache also has the newer version, which would serve without the pin."""
    first = town.push()
    follows, watcher_follows = town.service()
    watcher_follows.open_first()
    second = town.push()
    watcher_follows.scan()
    pinned, watcher = town.service(first)
    watcher.open_first()
    assert (version_of(follows), version_of(pinned)) == (second, first)
    third = town.push()
    assert watcher.scan() == watcher.scan(drop_missing=True) == []
    assert version_of(pinned) == first
    watcher_follows.scan()
    assert version_of(follows) == third
    for version in (third, first, second):  # the next services roll forward and back
        registry, watcher = town.service(version)
        watcher.open_first()
        assert version_of(registry) == version
        assert len(registry.versions("town")) == 1
    assert version_of(follows) == third


def test_a_pinned_version_that_the_store_lacks_does_not_start(town: Town) -> None:
    town.push()
    town.service()[1].open_first()  # another version in the cache does not serve instead
    with pytest.raises(BundleError, match=r"version 0{16} is not in the store"):
        town.service(16 * "0")[1].open_first()


def test_versions_that_nobody_has_mounted_leave_the_cache(town: Town) -> None:
    made = [town.push()]
    registry, watcher = town.service()
    watcher.open_first()
    for _ in range(4):
        made.append(town.push())
        watcher.scan()
    assert town.cached == set(made[-3:])
    registry.serve("town", made[-3])  # an operator rolls back
    watcher.scan()
    assert version_of(registry) == made[-3]
    assert town.cached == set(made[-3:])


def test_a_store_that_is_gone_stops_no_service(town: Town) -> None:
    version = town.push()
    registry, watcher = town.service()
    watcher.open_first()
    shutil.move(town.folder / "store", town.folder / "away")
    assert watcher.scan() == []
    (refused,) = registry.refused
    assert "file://" not in refused.reason
    assert refused.reason == "it cannot be served from its store; the log of the service says why"
    watcher.scan(drop_missing=True)
    assert version_of(registry) == version
    shutil.move(town.folder / "away", town.folder / "store")
    watcher.scan()
    assert registry.refused == ()


def test_a_tile_that_cannot_be_fetched_is_tried_again_and_logged(town: Town, caplog: pytest.LogCaptureFixture) -> None:
    town.push()
    registry, watcher = town.service()
    watcher.open_first()
    version = town.push()
    shutil.move(town.folder / "store" / "town" / "tiles", town.folder / "away")
    (told,) = watcher.scan()
    assert "the tile cannot be fetched; the log of the service says why" in told
    assert all("file://" not in each.reason and str(town.folder) not in each.reason for each in registry.refused)
    assert f"{town.url}/tiles/" in caplog.text
    shutil.move(town.folder / "away", town.folder / "store" / "town" / "tiles")
    assert watcher.scan() == [f"mounted town {version}"]
    assert registry.refused == ()


def test_a_service_starts_from_its_cache_without_the_store(town: Town) -> None:
    version = town.push()
    town.service()[1].open_first()
    shutil.rmtree(town.folder / "store" / "town" / "tiles")
    (town.folder / "store" / "town" / "manifest.json").unlink()
    registry, watcher = town.service()
    watcher.open_first()
    assert version_of(registry) == version
    with pytest.raises(BundleError, match="missing in the store"):
        town.service()[1].open_first(strict=True)


def test_without_store_and_cache_a_service_does_not_start(town: Town) -> None:
    (town.folder / "store" / "town").mkdir(parents=True)
    with pytest.raises(BundleError, match=rf"{town.url}/manifest\.json is missing in the store"):
        town.service()[1].open_first()


def test_an_engine_takes_urls_and_folders(town: Town, bundle_path: Path) -> None:
    version = town.push()
    left = town.folder / "cache" / "town-old" / "tiles" / ".0123.partial"
    left.mkdir(parents=True)
    engine = Engine.open(Settings(maps=(MapUrl(town.url), bundle_path), tile_cache=town.folder / "cache"))
    try:
        assert version_of(engine.registry) == version
        assert engine.registry.get("tiny").bundle.path == bundle_path
        assert not left.exists()
    finally:
        engine.close()


def test_urls_and_folders_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STREETFIX_MAPS", "/maps/a:s3://bucket/town/:gs://other/town:maps/b")
    found = load_settings().maps
    assert found == (Path("/maps/a"), MapUrl("s3://bucket/town"), MapUrl("gs://other/town"), Path("maps/b"))
    assert [type(each) is MapUrl for each in found] == [False, True, True, False]
    assert load_settings(maps=("file:///srv/town",)).maps == (MapUrl("file:///srv/town"),)
    assert '"s3://bucket/town"' in load_settings().model_dump_json()


def test_a_url_with_credentials_is_refused_without_telling_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STREETFIX_MAPS", "s3://key:hidden@bucket/town")
    with pytest.raises(RequestError, match=r"setting maps: the URL s3://\.\.\. of a map has credentials") as told:
        load_settings()
    assert "hidden" not in told.value.message


def test_a_version_in_a_url_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    version = "3f9c2a7be01d4586"
    monkeypatch.setenv("STREETFIX_MAPS", f"s3://bucket/town@{version}:s3://bucket/city")
    assert load_settings().maps == (MapUrl(f"s3://bucket/town@{version}"), MapUrl("s3://bucket/city"))
    monkeypatch.setenv("STREETFIX_MAPS", "s3://bucket/town@v2")
    with pytest.raises(RequestError, match=r"setting maps: the URL s3://\.\.\. of a map has an '@' without a version"):
        load_settings()
    for other in ("s3://bucket/town/", f"s3://bucket/town@{16 * '0'}"):
        monkeypatch.setenv("STREETFIX_MAPS", f"s3://bucket/town@{version}:{other}")
        with pytest.raises(RequestError, match="setting maps: s3://bucket/town is given with two versions; give one"):
            load_settings()
    monkeypatch.setenv("STREETFIX_MAPS", "s3://bucket/town:s3://bucket/town")
    assert len(load_settings().maps) == 2


def test_the_usual_cache_is_in_the_home_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/var/cache")
    assert default_folder() == Path("/var/cache/streetfix/tiles")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    with pytest.raises(BundleError, match="STREETFIX_TILE_CACHE"):
        default_folder()
