"""Which version of a map an operator chose, told to all workers of a service through a file."""

import fcntl
import json
from pathlib import Path


class Choices:
    """Choices by map; each worker applies those it has not seen.

    Args:
        path: of the file that workers share; made by the first choice.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen = 0

    def choose(self, name: str, version: str) -> None:
        """Write a choice down; the worker that does so has applied it."""
        with self._path.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            known = self._read()
            number = 1 + max((each[1] for each in known.values()), default=0)
            part = self._path.with_suffix(".part")
            part.write_text(json.dumps(known | {name: (version, number)}))
            part.rename(self._path)

    def news(self) -> list[tuple[str, str]]:
        """Name and version of what was chosen since the last call, the earliest first."""
        known = sorted(self._read().items(), key=lambda item: item[1][1])
        new = [(name, version) for name, (version, number) in known if number > self._seen]
        self._seen = max((number for _, (_, number) in known), default=self._seen)
        return new

    def _read(self) -> dict[str, tuple[str, int]]:
        if not self._path.exists():
            return {}
        return {name: (version, number) for name, (version, number) in json.loads(self._path.read_text()).items()}
