"""Registries and watchers of several workers on the same folder. Workers are objects of one process."""

import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from service.errors import BundleError
from service.maps.content import BundleContent
from service.maps.writer import write_bundle
from service.runtime.map_registry import MapRegistry
from service.runtime.map_watcher import MapWatcher
from service.runtime.serving_table import SharedServingTable

Content = Callable[..., BundleContent]


class Worker:
    def __init__(self, memory: Any, number: int, folder: Path) -> None:
        self.opened: list[str] = []
        self.registry = MapRegistry(table=SharedServingTable(memory, number))
        self.watcher = MapWatcher(
            self.registry, [folder], warm=lambda localizer: self.opened.append(localizer.bundle.path.name)
        )

    @property
    def serving(self) -> str:
        return self.registry.get("tiny").bundle.path.name

    def choose(self, path: str) -> None:
        (version,) = [
            each.bundle.manifest.version for each in self.registry.versions("tiny") if each.bundle.path.name == path
        ]
        self.registry.serve("tiny", version)


@pytest.fixture
def folder(content_of: Content, tmp_path: Path) -> Path:
    write_bundle(tmp_path / "maps" / "v0", content_of(seed=0))
    return tmp_path / "maps"


@pytest.fixture
def write(folder: Path, content_of: Content) -> Callable[[int], object]:
    return lambda seed: write_bundle(folder / f"v{seed}", content_of(seed=seed))


@pytest.fixture
def start(memory: Any, folder: Path) -> Callable[[int], Worker]:
    def begin(number: int) -> Worker:
        worker = Worker(memory, number, folder)
        worker.watcher.open_first()
        return worker

    return begin


Start = Callable[[int], Worker]
Write = Callable[[int], None]


def test_a_new_version_serves_in_all_workers_when_the_last_has_opened_it(start: Start, write: Write) -> None:
    workers = [start(number) for number in range(2)]
    write(1)
    for worker, expected in zip(workers, ("v0", "v1"), strict=True):
        worker.watcher.scan()
        assert worker.opened == ["v0", "v1"]
        assert [each.serving for each in workers] == [expected] * 2


def test_a_worker_opens_what_another_one_has_found(start: Start, write: Write) -> None:
    """So no worker waits for another that got the signal alone, or that looks late."""
    workers = [start(number) for number in range(2)]
    workers[1].watcher.start(3600)
    until(lambda: workers[1].registry.table.others_offer() == frozenset())
    write(1)
    workers[0].watcher.scan()
    until(lambda: [each.serving for each in workers] == ["v1", "v1"])
    workers[1].watcher.stop()


def test_a_temporary_failure_in_one_worker_is_retried_while_the_others_wait(start: Start, write: Write) -> None:
    """Its memory was full, or a network disk was missing. The files did not change, so only a retry can succeed."""
    workers = [start(number) for number in range(2)]
    failures = []

    def fails_once(localizer: Any) -> None:
        if not failures:
            failures.append(localizer)
            raise BundleError("no memory")

    workers[1].watcher._warm = fails_once
    write(1)
    workers[0].watcher.scan()
    workers[1].watcher.scan()
    workers[1].watcher.scan()
    assert len(failures) == 1
    assert [each.serving for each in workers] == ["v0", "v0"]
    workers[1].watcher.start(0.01)
    until(lambda: [each.serving for each in workers] == ["v1", "v1"])
    workers[1].watcher.stop()


def test_a_rollback_to_a_version_without_a_folder_holds_in_all_workers(
    start: Start, write: Write, folder: Path
) -> None:
    write(1)
    workers = [start(number) for number in range(2)]
    shutil.rmtree(folder / "v0")
    workers[0].choose("v0")
    for worker in workers:
        worker.watcher.scan()
        assert worker.serving == "v0"
    workers[1].watcher.scan(drop_missing=True)  # the operator's SIGHUP is what takes it out
    assert [each.serving for each in workers] == ["v1", "v1"]


def test_a_worker_that_is_started_again_serves_what_the_others_do(start: Start, write: Write, memory: Any) -> None:
    write(1)
    workers = [start(number) for number in range(2)]
    workers[0].choose("v0")
    memory.living.remove(1)
    again = start(1)
    assert [workers[0].serving, again.serving] == ["v0", "v0"]
    write(2)
    for worker in (workers[0], again):
        worker.watcher.scan()
    memory.living.remove(1)
    assert start(1).serving == workers[0].serving == "v2"


def test_it_opens_what_is_mounted_first_and_what_is_new_later(start: Start, write: Write, memory: Any) -> None:
    first = start(0)
    write(1)
    late = start(1)
    assert (late.opened, late.serving) == (["v0"], "v0")
    for worker in (late, first):
        worker.watcher.scan()
    assert (late.opened, late.serving) == (["v0", "v1"], "v1")


def test_it_waits_while_the_others_serve_a_version_that_it_cannot_open(
    start: Start, write: Write, folder: Path, memory: Any, caplog: pytest.LogCaptureFixture
) -> None:
    write(1)
    first = start(0)
    first.choose("v0")
    shutil.rmtree(folder / "v0")
    late, waits = Worker(memory, 1, folder), []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        assert first.serving == "v0"
        if len(waits) == 3:
            first.choose("v1")

    late.watcher.open_first(wait=wait)
    assert len(waits) == 3
    assert caplog.text.count("worker_waits") == 1
    assert [first.serving, late.serving] == ["v1", "v1"]
    assert len(first.registry.versions("tiny")) == 1  # v0 is open in one of them alone


def test_the_damage_of_a_bundle_keeps_no_worker_from_coming_back(
    start: Start, write: Write, folder: Path, memory: Any
) -> None:
    """The map has served before. The defect would end a first start, but not this one."""
    workers = [start(number) for number in range(2)]
    for worker in workers:
        shutil.rmtree(folder / "v0", ignore_errors=True)
        worker.watcher.scan(drop_missing=True)
    write(1)
    (folder / "v1" / "places.npy").write_bytes(b"")
    memory.living.remove(1)
    again = start(1)
    assert len(again.registry) == 0


def test_a_removed_version_serves_until_all_workers_have_its_successor(
    start: Start, write: Write, folder: Path
) -> None:
    """One SIGHUP follows a replacement of the bundle. The map is never missing."""
    workers = [start(number) for number in range(2)]
    write(1)
    shutil.rmtree(folder / "v0")
    workers[0].watcher.scan(drop_missing=True)
    assert [each.serving for each in workers] == ["v0", "v0"]
    workers[1].watcher.scan(drop_missing=True)
    workers[0].watcher.scan()
    assert [each.serving for each in workers] == ["v1", "v1"]
    assert [len(each.registry.versions("tiny")) for each in workers] == [1, 1]


def test_a_pending_unmount_does_not_unmount_another_version_later(start: Start, write: Write, folder: Path) -> None:
    workers = [start(number) for number in range(2)]
    write(1)
    shutil.rmtree(folder / "v0")
    for worker in workers:
        worker.watcher.scan(drop_missing=True)  # the first one waits for the second, which takes it out
    write(2)
    for worker in workers:
        worker.watcher.scan()
    workers[0].choose("v1")
    shutil.rmtree(folder / "v1")
    for worker in workers:
        worker.watcher.scan()
    assert [each.serving for each in workers] == ["v1", "v1"]


def test_maps_that_are_let_go_of_are_let_go_of_in_all_workers(start: Start, write: Write) -> None:
    workers = [start(number) for number in range(2)]
    for seed in range(1, 5):
        write(seed)
        for worker in workers:
            worker.watcher.scan()
    for worker in workers:
        assert [each.bundle.path.name for each in worker.registry.versions("tiny")] == ["v4", "v3", "v2"]
        assert len(worker.registry._open) == 3


def until(true: Callable[[], bool]) -> None:
    end = time.monotonic() + 30
    while not true():
        assert time.monotonic() < end
        os.sched_yield()
