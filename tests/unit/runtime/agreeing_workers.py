"""A service without a network: real supervisor, registry, watcher and table, with empty folders as bundles. It is a program.

Workers record continuously which version serves, and when they looked. Meanwhile versions arrive, are chosen and are
removed, and workers are killed at random. The program prints the number of answers, and those that disagree.
"""

import os
import random
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.serving.agreement import Named, Switch, disagreements
from service.cli import workers
from service.errors import BundleError, StreetfixError
from service.runtime import map_watcher
from service.runtime.map_registry import MapRegistry
from service.runtime.serving_table import SharedMemory, SharedServingTable

WORKERS = 3
DRIVER = WORKERS  # a number of its own: it reads and chooses, but never joins
_CHANCE = random.Random()  # noqa: S311  # no secret


def manifest_of(path: Path) -> Any:
    try:
        number = int((path / "manifest.json").read_text())
    except OSError as error:
        raise BundleError(f"{path}: gone") from error
    return SimpleNamespace(name="m", version=f"v{number}", made_at=datetime.fromtimestamp(number, UTC))


def opened(path: Path, **_: object) -> Any:
    _CHANCE.seed()
    time.sleep(_CHANCE.uniform(0, 0.02))
    if (path / "damaged").exists() or not path.exists():
        raise BundleError(f"{path}: damaged")
    return SimpleNamespace(name="m", path=path, manifest=manifest_of(path), places_xy=np.zeros((2, 1)))


patched: Any = map_watcher
patched._POLL_S = patched._RETRY_S = workers.RESTART_S = 0.02
patched.read_manifest = manifest_of
patched.open_map = opened
patched.Localizer = SimpleNamespace(open=lambda bundle, **_: SimpleNamespace(bundle=bundle))


def told(path: Path, text: str) -> None:
    part = path.with_name(f".{path.name}")
    part.write_text(text)
    part.rename(path)


class Service:
    """The folders of a service, and the changes to them."""

    def __init__(self, folder: Path) -> None:
        self.maps, self.log = folder / "maps", folder / "log"
        self.pids, self.hangups, self.answering = folder / "pids", folder / "hangups", folder / "answering"
        for each in (self.maps, self.pids, self.hangups, self.answering):
            each.mkdir()
        self.memory = SharedMemory()
        self.newest = 0
        self.put()

    def put(self, *, damaged: bool = False) -> str:
        self.newest += 1
        half = self.maps / f".{self.newest}"
        half.mkdir()
        (half / "manifest.json").write_text(str(self.newest))
        if damaged:
            (half / "damaged").touch()
        half.rename(self.maps / f"v{self.newest}")
        return f"v{self.newest}"

    def work(self, number: int, ready: Callable[[], None]) -> None:
        told(self.pids / str(number), str(os.getpid()))
        registry = MapRegistry(table=SharedServingTable(self.memory, number))
        watcher = map_watcher.MapWatcher(registry, [self.maps], warm=lambda _: time.sleep(_CHANCE.uniform(0, 0.02)))

        def scan(*, drop_missing: bool = False, scan: Callable[..., list[str]] = watcher.scan) -> list[str]:
            begun = time.monotonic()
            done = scan(drop_missing=drop_missing)
            if drop_missing:
                told(self.hangups / str(number), repr(begun))
            return done

        watcher.scan = scan  # type: ignore[method-assign]
        watcher.open_first()
        watcher.start(0.05)
        signal.signal(signal.SIGHUP, lambda *_: watcher.look_now())
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGHUP})
        log = os.open(self.log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        ready()
        told(self.answering / str(number), str(os.getpid()))
        while True:
            asked = time.monotonic()
            try:
                version = registry.get("m").bundle.manifest.version
            except StreetfixError as error:
                version = error.code
            os.write(log, f"{version} {asked!r} {time.monotonic()!r}\n".encode())
            time.sleep(0.0005)


class Driver:
    """Makes the changes of an operator, and random faults, one after another."""

    def __init__(self, service: Service, supervisor: int, seed: int) -> None:
        self.supervisor = supervisor
        self.service, self.chance = service, random.Random(seed)  # noqa: S311  # no secret
        self.table = SharedServingTable(service.memory, DRIVER)
        self.switches: list[Switch] = []
        self.done: dict[str, int] = {}
        self._stop = threading.Event()
        self._killing = threading.Lock()

    def run(self, steps: int) -> None:
        killer = threading.Thread(target=self._kill_now_and_then)
        killer.start()
        try:
            for _ in range(steps):
                act = self.chance.choice(
                    (self.arrive, self.choose, self.choose, self.damaged, self.remove, self.hang_up)
                )
                act()
                self.done[act.__name__] = self.done.get(act.__name__, 0) + 1
                time.sleep(self.chance.uniform(0, 0.02))
        finally:
            self._stop.set()
            killer.join()

    @property
    def versions(self) -> list[str]:
        return [each.version for each in self.table.read().maps["m"].versions]

    @property
    def serving(self) -> str:
        return self.table.read().maps["m"].serving

    def arrive(self) -> None:
        """Add a newer version; it serves after any choice."""
        begun = time.monotonic()
        self._until_served(self.service.put(), begun)

    def damaged(self) -> None:
        """Add a damaged bundle; it changes nothing, neither by its number nor by its folder."""
        self.service.put(damaged=True)

    def choose(self) -> None:
        """Choose a version whose folder may be gone."""
        begun, wanted = time.monotonic(), self.chance.choice(self.versions)
        try:
            self.table.choose("m", wanted)
        except StreetfixError:  # a restarted worker could not open it, so it is mounted no more
            return
        self._until_served(wanted, begun)

    def remove(self) -> None:
        """Remove a folder; without SIGHUP that changes nothing."""
        name = self.chance.choice(self.versions)
        if len([each for each in self.versions if (self.service.maps / each).exists()]) > 1:
            shutil.rmtree(self.service.maps / name, ignore_errors=True)

    def hang_up(self) -> None:
        """Send SIGHUP: versions without a folder are unmounted. If the serving one is gone, the newest serves.

        It ends when every worker has looked, so no worker may be killed before.
        """
        with self._killing:
            self.until(lambda: all(map(self.service.memory.lives, range(WORKERS))))
            begun, was = time.monotonic(), self.serving
            gone = [each for each in self.versions if not (self.service.maps / each).exists()]
            os.kill(self.supervisor, signal.SIGHUP)
            self.until(lambda: all(self._looked_at(number) > begun for number in range(WORKERS)))
            assert not set(gone) & set(self.versions)
            if self.serving != was:
                self.switches.append(Switch(self.serving, begun, time.monotonic()))

    def _looked_at(self, number: int) -> float:
        path = self.service.hangups / str(number)
        return float(path.read_text()) if path.exists() else 0.0

    def _until_served(self, version: str, begun: float) -> None:
        was = self.serving
        self.until(lambda: self.serving == version)
        if was != version or not self.switches or self.switches[-1].version != version:
            self.switches.append(Switch(version, begun, time.monotonic()))

    def until(self, true: Callable[[], bool]) -> None:
        until = time.monotonic() + 60
        while not true():
            if time.monotonic() > until:
                raise TimeoutError(f"{self.table.read()} {sorted(each.name for each in self.service.maps.iterdir())}")
            time.sleep(0.001)

    def _answers(self, number: int) -> bool:
        """Return whether a worker runs and has joined, and not its predecessor with the same number."""
        pid, joined = ((folder / str(number)).read_text() for folder in (self.service.pids, self.service.answering))
        return pid == joined and self.service.memory.lives(number)

    def _kill_now_and_then(self) -> None:
        """Kill workers at random. At least one survives, so a version without a folder stays open."""
        while not self._stop.wait(self.chance.uniform(0, 0.15)):
            with self._killing:
                answering = [number for number in range(WORKERS) if self._answers(number)]
                if len(answering) > 1:
                    number = self.chance.choice(answering)
                    os.kill(int((self.service.pids / str(number)).read_text()), signal.SIGKILL)
                    self.until(lambda killed=number: not self.service.memory.lives(killed))  # type: ignore[misc]
                    self.done["kill"] = self.done.get("kill", 0) + 1


def main(folder: Path, steps: int, seed: int) -> None:
    service = Service(folder)
    supervisor = os.fork()
    if supervisor == 0:
        devnull = os.open(os.devnull, os.O_WRONLY)
        os.dup2(devnull, 2)  # each restart is told
        os._exit(workers.supervise(WORKERS, service.work))
    try:
        driver = Driver(service, supervisor, seed)
        # A worker that ends before it ever answered ends the service.
        driver.until(lambda: all((service.answering / str(number)).exists() for number in range(WORKERS)))
        first = driver.serving
        driver.run(steps)
    finally:
        os.kill(supervisor, signal.SIGTERM)
        os.waitpid(supervisor, 0)
    rows = [line.split() for line in service.log.read_text().splitlines()]
    answers = [Named(version, float(asked), float(answered)) for version, asked, answered in rows]
    found = disagreements(first, driver.switches, answers)
    sys.stdout.write(f"{len(answers)} answers, {len(driver.switches)} switches, {driver.done}\n")
    sys.stdout.writelines(f"{each}\n" for each in found[:20])
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
