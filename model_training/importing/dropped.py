"""Frames that were left out, counted by kind and reason."""

from dataclasses import dataclass, field


@dataclass(slots=True)
class Dropped:
    """Counts by (kind, reason), each with the first frame's name; a drive of days makes no longer list than one of minutes."""

    _counts: dict[tuple[str, str], int] = field(default_factory=dict)
    _first: dict[tuple[str, str], str] = field(default_factory=dict)

    def add(self, kind: str, name: str, why: str) -> None:
        """Count one frame."""
        key = (kind, why)
        self._first.setdefault(key, name)
        self._counts[key] = self._counts.get(key, 0) + 1

    @property
    def count(self) -> int:
        """All of them."""
        return sum(self._counts.values())

    def lines(self) -> list[str]:
        """A line a reason, the most frequent first."""
        ordered = sorted(self._counts, key=lambda key: -self._counts[key])
        return [
            f"{self._counts[kind, why]} {kind}{'s' * (self._counts[kind, why] > 1)}: {why} (first: {self._first[kind, why]})"
            for kind, why in ordered
        ]
