"""How often to ask, and which answers go out."""

from dataclasses import dataclass

from service.contract.schema import LocalizeAnswer
from service.errors import RequestError


@dataclass(slots=True)
class Gate:
    """A limit on the rate of questions and on the doubt of answers. An answer that is not LOCALIZED never goes out.

    Attributes:
        rate_hz: questions a second at most; 0 asks for every pair.
        min_confidence: of an answer that goes out; an uncalibrated map's, which has none, passes only at 0.
    """

    rate_hz: float = 1.0
    min_confidence: float = 0.9
    _asked_s: float | None = None

    def __post_init__(self) -> None:
        """Refuse what is no limit.

        Raises:
            RequestError: a number is out of bounds.
        """
        if not 0 <= self.rate_hz < float("inf"):
            raise RequestError(
                f"--rate: {self.rate_hz} is no rate; give questions a second, 0 for no limit", field="rate"
            )
        if not 0 <= self.min_confidence <= 1:
            raise RequestError(
                f"--min-confidence: {self.min_confidence} is no probability; give 0 to 1", field="min_confidence"
            )

    def wait_s(self, now_s: float) -> float:
        """Seconds until the next question; 0 where it may be asked."""
        if self._asked_s is None or not self.rate_hz:
            return 0.0
        return max(0.0, self._asked_s + 1.0 / self.rate_hz - now_s)

    def asked(self, now_s: float) -> None:
        """A question begins."""
        self._asked_s = now_s

    def why_not(self, answer: LocalizeAnswer) -> str:
        """Why an answer stays in; empty if it goes out."""
        if answer.status != "LOCALIZED":
            return answer.status
        if self.min_confidence > 0 and answer.confidence is None:
            return "no confidence: the map is not calibrated; pass --min-confidence 0 to publish nevertheless"
        if (answer.confidence or 0.0) < self.min_confidence:
            return f"confidence {answer.confidence:.3f} is below {self.min_confidence:g}"
        return ""
