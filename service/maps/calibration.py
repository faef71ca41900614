"""``calibration.json``: maps the confidence features of an answer to the probability that its position is right."""

import json
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_serializer,
    model_validator,
)

from service.errors import BundleError
from service.maps.rig_key import RigKey
from service.option_limits import LEAST_CONFIDENCE

#: Name of a correction for a rig in a map of an earlier release.
UNNAMED = "unnamed"
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


class FeatureRange(_Frozen):
    """Range of a confidence feature in the frames of a recording, in the feature's unit.

    Attributes:
        feature: name of the feature.
        least: smallest value.
        most: largest value.
    """

    feature: str
    least: float
    most: float

    @model_validator(mode="after")
    def _ordered(self) -> "FeatureRange":
        if self.least > self.most:
            raise ValueError(f"{self.feature}: least is larger than most")
        return self


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
    scale is positive, so the order of answers stays the same. The calibration errors come from cross-validation over blocks of consecutive
    frames.

    Attributes:
        name: name of the correction. Answers state it.
        made_for: the rig that the frames come from. None in a map of an earlier release, whose correction applies to every camera.
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
        thresholds: thresholds from the out-of-map frames, sorted by rising false-accept rate. They hold for this rig instead of those of
            the map. Empty: those of the map hold.
        ranges: ranges of features that widen the range of the calibration data for this rig, if the recording supports it. Empty: an
            answer outside the range of the calibration data stays ``extrapolated``.
    """

    name: str = Field(UNNAMED, min_length=1)
    made_for: RigKey | None = None
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
    thresholds: tuple[Threshold, ...] = ()
    ranges: tuple[FeatureRange, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> "RigCorrection":
        _require_rising(self.thresholds)
        return self

    @model_serializer(mode="wrap")
    def _without_new_fields(self, serialize: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        """Leave out what a map of an earlier release does not have, so that its file keeps its bytes and its hash."""
        content = serialize(self)
        nothing = {"name": UNNAMED, "made_for": None, "thresholds": (), "ranges": ()}
        return {
            name: value
            for name, value in content.items()
            if name not in nothing or getattr(self, name) != nothing[name]
        }

    def suits(self, asking: RigKey) -> tuple[bool, int, float] | None:
        """Return how well the correction suits a rig; None if it was made for another one.

        A correction from rendered images only lowers the confidence. So it also suits a rig that does not state its baseline or its range
        limit. A correction from a recording may raise the confidence and set thresholds. So the rig must state the same as the recording.

        Args:
            asking: the rig of a query.

        Returns:
            Whether it comes from a recording, how many of baseline and range limit both rigs state, and the negative distance of the rigs.
            The largest one suits best.
        """
        if self.made_for is None:
            return None
        is_rendered = self.source == "rendered"
        away = self.made_for.distance(asking, other_may_lack=("baseline_m", "max_range_m") if is_rendered else ())
        return None if away is None else (not is_rendered, self.made_for.stated_by_both(asking), -away)

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
        rig: correction for every query, after that of the site. A map of an earlier release may have one, and ``for_rigs`` returns one.
        rigs: corrections for queries of their rigs (``for_rigs``), the last one learned last. Each has its rig.
        measured_on: description of the calibration data for readers.
    """

    calibrated: Literal[True] = True
    features: tuple[FeatureStatistics, ...] = Field(min_length=1)
    right: AdditiveModel
    known: AdditiveModel
    thresholds: tuple[Threshold, ...] = Field(min_length=1)
    site: Site | None = None
    rig: RigCorrection | None = None
    rigs: tuple[RigCorrection, ...] = ()
    measured_on: dict[str, str | float]

    @model_validator(mode="after")
    def _consistent(self) -> "Calibration":
        for name, model in (("right", self.right), ("known", self.known)):
            unknown = [term.feature for term in model.terms if term.feature not in self.names]
            if unknown:
                raise ValueError(f"{name}: {unknown[0]} is not one of the features")
        _require_rising(self.thresholds)
        for number, each in enumerate(self.rigs):
            if each.made_for is None:
                raise ValueError(f"rigs.{number}: made_for is missing; it says which rig the correction is for")
        return self

    @model_serializer(mode="wrap")
    def _without_new_fields(self, serialize: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        """Leave out an empty ``rigs``, so that a map without a correction keeps the bytes and the hash of earlier releases."""
        content = serialize(self)
        return {name: value for name, value in content.items() if name != "rigs" or self.rigs}

    def for_rigs(self, asking: Iterable[RigKey]) -> "Calibration":
        """Return the calibration for a query: its ``rig`` is the correction that applies, and it has no other one.

        The correction must suit the rigs of all images of the query. Of several, the one that suits the first image best applies, and of
        equal ones the one that was learned last. Without one, ``rig`` stays: that of a map of an earlier release.

        Args:
            asking: rigs of the images of the query, the reference first.
        """
        if not self.rigs:
            return self
        keys, chosen = list(dict.fromkeys(asking)), self.rig
        best: tuple[bool, int, float] | None = None
        for each in self.rigs:
            ranks = [each.suits(key) for key in keys]
            first = ranks[0] if ranks and None not in ranks else None
            if first is not None and (best is None or first >= best):
                chosen, best = each, first
        return self.model_copy(update={"rig": chosen, "rigs": ()})

    def confidence(self, evidence: Float64[NDArray[np.float64], "*n F"]) -> Float64[NDArray[np.float64], "*n"]:
        """Return the probability that the position is within 1 m, with the corrections of the site and of ``rig``.

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

    @property
    def least_rate_of_rig(self) -> float | None:
        """The lowest false-accept rate that the recording of ``rig`` supports; None if its correction has no thresholds."""
        return None if self.rig is None or not self.rig.thresholds else self.rig.thresholds[0].false_accept_rate

    def threshold_at(self, false_accept_rate: float) -> Threshold:
        """Return the threshold for a given false-accept rate: that of the highest measured rate that does not exceed it.

        The thresholds of ``rig`` replace those of the map. At a rate that they do not support, the stricter of both applies. The
        confidence is at least ``LEAST_CONFIDENCE``, whatever the rate.

        Args:
            false_accept_rate: tolerated share of accepted out-of-map queries. Below the lowest measured rate the threshold of that rate
                applies.
        """
        found = _threshold_among(self.thresholds, false_accept_rate)
        if self.rig is not None and self.rig.thresholds:
            of_rig = _threshold_among(self.rig.thresholds, false_accept_rate)
            is_supported = of_rig.false_accept_rate <= false_accept_rate
            found = of_rig if is_supported else max(of_rig, found, key=lambda each: each.confidence)
        return found.model_copy(update={"confidence": max(found.confidence, LEAST_CONFIDENCE)})

    def threshold(self, false_accept_rate: float) -> float:
        """Return the least confidence of an accepted answer for a given false-accept rate, as in ``threshold_at``.

        Args:
            false_accept_rate: tolerated share of accepted out-of-map queries.
        """
        return self.threshold_at(false_accept_rate).confidence


def _require_rising(thresholds: Sequence[Threshold]) -> None:
    rates = [threshold.false_accept_rate for threshold in thresholds]
    if rates != sorted(rates):
        raise ValueError("thresholds must be sorted by rising false-accept rate")


def _threshold_among(thresholds: Sequence[Threshold], false_accept_rate: float) -> Threshold:
    """Return the threshold of the highest rate that does not exceed a rate, else that of the lowest rate."""
    fitting = [each for each in thresholds if each.false_accept_rate <= false_accept_rate]
    return fitting[-1] if fitting else thresholds[0]


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
