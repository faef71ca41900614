import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from service.errors import BundleError
from service.localization.localizer import Localizer
from service.maps.content import BundleContent
from service.maps.writer import write_bundle
from service.runtime.map_registry import MapRegistry
from service.runtime.map_watcher import MapWatcher, stamp_of

Content = Callable[..., BundleContent]


class Watched:
    """A folder of maps, its registry and watcher, and what was warmed."""

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


def test_a_damaged_bundle_is_told_once_and_the_old_one_serves_on(watched: Watched) -> None:
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


def test_what_is_gone_stays_until_the_operator_says_so(watched: Watched) -> None:
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


def test_it_looks_by_itself_and_at_once_when_told(watched: Watched) -> None:
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
    """Found by fifty swaps under load: a bundle was being removed."""
    whole = stamp_of(bundle_copy)
    real, gone = os.scandir, bundle_copy / "cloud"

    def scandir(path: str) -> object:
        if Path(path) == gone:
            raise FileNotFoundError(path)
        return real(path)

    monkeypatch.setattr(os, "scandir", scandir)
    assert stamp_of(bundle_copy) == tuple(each for each in whole if not each[0].startswith("cloud/"))
