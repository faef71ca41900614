"""The serving table: the mounted versions of each map, and the version that serves. All workers of a service share it.

Every worker opens and warms a version on its own and then *offers* it. A version is *mounted*, for all workers in one change of
the table, once every worker that answers has offered it. Every request reads the table when it begins. So as soon as one
answer has named a new version, no later request is answered by the old one.

Rules, for one worker and for many:

- A version that is newer than all mounted versions of its map serves as soon as it is mounted.
- An operator may choose another mounted version. The choice holds until a newer version is mounted or the chosen one is removed; then
  the newest one serves.
- At most ``MOST_VERSIONS`` of a map stay mounted. Beyond that the oldest version that does not serve is dropped.
- A worker answers only after it has *joined*: it has opened every mounted version. It may be unable to open a version, for example
  if the folder is gone. All workers drop such a version if it does not serve. If it serves, the others keep it and this worker waits.
- A worker that has ended does not count. After the last one has ended, the next worker keeps the versions that it can open. A choice
  of the operator still holds.
"""

import fcntl
import json
import mmap
import tempfile
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any

from service.errors import BundleError, UnknownMapError

#: Maximum number of open versions of one map: the serving one, and those that an operator may roll back to.
MOST_VERSIONS = 3
#: Maximum size of a shared table as JSON. A map with three versions takes about 300 bytes.
_MOST_BYTES = 4 * 2**20
#: Name and version of a map.
Key = tuple[str, str]


@dataclass(frozen=True, slots=True)
class MapVersion:
    """A version of a map. Copies of a bundle share ``version``, but may differ in ``made_at``.

    Attributes:
        name: of the map.
        version: hash of the content.
        made_at: POSIX time; decides which version is newer.
    """

    name: str
    version: str
    made_at: float

    @property
    def key(self) -> Key:
        """Name and version."""
        return self.name, self.version


@dataclass(frozen=True, slots=True)
class MountedMap:
    """The mounted versions of one map.

    Attributes:
        versions: that requests may address, the newest first.
        serving: version that answers if a request names none.
    """

    versions: tuple[MapVersion, ...]
    serving: str


@dataclass(frozen=True, slots=True)
class Table:
    """One immutable state of the table.

    Attributes:
        maps: by name.
        offers: versions that a worker has open and that are not mounted yet, by the number of the worker. Only workers that
            have joined are in it.
        started: whether any worker has ever joined.
    """

    maps: Mapping[str, MountedMap] = field(default_factory=dict)
    offers: Mapping[int, frozenset[MapVersion]] = field(default_factory=dict)
    started: bool = False

    def is_mounted(self, key: Key) -> bool:
        """Return whether a version is mounted.

        Args:
            key: name and version.
        """
        return key[0] in self.maps and any(each.key == key for each in self.maps[key[0]].versions)

    def wants(self, candidate: MapVersion, others: Collection[MapVersion] = ()) -> bool:
        """Return whether a version would stay mounted if it were mounted now.

        Args:
            candidate: the version.
            others: versions that are about to be mounted as well.
        """
        known = self.maps.get(candidate.name)
        versions = () if known is None else known.versions
        beside = [*versions, *(each for each in others if each.name == candidate.name)]
        if any(each.key == candidate.key and each.made_at >= candidate.made_at for each in beside):
            return False
        return candidate in _kept([*beside, candidate], None if known is None else known.serving)


class ServingTable:
    """The table of a service with a single process. It defines the operations of a worker.

    Reading takes no lock. All changes are atomic.
    """

    #: Whether other processes change the table too.
    is_shared = False
    #: Number of this worker.
    number = 0

    def __init__(self) -> None:
        self._table = Table(offers={0: frozenset()}, started=True)

    def read(self) -> Table:
        """The table as it is now; the same object as long as nothing has changed."""
        return self._table

    def join(self, opened: Collection[MapVersion], given_up: Collection[Key] = ()) -> frozenset[MapVersion]:
        """Join the workers that answer, if this worker has every mounted version open.

        Args:
            opened: versions that this worker has open.
            given_up: mounted versions that this worker failed to open.

        Returns:
            Mounted versions that this worker must first open or give up. It has joined if there are none. It cannot give up a
            serving version while another worker answers.
        """
        lacking: frozenset[MapVersion] = frozenset()
        keys = {each.key for each in opened}

        def change(table: Table) -> Table:
            nonlocal lacking
            alone = not set(table.offers) - {self.number}
            mounted = [(each, known.serving) for known in table.maps.values() for each in known.versions]
            missing = [(each, serving) for each, serving in mounted if each.key not in keys]
            if any(each.key not in given_up or (each.version == serving and not alone) for each, serving in missing):
                lacking = frozenset(each for each, _ in missing)
                return table
            table = reduce(_without, (each.key for each, _ in missing), table)
            return replace(table, offers={**table.offers, self.number: frozenset(opened)}, started=True)

        self._change(change)
        return lacking

    def offer(self, version: MapVersion) -> None:
        """Offer a version that this worker has open. It has no effect before the worker has joined.

        Args:
            version: to offer.
        """

        def change(table: Table) -> Table:
            mine = table.offers.get(self.number)
            return table if mine is None else replace(table, offers={**table.offers, self.number: mine | {version}})

        self._change(change)

    def choose(self, name: str, version: str) -> None:
        """Select the serving version of a map.

        Args:
            name: of the map.
            version: a mounted version.

        Raises:
            UnknownMapError: no such map or version is mounted.
        """

        def change(table: Table) -> Table:
            known = table.maps.get(name)
            if known is None:
                raise UnknownMapError(
                    f"map {name[:100]!r} not found; mounted maps: {', '.join(table.maps) or 'none'}", field="map"
                )
            if not table.is_mounted((name, version)):
                mounted = ", ".join(each.version for each in known.versions)
                raise UnknownMapError(
                    f"version {version!r} of {name!r} not found; mounted versions: {mounted}", field="version"
                )
            return replace(table, maps={**table.maps, name: replace(known, serving=version)})

        self._change(change)

    def remove(self, keys: Collection[Key]) -> None:
        """Unmount versions in one change. If a serving version is removed, the newest remaining one serves.

        Args:
            keys: names and versions; unknown ones are ignored.
        """
        self._change(lambda table: reduce(_without, keys, table))

    def settle(self) -> None:
        """Mount versions that waited only for workers that have ended."""
        self._change(lambda table: table)

    def others_offer(self) -> frozenset[MapVersion]:
        """Return the versions that other workers offer and this worker does not."""
        table = self.read()
        mine = {each.key for each in table.offers.get(self.number, ())}
        theirs = [each for number, offered in table.offers.items() if number != self.number for each in offered]
        return frozenset(each for each in theirs if each.key not in mine)

    def _change(self, change: Callable[[Table], Table]) -> None:
        with self._locked():
            changed = _settled(change(self._table))
            if changed != self._table:
                self._table = changed

    @contextmanager
    def _locked(self) -> Iterator[None]:
        with _LOCK:
            yield


#: Guards changes of tables in this process. They take microseconds.
_LOCK = threading.Lock()


class SharedMemory:
    """Memory and locks for the table of several workers. The supervisor creates it before it forks, and workers inherit it.

    No file has a name, so a full disk or a cleanup of temporary folders does no harm. The memory holds a counter and two slots.
    A writer fills the unused slot, then increments the counter, a single aligned word. So a worker that is killed at any point
    leaves a complete table. A reader compares the counter with that of its copy. It reads the slot, under the lock, only if they
    differ.

    The locks are POSIX record locks of an empty file. Byte 0 guards the table. Byte 1 + N is locked while worker N lives. The system
    releases them when a process ends.
    """

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, mmap.PAGESIZE + 2 * _MOST_BYTES)  # shared; untouched pages take no memory
        self._words = memoryview(self._memory)[: mmap.PAGESIZE].cast("I")
        self._locks = tempfile.TemporaryFile()  # noqa: SIM115  # `close` does
        self._store(0, Table())

    def close(self) -> None:
        """Release memory and locks. The supervisor calls this after all workers have ended."""
        self._words.release()
        self._memory.close()
        self._locks.close()

    @property
    def counter(self) -> int:
        """Number of the last change."""
        return self._words[0]

    def load(self) -> Table:
        """Read the table. The caller must hold the lock."""
        at, size = self._slot(self.counter), self._words[1 + self.counter % 2]
        return _from_json(self._memory[at : at + size])

    def store(self, table: Table) -> None:
        """Replace the table. The caller must hold the lock.

        Args:
            table: the new state.

        Raises:
            BundleError: the table is too large.
        """
        self._store((self.counter + 1) % 2**32, table)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Exclude other processes inside the context."""
        fcntl.lockf(self._locks, fcntl.LOCK_EX, 1, 0)
        try:
            yield
        finally:
            fcntl.lockf(self._locks, fcntl.LOCK_UN, 1, 0)

    def live(self, number: int) -> None:
        """Register this process as a worker until it ends.

        Args:
            number: of the worker.
        """
        fcntl.lockf(self._locks, fcntl.LOCK_EX, 1, 1 + number)

    def lives(self, number: int) -> bool:
        """Return whether another process is that worker.

        Args:
            number: of the worker.
        """
        try:
            fcntl.lockf(self._locks, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, 1 + number)
        except OSError:
            return True
        fcntl.lockf(self._locks, fcntl.LOCK_UN, 1, 1 + number)
        return False

    def _store(self, count: int, table: Table) -> None:
        content = _to_json(table)
        if len(content) > _MOST_BYTES:
            raise BundleError(
                f"{len(table.maps)} maps are too many for several workers (their list has {len(content)} bytes); "
                "serve some of them with another service"
            )
        at = self._slot(count)
        self._memory[at : at + len(content)] = content
        self._words[1 + count % 2] = len(content)
        self._words[0] = count

    @staticmethod
    def _slot(count: int) -> int:
        return mmap.PAGESIZE + count % 2 * _MOST_BYTES


class SharedServingTable(ServingTable):
    """The table as seen by one of several workers. Create it in the process of the worker.

    Args:
        memory: inherited from the supervisor.
        number: of this worker.
    """

    is_shared = True

    def __init__(self, memory: SharedMemory, number: int) -> None:
        self._memory, self.number = memory, number
        memory.live(number)
        with memory.locked():
            self._seen, self._table = memory.counter, memory.load()
        # Drop the offers of an earlier worker with this number.
        self._change(lambda table: replace(table, offers={n: each for n, each in table.offers.items() if n != number}))

    def read(self) -> Table:
        """The table as it is now; the same object as long as nothing has changed."""
        if self._memory.counter != self._seen:
            with self._locked():
                self._refresh()
        return self._table

    def _refresh(self) -> None:
        count = self._memory.counter
        if count != self._seen:
            self._table = self._memory.load()
            self._seen = count  # last: a thread that sees the new number without the lock must also see the new table

    def _change(self, change: Callable[[Table], Table]) -> None:
        with self._locked():
            self._refresh()
            living = {n: each for n, each in self._table.offers.items() if n == self.number or self._memory.lives(n)}
            changed = _settled(change(replace(self._table, offers=living)))
            if changed != self._table:
                self._memory.store(changed)
                self._refresh()

    @contextmanager
    def _locked(self) -> Iterator[None]:
        with _LOCK, self._memory.locked():  # record locks do not exclude threads of the same process
            yield


def _settled(table: Table) -> Table:
    """Mount the versions that every answering worker offers, and drop obsolete offers."""
    if not table.offers:
        return table
    offered = [{each.key: each for each in offers} for offers in table.offers.values()]
    common = [max((each[key] for each in offered), key=_rank) for key in set.intersection(*map(set, offered))]
    for version in sorted(common, key=_rank):
        table = _mounted(table, version)
    offers = {n: frozenset(each for each in mine if table.wants(each)) for n, mine in table.offers.items()}
    return replace(table, offers=offers)


def _mounted(table: Table, version: MapVersion) -> Table:
    if not table.wants(version):
        return table
    before = table.maps.get(version.name)
    others = () if before is None else tuple(each for each in before.versions if each.key != version.key)
    newest = all(_rank(version) > _rank(each) for each in others)
    serving = version.version if before is None or newest else before.serving
    return replace(table, maps={**table.maps, version.name: MountedMap(_kept([*others, version], serving), serving)})


def _without(table: Table, key: Key) -> Table:
    name, version = key
    if not table.is_mounted(key):
        return table
    known = table.maps[name]
    left = tuple(each for each in known.versions if each.key != key)
    maps = {each: mounted for each, mounted in table.maps.items() if each != name}
    if left:
        maps[name] = MountedMap(left, left[0].version if known.serving == version else known.serving)
    return replace(table, maps=maps)


def _kept(versions: Collection[MapVersion], serving: str | None) -> tuple[MapVersion, ...]:
    """Keep the newest versions, newest first. The serving version always stays."""
    kept = sorted(versions, key=_rank, reverse=True)
    while len(kept) > MOST_VERSIONS:
        kept.remove([each for each in kept if each.version != serving][-1])
    return tuple(kept)


def _rank(version: MapVersion) -> tuple[float, str]:
    """Sort key by time. The hash breaks ties, so that all workers use the same order."""
    return version.made_at, version.version


def _to_json(table: Table) -> bytes:
    def rows(versions: Collection[MapVersion]) -> list[list[Any]]:
        return [[each.name, each.version, each.made_at] for each in versions]

    return json.dumps(
        {
            "started": table.started,
            "maps": [[rows(known.versions), known.serving] for known in table.maps.values()],
            "offers": [[number, rows(offered)] for number, offered in table.offers.items()],
        }
    ).encode()


def _from_json(content: bytes) -> Table:
    document = json.loads(content)
    maps = {}
    for rows, serving in document["maps"]:
        versions = tuple(MapVersion(*row) for row in rows)
        maps[versions[0].name] = MountedMap(versions, serving)
    offers = {number: frozenset(MapVersion(*row) for row in rows) for number, rows in document["offers"]}
    return Table(maps, offers, document["started"])
