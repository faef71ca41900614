import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from service.errors import BundleError
from service.localization.localizer import Localizer
from service.maps.content import BundleContent
from service.maps.tiles import open_map
from service.maps.writer import write_bundle
from service.runtime import map_watcher
from service.runtime.map_registry import MapRegistry
from service.runtime.map_watcher import MapWatcher, stamp_of

Content = Callable[..., BundleContent]


class Watched:
    """A folder of maps, its registry and watcher, and the warmed maps."""

    def __init__(self, folder: Path, content_of: Content) -> None:
        self.folder, self._content_of = folder, content_of
        self.warmed: list[str] = []
        self.write("first", seed=0)
        self.registry = MapRegistry.open([folder])
        self.watcher = MapWatcher(self.registry, [folder], warm=self.warm)

    def write(self, path: str, *, seed: int, name: str = "tiny") -> None:
        write_bundle(self.folder / path, self._content_of(seed=seed, name=name))

    def warm(self, localizer: Localizer) -> None:
        # Not yet serving while it is warmed.
        assert localizer not in list(self.registry)
        self.warmed.append(localizer.bundle.manifest.version)

    def serving(self, name: str = "tiny") -> str:
        return self.registry.get(name).bundle.path.name


@pytest.fixture
def watched(content_of: Content, tmp_path: Path) -> Watched:
    return Watched(tmp_path / "maps", content_of)


def test_nothing_new_is_nothing_done(watched: Watched) -> None:
    before = watched.registry.get("tiny")
    assert watched.watcher.scan() == []
    assert watched.watcher.scan(drop_missing=True) == []
    assert watched.registry.get("tiny") is before
    assert watched.warmed == []


def test_a_new_version_is_warmed_and_serves(watched: Watched) -> None:
    watched.write("second", seed=1)
    (told,) = watched.watcher.scan()
    version = watched.registry.get("tiny").bundle.manifest.version
    assert told == f"mounted tiny {version}"
    assert watched.warmed == [version]
    assert watched.serving() == "second"
    assert len(watched.registry.versions("tiny")) == 2
    assert watched.watcher.scan() == []


def test_another_map_comes_beside(watched: Watched) -> None:
    watched.write("other", seed=1, name="west")
    watched.watcher.scan()
    assert (watched.serving(), watched.serving("west"), len(watched.registry)) == ("first", "other", 2)


def test_a_bundle_that_was_replaced_in_its_place_serves_and_the_old_one_can_be_rolled_back_to(watched: Watched) -> None:
    old = watched.registry.get("tiny")
    watched.write("new", seed=1)
    shutil.rmtree(watched.folder / "first")
    (watched.folder / "new").rename(watched.folder / "first")
    watched.watcher.scan()
    assert watched.registry.get("tiny") is not old
    assert old in watched.registry.versions("tiny")


def test_a_damaged_bundle_is_reported_once_and_the_old_one_keeps_serving(watched: Watched) -> None:
    watched.write("second", seed=1)
    places = watched.folder / "second" / "places.npy"
    content = bytearray(places.read_bytes())
    content[-1] ^= 1
    places.write_bytes(content)
    (told,) = watched.watcher.scan()
    assert "is not mounted" in told
    assert "places.npy" in told
    assert watched.watcher.scan() == []
    assert watched.serving() == "first"
    assert watched.warmed == []


def test_a_copy_that_was_still_under_way_is_tried_again_when_it_has_grown(watched: Watched) -> None:
    watched.write("second", seed=1)
    places = watched.folder / "second" / "places.npy"
    content = places.read_bytes()
    places.write_bytes(content[:50])
    assert "is not mounted" in watched.watcher.scan()[0]
    places.write_bytes(content)
    assert watched.watcher.scan()[0].startswith("mounted tiny")
    assert watched.serving() == "second"


def test_a_map_that_cannot_answer_does_not_serve(watched: Watched) -> None:
    def fails(_: Localizer) -> None:
        raise BundleError("its encoder answers nonsense")

    watcher = MapWatcher(watched.registry, [watched.folder], warm=fails)
    watched.write("second", seed=1)
    assert "nonsense" in watcher.scan()[0]
    assert watched.serving() == "first"


def test_a_removed_version_stays_until_the_operator_signals(watched: Watched) -> None:
    watched.write("second", seed=1)
    watched.watcher.scan()
    shutil.rmtree(watched.folder / "second")
    assert watched.watcher.scan() == []
    assert watched.serving() == "second"
    (told,) = watched.watcher.scan(drop_missing=True)
    assert told.startswith("unmounted tiny")
    assert watched.serving() == "first"


def test_a_copy_of_the_same_version_stays_when_its_twin_goes(watched: Watched) -> None:
    shutil.copytree(watched.folder / "first", watched.folder / "twin")
    watched.watcher.scan()
    assert len(watched.registry.versions("tiny")) == 1
    shutil.rmtree(watched.folder / watched.serving())
    watched.watcher.scan(drop_missing=True)
    assert watched.registry.get("tiny") is not None


def test_whatever_a_bundle_does_others_are_mounted(watched: Watched) -> None:
    def fails(localizer: Localizer) -> None:
        if localizer.bundle.name == "a":
            raise ZeroDivisionError

    watcher = MapWatcher(watched.registry, [watched.folder], warm=fails)
    watched.write("a", seed=1, name="a")
    watched.write("b", seed=1, name="b")
    told = watcher.scan()
    assert any("is not mounted: " in each and "ZeroDivisionError" in each for each in told)
    assert watched.serving("b") == "b"


def test_a_folder_that_is_empty_for_the_moment_changes_nothing(watched: Watched) -> None:
    shutil.rmtree(watched.folder)
    assert watched.watcher.scan() == []
    assert watched.registry.get("tiny") is not None


def test_it_looks_periodically_and_at_once_on_a_signal(watched: Watched) -> None:
    watched.watcher.start(0.05)
    watched.write("second", seed=1)
    _until(lambda: watched.serving() == "second")
    watched.watcher.stop()
    slow = MapWatcher(watched.registry, [watched.folder], warm=watched.warm)
    slow.start(3600)
    watched.write("third", seed=2)
    slow.look_now()
    _until(lambda: watched.serving() == "third")
    slow.stop()


def _until(true: Callable[[], bool]) -> None:
    until = time.monotonic() + 30
    while not true():
        assert time.monotonic() < until
        os.sched_yield()


def test_a_folder_that_vanishes_while_it_is_looked_at_does_no_harm(
    bundle_copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Found by fifty swaps under load, while a bundle was removed."""
    whole = stamp_of(bundle_copy)
    real, gone = os.scandir, bundle_copy / "cloud"

    def scandir(path: str) -> object:
        if Path(path) == gone:
            raise FileNotFoundError(path)
        return real(path)

    monkeypatch.setattr(os, "scandir", scandir)
    assert stamp_of(bundle_copy) == tuple(each for each in whole if not each[0].startswith("cloud/"))


def started(*paths: Path, strict: bool = False, warm: Callable[[Localizer], None] = lambda _: None) -> MapRegistry:
    """Return what a service mounts when it starts on these folders."""
    registry = MapRegistry()
    MapWatcher(registry, paths, warm=warm).open_first(strict=strict)
    return registry


def damage(bundle: Path) -> None:
    content = bytearray((bundle / "places.npy").read_bytes())
    content[-1] ^= 1
    (bundle / "places.npy").write_bytes(content)


def test_a_start_warms_and_mounts_what_is_there(watched: Watched) -> None:
    warmed: list[str] = []
    registry = started(watched.folder, warm=lambda localizer: warmed.append(localizer.bundle.path.name))
    assert [each.bundle.path.name for each in registry] == warmed == ["first"]
    assert registry.refused == ()


def test_a_start_passes_over_damaged_bundles_and_says_so(
    watched: Watched, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    watched.write("bad", seed=1, name="west")
    damage(watched.folder / "bad")
    registry = started(watched.folder, tmp_path / "nowhere")
    assert [each.bundle.name for each in registry] == ["tiny"]
    assert [each.bundle for each in registry.refused] == ["bad", "nowhere"]
    assert registry.refused[0].reason.startswith("bad/places.npy: the hash does not match the manifest")
    assert registry.refused[1].reason.startswith("nowhere: folder not found")
    assert not any(str(tmp_path) in each.reason for each in registry.refused)
    assert f"map_refused path={watched.folder / 'bad'}" in caplog.text


def test_a_start_fails_if_there_are_bundles_and_none_can_be_mounted(watched: Watched, tmp_path: Path) -> None:
    damage(watched.folder / "first")
    with pytest.raises(BundleError, match=r"first/places\.npy: the hash does not match the manifest"):
        started(watched.folder)
    with pytest.raises(BundleError, match="nowhere: folder not found"):
        started(tmp_path / "nowhere")
    (tmp_path / "copied").mkdir()
    (tmp_path / "copied" / "places.npy").touch()
    with pytest.raises(BundleError, match=r"copied: not a map bundle: manifest\.json is missing"):
        started(tmp_path / "copied")


def test_a_start_without_any_bundle_waits_for_one(tmp_path: Path, content_of: Content) -> None:
    """A fresh volume of a container is empty except for a folder that only root can read."""
    folder = tmp_path / "volume"
    (folder / "lost+found").mkdir(parents=True, mode=0)
    (folder / ".hidden").mkdir()
    registry = MapRegistry()
    watcher = MapWatcher(registry, [folder], warm=lambda _: None)
    watcher.open_first()
    assert (len(registry), registry.refused) == (0, ())
    write_bundle(folder / "site", content_of())
    assert watcher.scan()[0].startswith("mounted tiny")
    assert len(registry) == 1


def test_a_folder_that_may_not_be_read_is_passed_over(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    """lost+found is like this for other users than root. These tests may run as root."""
    real = Path.exists

    def exists(path: Path, **options: bool) -> bool:
        if path.parent.name == "lost+found":
            raise PermissionError(13, "Permission denied")
        return real(path, **options)

    (watched.folder / "lost+found").mkdir()
    monkeypatch.setattr(Path, "exists", exists)
    assert len(started(watched.folder)) == 1


def test_a_strict_start_wants_all_bundles_whole_and_at_least_one(watched: Watched, tmp_path: Path) -> None:
    assert len(started(watched.folder, strict=True)) == 1
    (tmp_path / "empty").mkdir()
    with pytest.raises(BundleError, match=r"no map bundle found in .*empty"):
        started(tmp_path / "empty", strict=True)
    shutil.copytree(watched.folder / "first", watched.folder / "twin")
    with pytest.raises(BundleError, match="have the same version"):
        started(watched.folder, strict=True)
    assert len(started(watched.folder)) == 1
    shutil.rmtree(watched.folder / "twin")
    watched.write("bad", seed=1, name="west")
    damage(watched.folder / "bad")
    with pytest.raises(BundleError, match=r"places\.npy"):
        started(watched.folder, strict=True)


def test_only_the_newest_three_versions_are_opened(
    watched: Watched, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for seed in range(1, 5):
        watched.write(f"v{seed}", seed=seed)
    opened: list[str] = []
    monkeypatch.setattr(map_watcher, "open_map", lambda path, **how: opened.append(path.name) or open_map(path, **how))
    registry = MapRegistry()
    watcher = MapWatcher(registry, [watched.folder], warm=watched.warm)
    with caplog.at_level("INFO"):
        watcher.open_first()
    assert opened == [each.bundle.path.name for each in registry.versions("tiny")] == ["v4", "v3", "v2"]
    assert caplog.text.count("map_mounted") == len(watched.warmed) == 3
    assert watcher.scan() == []
    shutil.rmtree(watched.folder / "v3")
    told = watcher.scan(drop_missing=True)
    assert [each.split()[0] for each in told] == ["unmounted", "mounted"]  # there is room for an older one
    assert [each.bundle.path.name for each in registry.versions("tiny")] == ["v4", "v2", "v1"]


def test_an_older_one_is_opened_in_place_of_a_newer_one_that_is_damaged(watched: Watched) -> None:
    for seed in range(1, 5):
        watched.write(f"v{seed}", seed=seed)
    damage(watched.folder / "v3")
    registry = started(watched.folder)
    assert [each.bundle.path.name for each in registry.versions("tiny")] == ["v4", "v2", "v1"]
    assert [each.bundle for each in registry.refused] == ["v3"]


def test_a_refused_bundle_is_reported_until_it_is_repaired_or_removed(watched: Watched) -> None:
    for name in ("mended", "removed"):
        watched.write(name, seed=1, name=name)
        damage(watched.folder / name)
    watched.watcher.scan()
    assert [each.bundle for each in watched.registry.refused] == ["mended", "removed"]
    shutil.rmtree(watched.folder / "mended")
    watched.write("mended", seed=1, name="mended")
    shutil.rmtree(watched.folder / "removed")
    watched.watcher.scan()
    assert watched.registry.refused == ()


def test_an_explicit_look_retries_refused_bundles_with_unchanged_files(watched: Watched) -> None:
    failing = [True]

    def warm(_: Localizer) -> None:
        if failing:
            raise MemoryError

    watcher = MapWatcher(watched.registry, [watched.folder], warm=warm)
    watched.write("second", seed=1)
    assert "MemoryError" in watcher.scan()[0]
    failing.clear()
    assert watcher.scan() == []
    assert watcher.scan(drop_missing=True)[0].startswith("mounted")


def test_a_rollback_to_a_version_without_a_folder_works_and_its_streets_are_listed(watched: Watched) -> None:
    old = watched.registry.get("tiny")
    watched.write("second", seed=1)
    watched.watcher.scan()
    shutil.rmtree(watched.folder / "first")
    watched.watcher.scan()
    assert watched.registry.serve("tiny", old.bundle.manifest.version) is old
    watched.watcher.scan()
    assert watched.registry.get("tiny") is old
    assert b"FeatureCollection" in old.bundle.streets_geojson()


def test_several_missing_versions_are_unmounted_at_once(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise the second would serve for a moment."""
    for seed in (1, 2):
        watched.write(f"v{seed}", seed=seed)
    watched.watcher.scan()
    for seed in (1, 2):
        shutil.rmtree(watched.folder / f"v{seed}")
    served: list[str] = []
    real = watched.registry.table._change
    monkeypatch.setattr(
        watched.registry.table, "_change", lambda change: (real(change), served.append(watched.serving()))
    )
    watched.watcher.scan(drop_missing=True)
    assert set(served) == {"first"}


def test_a_folder_that_cannot_be_read_for_the_moment_loses_nothing(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    def iterdir(path: Path) -> object:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(Path, "iterdir", iterdir)
    assert watched.watcher.scan(drop_missing=True) == []
    assert watched.serving() == "first"
    assert "Input/output error" in watched.registry.refused[0].reason
    monkeypatch.undo()
    watched.watcher.scan()
    assert watched.registry.refused == ()


def test_a_hangup_that_comes_just_after_a_look_is_not_lost(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    """The event is set between the end of a wait and the next step."""
    watcher = watched.watcher
    looks: list[bool] = []
    real = watcher._wakeup.wait

    def wait(timeout: float | None = None) -> bool:
        told = real(0.0)
        if not looks:
            watcher.look_now()
        return told

    monkeypatch.setattr(watcher._wakeup, "wait", wait)
    monkeypatch.setattr(watcher, "scan", lambda *, drop_missing=False: looks.append(drop_missing) or [])
    watcher.start(0.0)
    _until(lambda: True in looks)
    watcher.stop()
