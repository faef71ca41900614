"""State of the bridge as ROS diagnostics."""

from dataclasses import dataclass
from enum import IntEnum

from service.contract.schema import LocalizeAnswer


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


NAME = "streetfix: localization"


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """One diagnostic status.

    Attributes:
        stamp_ns: of the RGB image that it refers to, ns; 0 if there is none.
        level: severity.
        message: readable text.
        values: names and values.
    """

    stamp_ns: int
    level: Level
    message: str
    values: tuple[tuple[str, str], ...]


@dataclass(slots=True)
class Counts:
    """Counts since the start.

    Attributes:
        queries: queries.
        answered: queries with an answer.
        published: answers whose pose was published.
        failed: queries that ended with an error.
    """

    queries: int = 0
    answered: int = 0
    published: int = 0
    failed: int = 0

    def values(self, dropped: int, rate_hz: float) -> tuple[tuple[str, str], ...]:
        """Return all counts as names and values.

        Args:
            dropped: number of images that were dropped without a partner.
            rate_hz: recent rate of queries, Hz.
        """
        counted = {
            "queries": self.queries,
            "answered": self.answered,
            "published": self.published,
            "failed": self.failed,
        }
        texts = {name: str(count) for name, count in counted.items()}
        return tuple((texts | {"dropped": str(dropped), "rate_hz": f"{rate_hz:.2f}"}).items())


def of_answer(
    answer: LocalizeAnswer, why_not: str, *, stamp_ns: int, latency_s: float, counted: tuple[tuple[str, str], ...]
) -> Diagnosis:
    """Build the diagnosis of an answer: OK if the pose was published, else a warning with the reason.

    Args:
        answer: of the service.
        why_not: why the pose was not published; empty if it was.
        stamp_ns: of the RGB image, ns.
        latency_s: from the query to the answer, s.
        counted: further names and values, such as those of ``Counts.values``.
    """
    confidence = "unknown" if answer.confidence is None else f"{answer.confidence:.3f}"
    height, belief, threshold = answer.camera_height, answer.belief, answer.threshold
    values = (
        ("status", answer.status),
        ("confidence", confidence),
        ("street", "none" if answer.street is None else answer.street.name),
        ("map", f"{answer.map.name}@{answer.map.version}"),
        ("camera_height", "unknown" if height is None else f"{height.height_m:.2f} m, {height.origin}"),
        (
            "threshold",
            "none" if threshold is None else f"{threshold.confidence:.3f} at a rate of {threshold.false_accept_rate:g}",
        ),
        ("calibration", answer.calibration or "unknown"),
        ("extrapolated", ", ".join(f"{name} {size:+.1f}" for name, size in answer.extrapolated.items()) or "none"),
        ("rig_correction", answer.rig_correction or "none"),
        ("belief", "none" if belief is None or not belief.modes else f"{belief.modes[0].weight:.3f}"),
        ("epoch", "none" if belief is None else str(belief.epoch)),
        ("latency_ms", f"{1e3 * latency_s:.0f}"),
    )
    if why_not:
        return Diagnosis(stamp_ns, Level.WARN, f"not published: {why_not}", values + counted)
    return Diagnosis(stamp_ns, Level.OK, f"{answer.status}, confidence {confidence}", values + counted)
