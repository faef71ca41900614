"""Count frames that were left out, by kind and reason."""

from dataclasses import dataclass, field


@dataclass(slots=True)
class Dropped:
    """Counts of frames by kind and reason, with the name of the first frame of each.

    So the list of a long recording is no longer than that of a short one.
    """

    _counts: dict[tuple[str, str], int] = field(default_factory=dict)
    _first: dict[tuple[str, str], str] = field(default_factory=dict)

    def add(self, kind: str, name: str, why: str) -> None:
        """Count one frame.

        Args:
            kind: of the frame, such as ``scan`` or ``picture``.
            name: of the frame.
            why: the reason; the same text for all frames with that reason.
        """
        key = (kind, why)
        self._first.setdefault(key, name)
        self._counts[key] = self._counts.get(key, 0) + 1

    @property
    def count(self) -> int:
        """Number of frames that were left out."""
        return sum(self._counts.values())

    def lines(self) -> list[str]:
        """Return one line per kind and reason, the most frequent first."""
        ordered = sorted(self._counts, key=lambda key: -self._counts[key])
        return [
            f"{self._counts[kind, why]} {kind}{'s' * (self._counts[kind, why] > 1)}: {why} (first: {self._first[kind, why]})"
            for kind, why in ordered
        ]
