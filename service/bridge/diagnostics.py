"""How the bridge does, as ROS' diagnostics say it."""

from dataclasses import dataclass
from enum import IntEnum

from service.contract.schema import LocalizeAnswer


class Level(IntEnum):
    """Of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


NAME = "streetfix: localization"


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """One status.

    Attributes:
        stamp_ns: of the colour picture it speaks of; 0 where there is none.
        level: how bad.
        message: for people.
        values: name and value.
    """

    stamp_ns: int
    level: Level
    message: str
    values: tuple[tuple[str, str], ...]


@dataclass(slots=True)
class Counts:
    """What has happened since the start.

    Attributes:
        asked: questions.
        answered: of them, those that were answered.
        published: of them, those whose pose went out.
        failed: questions that ended in an error.
    """

    asked: int = 0
    answered: int = 0
    published: int = 0
    failed: int = 0

    def values(self, dropped: int, rate_hz: float) -> tuple[tuple[str, str], ...]:
        """With pictures that found no partner, and questions a second of late."""
        counted = {"asked": self.asked, "answered": self.answered, "published": self.published, "failed": self.failed}
        told = {name: str(count) for name, count in counted.items()}
        return tuple((told | {"dropped": str(dropped), "rate_hz": f"{rate_hz:.2f}"}).items())


def of_answer(
    answer: LocalizeAnswer, why_not: str, *, stamp_ns: int, latency_s: float, counted: tuple[tuple[str, str], ...]
) -> Diagnosis:
    """OK where the pose went out, else a warning that says why not.

    Args:
        answer: what the service said.
        why_not: why the pose stayed in; empty if it did not.
        stamp_ns: of the picture.
        latency_s: from the question to the answer.
        counted: see ``Counts``.
    """
    confidence = "unknown" if answer.confidence is None else f"{answer.confidence:.3f}"
    values = (
        ("status", answer.status), ("confidence", confidence),
        ("street", "none" if answer.street is None else answer.street.name),
        ("map", f"{answer.map.name}@{answer.map.version}"), ("latency_ms", f"{1e3 * latency_s:.0f}"),
    )  # fmt: skip
    if why_not:
        return Diagnosis(stamp_ns, Level.WARN, f"not published: {why_not}", values + counted)
    return Diagnosis(stamp_ns, Level.OK, f"{answer.status}, confidence {confidence}", values + counted)
