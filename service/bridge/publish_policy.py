"""Query rate, and which answers are published."""

from dataclasses import dataclass

from service.contract.schema import LocalizeAnswer
from service.errors import RequestError


@dataclass(slots=True)
class PublishPolicy:
    """Limits on the rate of queries and on the confidence of published answers. Only LOCALIZED answers are published.

    Attributes:
        rate_hz: maximum queries per second; 0 queries every pair.
        min_confidence: of a published answer. Answers of an uncalibrated map have no confidence and pass only at 0.
    """

    rate_hz: float = 1.0
    min_confidence: float = 0.9
    _last_query_s: float | None = None

    def __post_init__(self) -> None:
        """Check the limits.

        Raises:
            RequestError: a number is out of bounds.
        """
        if not 0 <= self.rate_hz < float("inf"):
            raise RequestError(
                f"--rate: {self.rate_hz} is not a valid rate; give queries per second, 0 for no limit", field="rate"
            )
        if not 0 <= self.min_confidence <= 1:
            raise RequestError(
                f"--min-confidence: {self.min_confidence} is not a valid probability; give 0 to 1",
                field="min_confidence",
            )

    def wait_s(self, now_s: float) -> float:
        """Return the seconds until the next query is due; 0 if it is due now.

        Args:
            now_s: current time of a monotonic clock, s.
        """
        if self._last_query_s is None or not self.rate_hz:
            return 0.0
        return max(0.0, self._last_query_s + 1.0 / self.rate_hz - now_s)

    def record_query(self, now_s: float) -> None:
        """Record the beginning of a query.

        Args:
            now_s: current time of a monotonic clock, s.
        """
        self._last_query_s = now_s

    def why_not(self, answer: LocalizeAnswer) -> str:
        """Return why an answer is not published; empty if it is published.

        Args:
            answer: of the service.
        """
        if answer.status != "LOCALIZED":
            return answer.status
        if self.min_confidence > 0 and answer.confidence is None:
            return "no confidence: the map is not calibrated; pass --min-confidence 0 to publish anyway"
        if (answer.confidence or 0.0) < self.min_confidence:
            return f"confidence {answer.confidence:.3f} is below {self.min_confidence:g}"
        return ""
