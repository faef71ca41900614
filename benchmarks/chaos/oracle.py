"""What a service must answer from, worked out from what was done to it."""

from dataclasses import dataclass, field, replace

#: Versions of one map that stay open (docs/serving.md): the one that serves, and what may be rolled back to.
MOST_OPEN = 3


@dataclass(frozen=True, slots=True, order=True)
class Version:
    """One version of the map.

    Attributes:
        number: later ones were made later.
        id: as the service names it.
    """

    number: int
    id: str


@dataclass(frozen=True, slots=True)
class Expected:
    """What may serve after something was done.

    Attributes:
        path: versions in the order in which they may serve; the last one stays.
        instead: versions that may stay in place of the last one, where the service has a choice.
        dropped: versions that the service must not list any more.
    """

    path: tuple[str, ...]
    instead: frozenset[str] = frozenset()
    dropped: frozenset[str] = frozenset()

    @property
    def finals(self) -> frozenset[str]:
        """What may serve when all has settled."""
        return self.instead | {self.path[-1]}

    def then(self, after: "Expected") -> "Expected":
        """This, and then that."""
        path = self.path + after.path[after.path[:1] == self.path[-1:] :]
        return Expected(path, self.instead | after.instead, self.dropped | after.dropped)


@dataclass
class Oracle:
    """Bundles on the disk, open versions, and the one that serves.

    Rules: a new bundle serves if no open version is newer. Another one serves when an operator chooses it. A bundle whose folder was
    removed stays open until SIGHUP. A service that starts serves the newest bundle. One that cannot be opened changes nothing.

    Attributes:
        on_disk: complete and good bundles by folder.
        open: versions that the service has open, the newest first.
        serving: one of them.
        is_unsure: a worker was killed while a version was open whose folder is gone; whoever knows that it has started again resets it.
    """

    on_disk: dict[str, Version]
    open: list[Version] = field(default_factory=list)
    serving: Version = field(init=False)
    is_unsure: bool = field(init=False)
    _seen: dict[str, Version] = field(init=False)
    _unseen_by_some: set[str] = field(init=False)  # a worker started when they were away

    def __post_init__(self) -> None:
        self.start()

    def start(self) -> Expected:
        """The service starts: the newest bundle serves."""
        self._seen, self._unseen_by_some, self.is_unsure = dict(self.on_disk), set(), False
        self.open = sorted(set(self.on_disk.values()), reverse=True)[:MOST_OPEN]
        self.serving = self.open[0]
        return Expected((self.serving.id,))

    def appeared(self, folder: str, version: Version) -> Expected:
        """A good bundle lies in a folder, and the service has looked."""
        before = self.serving
        self.on_disk[folder] = version
        if self._seen.get(folder) == version:  # it was away, but no SIGHUP came meanwhile
            is_new_to_some = folder in self._unseen_by_some and version == max(version, *self.open)
            return Expected((self.serving.id,), frozenset({version.id} if is_new_to_some else ()))
        self._seen[folder] = version
        self._mount(version)
        return Expected(_path(before, self.serving))

    def removed(self, folder: str) -> None:
        """A bundle's folder is gone; nothing changes before SIGHUP."""
        del self.on_disk[folder]

    def sighup(self) -> Expected:
        """What lies in no folder any more is dropped."""
        before = self.serving
        self._unseen_by_some.clear()
        self._seen = {folder: version for folder, version in self._seen.items() if folder in self.on_disk}
        there = set(self.on_disk.values())
        dropped = frozenset(version.id for version in self.open if version not in there)
        self.open = [version for version in self.open if version in there]
        instead: set[str] = set()
        if self.serving not in there:
            if self.open:
                instead.add(self.open[0].id)
            self.serving = max(there)
            if self.serving not in self.open:
                self._mount(self.serving)
        elif max(there) > max(
            self.open
        ):  # there is room again for one that was left out, and it is newer than all that are open
            instead.add(max(there).id)
        return Expected(_path(before, self.serving), frozenset(instead - {before.id}), dropped)

    def choose(self, version: Version) -> Expected:
        """An operator chose an open version."""
        before, self.serving = self.serving, version
        return Expected(_path(before, version))

    def worker_started_again(self) -> Expected:
        """A worker cannot open again what lies in no folder; all may then agree to drop that, now or when it has started."""
        self._unseen_by_some |= set(self._seen) - set(self.on_disk)
        self.is_unsure = self.is_unsure or any(map(self.is_gone, self.open))
        return self.unchanged()

    def unsure(self, expected: Expected) -> Expected:
        """What else may serve as long as it is not known what workers have dropped: the newest bundle on the disk."""
        if not self.is_unsure:
            return expected
        return replace(expected, instead=expected.instead | {max(self.on_disk.values()).id})

    def unchanged(self) -> Expected:
        """Whatever happened, the same version serves."""
        return Expected((self.serving.id,))

    def adopt(self, serving: str, listed: set[str], known: dict[str, Version]) -> str | None:
        """Take over what the service says it has open; why that cannot be, or None.

        Args:
            serving: one of the expected ones.
            listed: open versions that all workers list.
            known: every version that was ever made.
        """
        strange = [each for each in listed if each not in known]
        newest = max(self.on_disk.values())
        if strange or serving not in listed:
            return f"it lists {', '.join(sorted(listed))}, and {serving} serves"
        if newest.id not in listed:
            return f"it lists {', '.join(sorted(listed))}, but {newest.id} is on the disk and newer"
        self.open = sorted((known[each] for each in listed), reverse=True)
        self.serving = known[serving]
        return None

    def is_gone(self, version: Version) -> bool:
        """Whether a version lies in no folder."""
        return version not in self.on_disk.values()

    def _mount(self, version: Version) -> None:
        self.open = sorted({*self.open, version}, reverse=True)
        if self.open[0] == version:
            self.serving = version
        while len(self.open) > MOST_OPEN:
            self.open.remove([each for each in self.open if each != self.serving][-1])


def _path(before: Version, after: Version) -> tuple[str, ...]:
    return (before.id,) if before == after else (before.id, after.id)
