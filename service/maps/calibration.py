"""``calibration.json``: from the evidence of an answer to the probability that it is right; what it was measured on."""

import json
from functools import cache
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from service.errors import BundleError

#: What an answer's confidence rests on, in this order (``service.localization.evidence``).
FEATURES = (
    "margin", "inliers", "similarity", "similarity_margin", "likelihood", "through", "front", "unmapped", "log_sigma", "scale", "votes",
    "entropy", "log_noise", "points", "measured", "place_m",
    "facings", "far", "edges", "residual", "pose_spread", "log_share",
)  # fmt: skip
#: The features that say what rivals there are; whether the place is in the map at all does not depend on them.
RIVALRY = ("margin", "similarity_margin", "votes", "entropy", "pose_spread")
#: ``log_share`` decides beside the confidence (``service.localization.decide``). How similar descriptors are in absolute terms says more
#: of the kind of street than of the place: real ones lie four standard deviations below simulated ones. Both weigh nothing (decision log).
UNWEIGHED = ("log_share", "similarity")
_CLIP = 4.0  # standard deviations: no feature may run further away than calibration has seen


class _Frozen(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Logistic(_Frozen):
    """Logistic regression over features and all their products by two, squares among them.

    Attributes:
        mean: of each feature; what features are told from.
        spread: standard deviation of each, the unit they are told in.
        weights: of the features, then of their products, in the order of ``terms``.
        bias: log odds where all features are at their means.
    """

    mean: tuple[float, ...]
    spread: tuple[float, ...]
    weights: tuple[float, ...]
    bias: float

    @model_validator(mode="after")
    def _lengths(self) -> "Logistic":
        count = len(FEATURES)
        if (len(self.mean), len(self.spread), len(self.weights)) != (count, count, len(terms(count))):
            raise ValueError(f"mean and spread need {count} numbers, weights {len(terms(count))}")
        if min(self.spread) <= 0:
            raise ValueError("spread must be positive")
        return self

    def log_odds(self, evidence: Float64[NDArray[np.float64], "*n F"]) -> Float64[NDArray[np.float64], "*n"]:
        """Of one row of evidence or of many."""
        return np.asarray(expanded(evidence, self.mean, self.spread) @ np.array(self.weights) + self.bias)


def expanded(
    evidence: Float64[NDArray[np.float64], "*n F"], mean: tuple[float, ...], spread: tuple[float, ...]
) -> Float64[NDArray[np.float64], "*n T"]:
    """Features in their units, and their products by two, in the order of ``terms``."""
    z = np.clip((evidence - np.array(mean)) / np.array(spread), -_CLIP, _CLIP)
    one, other = np.triu_indices(z.shape[-1])
    wide: Float64[NDArray[np.float64], "*n T"] = np.concatenate([z, z[..., one] * z[..., other]], axis=-1)
    return wide


@cache
def terms(count: int) -> tuple[tuple[int, ...], ...]:
    """What ``expanded`` makes of so many features: which of them each term is a product of."""
    return (*((k,) for k in range(count)), *((j, k) for j in range(count) for k in range(j, count)))


class Threshold(_Frozen):
    """Answers with at least this confidence are accepted; then so many of the queries that are not in the map are, too."""

    false_accept_rate: float = Field(gt=0, lt=1)
    confidence: float = Field(ge=0, le=1)


class Site(_Frozen):
    """What queries drawn from this map's own survey say of its confidence.

    ``offset``, never above 0, is added to the log odds: thresholds, which do not know of it, are then reached by fewer answers,
    so their false-accept rates hold all the more. ``expected_calibration_error`` is that of a single bin, the mean confidence against the
    share that was right: more bins would hold too few of so few queries.
    """

    offset: float = Field(le=0)
    queries: int = Field(ge=0)
    right: int = Field(ge=0)
    expected_calibration_error: float = Field(ge=0, le=1)


class Calibration(_Frozen):
    """Everything that turns evidence into confidence and status.

    Attributes:
        features: names, as this program knows them.
        right: that the position is within 1 m.
        known: that the query was taken in the map, whichever of its places it resembles.
        thresholds: by rising false-accept rate.
        site: the map's own correction; None where it was not measured.
        measured_on: for people.
    """

    calibrated: Literal[True] = True
    features: tuple[str, ...]
    right: Logistic
    known: Logistic
    thresholds: tuple[Threshold, ...] = Field(min_length=1)
    site: Site | None = None
    measured_on: dict[str, str | float]

    @model_validator(mode="after")
    def _consistent(self) -> "Calibration":
        if self.features != FEATURES:
            raise ValueError(f"its features are not this program's: {', '.join(FEATURES)}")
        rates = [threshold.false_accept_rate for threshold in self.thresholds]
        if rates != sorted(rates):
            raise ValueError("thresholds must come by rising false-accept rate")
        return self

    def confidence(self, evidence: Float64[NDArray[np.float64], "*n F"]) -> Float64[NDArray[np.float64], "*n"]:
        """Probability that the position is within 1 m."""
        odds = self.right.log_odds(evidence)
        if self.site is not None:
            odds = np.asarray(odds + self.site.offset)
        return probability(odds)

    @property
    def least_false_accept_rate(self) -> float:
        """The least that was measured: nothing less can be promised."""
        return self.thresholds[0].false_accept_rate

    def threshold(self, false_accept_rate: float) -> float:
        """The confidence from which on answers are accepted, for a rate of false accepts that one can live with.

        Below ``least_false_accept_rate`` it is that one's.
        """
        fitting = [each.confidence for each in self.thresholds if each.false_accept_rate <= false_accept_rate]
        return fitting[-1] if fitting else self.thresholds[0].confidence


def probability(log_odds: Float64[NDArray[np.float64], "*n"]) -> Float64[NDArray[np.float64], "*n"]:
    """The logistic function."""
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(log_odds, -30, 30))))


def read_calibration(document: bytes, *, path: str) -> Calibration | None:
    """Read ``calibration.json``; None where it says that the map is not calibrated.

    Raises:
        BundleError: it is neither; names the file.
    """
    try:
        content = json.loads(document)
    except (ValueError, RecursionError) as error:
        raise _defect(path, "it is no JSON") from error
    if not isinstance(content, dict) or not isinstance(content.get("calibrated"), bool):
        raise _defect(path, "it does not say whether the map is calibrated")
    if not content["calibrated"]:
        return None
    try:
        return Calibration.model_validate_json(document)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise _defect(path, f"{where}: {first['msg']}" if where else first["msg"]) from error


def _defect(path: str, what: str) -> BundleError:
    return BundleError(f"{path}: {what}; build the map again with this release", field="calibration.json")
