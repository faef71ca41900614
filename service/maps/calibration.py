"""``calibration.json``: maps the confidence features of an answer to the probability that its position is right."""

import json
from functools import cache
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from service.errors import BundleError

#: Limit of a normalised feature, standard deviations. It stops extrapolation beyond the calibration data.
CLIP = 4.0
#: Largest distance of a right answer from the ground truth, metres on the ground. Confidence is the probability of a right answer.
RIGHT_M = 1.0


class _Frozen(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Logistic(_Frozen):
    """Logistic regression over the features, their squares and all products of two features.

    Attributes:
        mean: mean of each feature. Normalisation subtracts it.
        spread: standard deviation of each feature. Normalisation divides by it.
        weights: weights of the features, then of the products, in the order of ``terms``.
        bias: log odds where all normalised features are 0.
    """

    mean: tuple[float, ...]
    spread: tuple[float, ...]
    weights: tuple[float, ...]
    bias: float

    @model_validator(mode="after")
    def _positive(self) -> "Logistic":
        if min(self.spread, default=1.0) <= 0:
            raise ValueError("spread must be positive")
        return self

    def log_odds(self, evidence: Float64[NDArray[np.float64], "*n F"]) -> Float64[NDArray[np.float64], "*n"]:
        """Return the log odds for one or more rows of features.

        Args:
            evidence: confidence features in the order of ``features``.
        """
        return np.asarray(expanded(evidence, self.mean, self.spread) @ np.array(self.weights) + self.bias)


def expanded(
    evidence: Float64[NDArray[np.float64], "*n F"], mean: tuple[float, ...], spread: tuple[float, ...]
) -> Float64[NDArray[np.float64], "*n T"]:
    """Normalise features and append their squares and products of two, in the order of ``terms``.

    Args:
        evidence: confidence features, a row per answer.
        mean: mean of each feature.
        spread: standard deviation of each feature.
    """
    z = np.clip((evidence - np.array(mean)) / np.array(spread), -CLIP, CLIP)
    one, other = np.triu_indices(z.shape[-1])
    wide: Float64[NDArray[np.float64], "*n T"] = np.concatenate([z, z[..., one] * z[..., other]], axis=-1)
    return wide


@cache
def terms(count: int) -> tuple[tuple[int, ...], ...]:
    """Return for each term of ``expanded`` the indices of the features that it multiplies.

    Args:
        count: number of features.
    """
    return (*((k,) for k in range(count)), *((j, k) for j in range(count) for k in range(j, count)))


class Threshold(_Frozen):
    """The confidence threshold for one false-accept rate.

    Attributes:
        false_accept_rate: share of out-of-map queries that reach ``confidence``.
        confidence: least confidence of an accepted answer.
    """

    false_accept_rate: float = Field(gt=0, lt=1)
    confidence: float = Field(ge=0, le=1)


class Site(_Frozen):
    """Correction of the confidence from queries that are rendered from this map's own survey (decision 0030).

    The offset only lowers the log odds and the thresholds stay as they are. So fewer answers reach a threshold, and its
    false-accept rate still holds.

    Attributes:
        offset: added to the log odds, at most 0.
        queries: number of rendered queries.
        right: number of queries with a right answer.
        expected_calibration_error: difference between mean confidence and share of right answers. It uses a single bin,
            because more bins would hold too few queries each.
    """

    offset: float = Field(le=0)
    queries: int = Field(ge=0)
    right: int = Field(ge=0)
    expected_calibration_error: float = Field(ge=0, le=1)


class Calibration(_Frozen):
    """All parameters that map confidence features to confidence and status.

    Attributes:
        calibrated: always true. An uncalibrated map has ``false`` in its file.
        features: names of the confidence features. ``service.confidence.features`` defines those that this program computes.
        right: regression of the event that the position is within 1 m.
        known: regression of the event that the query was taken in the map, at any of its places.
        thresholds: sorted by rising false-accept rate.
        site: the map's own correction. None if it was not measured.
        measured_on: description of the calibration data for readers.
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
        count = len(self.features)
        for name, part in (("right", self.right), ("known", self.known)):
            if (len(part.mean), len(part.spread), len(part.weights)) != (count, count, len(terms(count))):
                raise ValueError(f"{name}: mean and spread need {count} numbers, weights {len(terms(count))}")
        rates = [threshold.false_accept_rate for threshold in self.thresholds]
        if rates != sorted(rates):
            raise ValueError("thresholds must be sorted by rising false-accept rate")
        return self

    def confidence(self, evidence: Float64[NDArray[np.float64], "*n F"]) -> Float64[NDArray[np.float64], "*n"]:
        """Return the probability that the position is within 1 m.

        Args:
            evidence: confidence features in the order of ``features``.
        """
        odds = self.right.log_odds(evidence)
        if self.site is not None:
            odds = np.asarray(odds + self.site.offset)
        return probability(odds)

    @property
    def least_false_accept_rate(self) -> float:
        """The lowest false-accept rate that calibration measured."""
        return self.thresholds[0].false_accept_rate

    def threshold(self, false_accept_rate: float) -> float:
        """Return the least confidence of an accepted answer for a given false-accept rate.

        Args:
            false_accept_rate: tolerated share of accepted out-of-map queries. Below ``least_false_accept_rate`` the threshold
                of that rate applies.
        """
        fitting = [each.confidence for each in self.thresholds if each.false_accept_rate <= false_accept_rate]
        return fitting[-1] if fitting else self.thresholds[0].confidence


def probability(log_odds: Float64[NDArray[np.float64], "*n"]) -> Float64[NDArray[np.float64], "*n"]:
    """Return the probability for log odds (logistic function).

    Args:
        log_odds: natural logarithm of the odds.
    """
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(log_odds, -30, 30))))


def read_calibration(document: bytes, *, path: str) -> Calibration | None:
    """Read ``calibration.json``, or return None if it says that the map is not calibrated.

    Args:
        document: content of the file.
        path: path of the file, for the error message.

    Raises:
        BundleError: the document is neither a calibration nor a statement that there is none. The message names the file.
    """
    try:
        content = json.loads(document)
    except (ValueError, RecursionError) as error:
        raise _defect(path, "not valid JSON") from error
    if not isinstance(content, dict) or not isinstance(content.get("calibrated"), bool):
        raise _defect(path, "the field calibrated is missing or not a boolean")
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
