"""Model of the service: which map version must answer after each action."""

from dataclasses import dataclass, field, replace

#: Number of versions of one map that stay open (docs/serving.md): the serving one and those for a rollback.
MOST_OPEN = 3


@dataclass(frozen=True, slots=True, order=True)
class Version:
    """One version of the map.

    Attributes:
        number: order of creation; later versions have larger numbers.
        id: name of the version in the service.
    """

    number: int
    id: str


@dataclass(frozen=True, slots=True)
class Expected:
    """Versions that may serve after an action.

    Attributes:
        path: versions in the order in which they may serve; the last one stays.
        instead: versions that may stay in place of the last one, where the service has a choice.
        dropped: versions that the service must no longer list.
    """

    path: tuple[str, ...]
    instead: frozenset[str] = frozenset()
    dropped: frozenset[str] = frozenset()

    @property
    def finals(self) -> frozenset[str]:
        """Versions that may serve when all workers have settled."""
        return self.instead | {self.path[-1]}

    def then(self, after: "Expected") -> "Expected":
        """Return the expectation for this action followed by another one.

        Args:
            after: expectation of the second action.
        """
        path = self.path + after.path[after.path[:1] == self.path[-1:] :]
        return Expected(path, self.instead | after.instead, self.dropped | after.dropped)


@dataclass
class Oracle:
    """Bundles on the disk, open versions, and the serving version.

    Rules:
    - A new bundle serves if no open version is newer.
    - Another version serves when an operator chooses it.
    - A bundle whose folder was removed stays open until SIGHUP.
    - A service that starts serves the newest bundle.
    - A bundle that cannot be opened changes nothing.

    Attributes:
        on_disk: complete and valid bundles by folder.
        open: versions that the service has open, the newest first.
        serving: the serving version, one of ``open``.
        is_unsure: a worker was killed while a version without folder was open. Code that knows that the worker has
            restarted resets this flag.
    """

    on_disk: dict[str, Version]
    open: list[Version] = field(default_factory=list)
    serving: Version = field(init=False)
    is_unsure: bool = field(init=False)
    _seen: dict[str, Version] = field(init=False)
    _unseen_by_some: set[str] = field(init=False)  # folders that were absent when a worker started

    def __post_init__(self) -> None:
        self.start()

    def start(self) -> Expected:
        """Start the service: the newest bundle serves."""
        self._seen, self._unseen_by_some, self.is_unsure = dict(self.on_disk), set(), False
        self.open = sorted(set(self.on_disk.values()), reverse=True)[:MOST_OPEN]
        self.serving = self.open[0]
        return Expected((self.serving.id,))

    def appeared(self, folder: str, version: Version) -> Expected:
        """Add a valid bundle that the service has noticed.

        Args:
            folder: name of the bundle's folder.
            version: its version.
        """
        before = self.serving
        self.on_disk[folder] = version
        if self._seen.get(folder) == version:  # the folder was absent, but no SIGHUP came meanwhile
            is_new_to_some = folder in self._unseen_by_some and version == max(version, *self.open)
            return Expected((self.serving.id,), frozenset({version.id} if is_new_to_some else ()))
        self._seen[folder] = version
        self._mount(version)
        return Expected(_path(before, self.serving))

    def removed(self, folder: str) -> None:
        """Remove the folder of a bundle; nothing changes before SIGHUP.

        Args:
            folder: name of the bundle's folder.
        """
        del self.on_disk[folder]

    def sighup(self) -> Expected:
        """Send SIGHUP: the service drops versions without a folder."""
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
        ):  # room again for a version that was left out, and that is newer than all open ones
            instead.add(max(there).id)
        return Expected(_path(before, self.serving), frozenset(instead - {before.id}), dropped)

    def choose(self, version: Version) -> Expected:
        """Let an operator choose an open version.

        Args:
            version: the chosen version.
        """
        before, self.serving = self.serving, version
        return Expected(_path(before, version))

    def worker_started_again(self) -> Expected:
        """Restart a worker. It cannot reopen a version without folder, so all workers may drop that version now or after the restart."""
        self._unseen_by_some |= set(self._seen) - set(self.on_disk)
        self.is_unsure = self.is_unsure or any(map(self.is_gone, self.open))
        return self.unchanged()

    def unsure(self, expected: Expected) -> Expected:
        """Widen an expectation by the newest bundle on the disk, while it is unknown what the workers have dropped.

        Args:
            expected: expectation to widen.
        """
        if not self.is_unsure:
            return expected
        return replace(expected, instead=expected.instead | {max(self.on_disk.values()).id})

    def unchanged(self) -> Expected:
        """Expect the same version to serve."""
        return Expected((self.serving.id,))

    def adopt(self, serving: str, listed: set[str], known: dict[str, Version]) -> str | None:
        """Take over the versions that the service reports; return why they are impossible, or None.

        Args:
            serving: serving version, one of the expected ones.
            listed: open versions that all workers list.
            known: every version that was ever created, by id.
        """
        strange = [each for each in listed if each not in known]
        newest = max(self.on_disk.values())
        if strange or serving not in listed:
            return f"the list has {', '.join(sorted(listed))}, and {serving} serves"
        if newest.id not in listed:
            return f"the list has {', '.join(sorted(listed))}, but {newest.id} is on the disk and newer"
        self.open = sorted((known[each] for each in listed), reverse=True)
        self.serving = known[serving]
        return None

    def is_gone(self, version: Version) -> bool:
        """Return whether a version has no folder.

        Args:
            version: the version to look up.
        """
        return version not in self.on_disk.values()

    def _mount(self, version: Version) -> None:
        self.open = sorted({*self.open, version}, reverse=True)
        if self.open[0] == version:
            self.serving = version
        while len(self.open) > MOST_OPEN:
            self.open.remove([each for each in self.open if each != self.serving][-1])


def _path(before: Version, after: Version) -> tuple[str, ...]:
    return (before.id,) if before == after else (before.id, after.id)
