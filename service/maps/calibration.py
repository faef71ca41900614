"""``calibration.json``: maps the confidence features of an answer to the probability that its position is right."""

import json
from collections.abc import Sequence
from itertools import pairwise
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from service.errors import BundleError

#: Largest distance of a right answer from the ground truth, metres on the ground. Confidence is the probability of a right answer.
RIGHT_M = 1.0


class _Frozen(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Term(_Frozen):
    """Contribution of one confidence feature to the log odds: a piecewise linear function.

    Beyond its first and last knot the contribution is constant, so the confidence does not extrapolate.

    Attributes:
        feature: name of the feature.
        knots: values of the feature, rising, in the feature's unit.
        log_odds: contribution at each knot.
    """

    feature: str
    knots: tuple[float, ...] = Field(min_length=2)
    log_odds: tuple[float, ...]

    @model_validator(mode="after")
    def _rising(self) -> "Term":
        if len(self.log_odds) != len(self.knots):
            raise ValueError(f"{self.feature}: {len(self.knots)} knots need as many log_odds, not {len(self.log_odds)}")
        if any(after <= before for before, after in pairwise(self.knots)):
            raise ValueError(f"{self.feature}: knots must rise")
        return self


class AdditiveModel(_Frozen):
    """Generalized additive logistic model (Hastie and Tibshirani, Statistical Science 1986): a sum of functions of single features.

    It has no products of features. A product would reach values that no calibration rig had as soon as a new rig moves two features.

    Attributes:
        terms: contributions of the features. Features without a term do not count.
        bias: log odds without any contribution.
    """

    terms: tuple[Term, ...]
    bias: float

    @model_validator(mode="after")
    def _distinct(self) -> "AdditiveModel":
        names = [term.feature for term in self.terms]
        if len(set(names)) != len(names):
            raise ValueError("terms: a feature has two terms")
        return self

    def log_odds(
        self, evidence: Float64[NDArray[np.float64], "*n F"], names: Sequence[str]
    ) -> Float64[NDArray[np.float64], "*n"]:
        """Return the log odds for one or more rows of features.

        Args:
            evidence: confidence features.
            names: names of the features in their order.
        """
        odds = np.full(evidence.shape[:-1], self.bias)
        for term in self.terms:
            odds = odds + np.interp(evidence[..., names.index(term.feature)], term.knots, term.log_odds)
        return np.asarray(odds)


class FeatureStatistics(_Frozen):
    """Mean and standard deviation of a feature in the calibration data, in the feature's unit."""

    name: str
    mean: float
    std: float = Field(gt=0)


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


class RigCorrection(_Frozen):
    """Correction of the confidence for a camera rig, learned from images of this rig in this map (decision 0150).

    The corrected log odds are ``scale * log_odds + offset``. With ``lower_only`` they are never larger than the log odds themselves. The
    scale is positive, so the order of answers stays the same. The thresholds stay as they are. The calibration errors come from
    cross-validation over blocks of consecutive frames.

    Attributes:
        scale: factor of the log odds.
        offset: added to the scaled log odds.
        lower_only: whether the correction may only lower the confidence, because the frames cannot show that it is too low.
        source: ``drive`` for a recording of the rig, ``rendered`` for images that are rendered from the map.
        measured_on: description of the frames for readers.
        frames: number of labelled frames with confidence features, inside and outside the map.
        right: number of frames with a right answer.
        outside: number of out-of-map frames.
        error_before: expected calibration error without the correction.
        error_after: expected calibration error with corrections that were fitted on other frames.
        accepted: number of frames in the map that are accepted at the default threshold.
        accepted_wrong: number of accepted frames in the map with a wrong answer.
        wrong_share_upper: upper bound (95 %, Clopper-Pearson) of the share of wrong answers among accepted answers.
        outside_accepted: number of out-of-map frames that are accepted at the default threshold.
        outside_share_upper: upper bound (95 %, Clopper-Pearson) of the share of accepted out-of-map frames.
    """

    scale: float = Field(ge=0.2)
    offset: float
    lower_only: bool
    source: Literal["drive", "rendered"]
    measured_on: str
    frames: int = Field(ge=0)
    right: int = Field(ge=0)
    outside: int = Field(ge=0)
    error_before: float = Field(ge=0, le=1)
    error_after: float = Field(ge=0, le=1)
    accepted: int = Field(ge=0)
    accepted_wrong: int = Field(ge=0)
    wrong_share_upper: float = Field(ge=0, le=1)
    outside_accepted: int = Field(ge=0)
    outside_share_upper: float = Field(ge=0, le=1)

    def corrected(self, log_odds: Float64[NDArray[np.float64], "*n"]) -> Float64[NDArray[np.float64], "*n"]:
        """Return the corrected log odds.

        Args:
            log_odds: log odds of the calibration, with the correction of the site.
        """
        return corrected_log_odds(log_odds, self.scale, self.offset, lower_only=self.lower_only)


class Calibration(_Frozen):
    """All parameters that map confidence features to confidence and status.

    Attributes:
        calibrated: always true. An uncalibrated map has ``false`` in its file.
        features: the confidence features in their order. ``service.confidence.features`` defines those that this program computes.
        right: model of the event that the position is within 1 m.
        known: model of the event that the query was taken in the map, at any of its places.
        thresholds: sorted by rising false-accept rate.
        site: the map's own correction. None if it was not measured.
        rig: correction for one camera rig, after that of the site. None if ``streetfix calibrate --map`` did not learn one.
        measured_on: description of the calibration data for readers.
    """

    calibrated: Literal[True] = True
    features: tuple[FeatureStatistics, ...] = Field(min_length=1)
    right: AdditiveModel
    known: AdditiveModel
    thresholds: tuple[Threshold, ...] = Field(min_length=1)
    site: Site | None = None
    rig: RigCorrection | None = None
    measured_on: dict[str, str | float]

    @model_validator(mode="after")
    def _consistent(self) -> "Calibration":
        for name, model in (("right", self.right), ("known", self.known)):
            unknown = [term.feature for term in model.terms if term.feature not in self.names]
            if unknown:
                raise ValueError(f"{name}: {unknown[0]} is not one of the features")
        rates = [threshold.false_accept_rate for threshold in self.thresholds]
        if rates != sorted(rates):
            raise ValueError("thresholds must be sorted by rising false-accept rate")
        return self

    def confidence(self, evidence: Float64[NDArray[np.float64], "*n F"]) -> Float64[NDArray[np.float64], "*n"]:
        """Return the probability that the position is within 1 m.

        Args:
            evidence: confidence features in the order of ``features``.
        """
        odds = self.log_odds("right", evidence)
        if self.site is not None:
            odds = np.asarray(odds + self.site.offset)
        return probability(odds if self.rig is None else self.rig.corrected(odds))

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the confidence features in their order."""
        return tuple(each.name for each in self.features)

    def log_odds(
        self, event: Literal["right", "known"], evidence: Float64[NDArray[np.float64], "*n F"]
    ) -> Float64[NDArray[np.float64], "*n"]:
        """Return the log odds of an event, without the corrections of site and rig.

        Args:
            event: ``right`` or ``known``.
            evidence: confidence features in the order of ``features``.
        """
        return (self.right if event == "right" else self.known).log_odds(evidence, self.names)

    def deviations(self, evidence: Float64[NDArray[np.float64], "*n F"]) -> Float64[NDArray[np.float64], "*n F"]:
        """Return the distance of each feature from its mean in the calibration data, in standard deviations.

        Args:
            evidence: confidence features in the order of ``features``.
        """
        mean, std = np.array([[each.mean, each.std] for each in self.features]).T
        return np.asarray((evidence - mean) / std)

    @property
    def least_false_accept_rate(self) -> float:
        """The lowest false-accept rate that calibration measured."""
        return self.thresholds[0].false_accept_rate

    def threshold_at(self, false_accept_rate: float) -> Threshold:
        """Return the threshold for a given false-accept rate: that of the highest measured rate that does not exceed it.

        Args:
            false_accept_rate: tolerated share of accepted out-of-map queries. Below ``least_false_accept_rate`` the threshold
                of that rate applies.
        """
        fitting = [each for each in self.thresholds if each.false_accept_rate <= false_accept_rate]
        return fitting[-1] if fitting else self.thresholds[0]

    def threshold(self, false_accept_rate: float) -> float:
        """Return the least confidence of an accepted answer for a given false-accept rate, as in ``threshold_at``.

        Args:
            false_accept_rate: tolerated share of accepted out-of-map queries.
        """
        return self.threshold_at(false_accept_rate).confidence


def corrected_log_odds(
    log_odds: Float64[NDArray[np.float64], "*n"], scale: float, offset: float, *, lower_only: bool
) -> Float64[NDArray[np.float64], "*n"]:
    """Return log odds after the correction for a rig, ``scale * log_odds + offset``.

    Args:
        log_odds: log odds of the calibration.
        scale: factor of the log odds.
        offset: added to the scaled log odds.
        lower_only: the corrected log odds are never larger than the log odds.
    """
    corrected = scale * log_odds + offset
    return np.asarray(np.minimum(corrected, log_odds) if lower_only else corrected)


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
    return BundleError(
        f"{path}: {what}; renew the calibration with `streetfix calibrate --map MAP --calibration stock`, or build the map again with this "
        "release", field="calibration.json",
    )  # fmt: skip
