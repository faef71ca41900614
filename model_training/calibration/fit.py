"""Fit a ``Calibration``: an additive model of the confidence, and thresholds from the out-of-map queries."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model_training.calibration.additive import Penalty, fit_additive
from model_training.calibration.bounds import bounded_thresholds
from service.confidence.features import FEATURES, TABLE, Feature
from service.errors import DatasetError
from service.maps.calibration import Calibration, FeatureStatistics, Threshold, probability

#: False-accept rates with a threshold.
RATES = (0.001, 0.002, 0.003, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1)
#: Number of groups of rig families for the thresholds. Each group is predicted by a fit to the others.
FOLDS = 5
#: Kinds of out-of-map queries.
OUT_OF_MAP = ("other_city", "removed_streets", "wall", "room")
#: Strengths of the penalties on contributions and on changes of slope, in queries. They had the smallest loss when each rig family was
#: predicted from the others (decision 0149).
RIDGE, SMOOTH = 3.0, 3.0


@dataclass(frozen=True)
class CalibrationData:
    """Calibration data: the confidence features of localized queries and their labels.

    Attributes:
        evidence: confidence features in the order of ``FEATURES``; NaN without registration (n, F).
        right: whether the position of the answer is right, within ``RIGHT_M`` (n,).
        known: whether the query lies in the map (n,).
        kind: kind of the query, for thresholds and tables (n,).
        family: rig family of the query, for the cross-check (n,).
        error: error of translation (m) and rotation (rad) about map axes; NaN outside of the map and without an answer (n, 6).
        covariance: covariance of the answer, in the order of ``error``; NaN if there is none (n, 6, 6).
        heading_rad: true heading of the camera, counter-clockwise from east; NaN outside of the map (n,).
    """

    evidence: NDArray[np.float64]
    right: NDArray[np.bool_]
    known: NDArray[np.bool_]
    kind: NDArray[np.str_]
    family: NDArray[np.str_]
    error: NDArray[np.float64]
    covariance: NDArray[np.float64]
    heading_rad: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.right)

    def registered(self) -> "CalibrationData":
        """Return the queries with confidence features. The confidence of the others is always 0."""
        return self.where(np.asarray(np.isfinite(self.evidence).all(axis=1)))

    def where(self, keep: NDArray[np.bool_]) -> "CalibrationData":
        """Return some of the queries.

        Args:
            keep: whether to keep each query (n,).
        """
        return CalibrationData(*(getattr(self, name)[keep] for name in CalibrationData.__dataclass_fields__))

    def of_family(self, name: str) -> "CalibrationData":
        """Return the same queries as those of a rig family.

        Args:
            name: name of the family.
        """
        return replace(self, family=np.full(len(self), name))


def pooled(parts: list[CalibrationData]) -> CalibrationData:
    """Join calibration data.

    Args:
        parts: the data to join.
    """
    return CalibrationData(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in CalibrationData.__dataclass_fields__)
    )


def fit(
    data: CalibrationData,
    *,
    measured_on: dict[str, str | float],
    features: tuple[Feature, ...] = TABLE,
    ridge: float = RIDGE,
    smooth: float = SMOOTH,
) -> Calibration:
    """Fit a calibration.

    All rig families have the same total weight, whatever their numbers of queries. In each of them, the queries in the map and the
    out-of-map queries have the same total weight.

    Args:
        data: the calibration data.
        measured_on: description of the data for the calibration file; ``calibration_for`` compares its ``encoder_sha256``.
        features: the features that the models may use, each with its sign.
        ridge: strength of the penalty on the contributions, in queries.
        smooth: strength of the penalty on changes of slope, in queries.

    Raises:
        DatasetError: the data lack right answers, wrong answers, queries in the map or out-of-map queries.
    """
    used = data.registered()
    if used.known.all() or not used.known.any() or used.right.all() or not used.right.any():
        raise DatasetError(
            "calibration needs right and wrong answers, and queries in the map and outside it; send "
            "more queries", field="queries"
        )  # fmt: skip
    weighted, penalty = tuple(feature for feature in features if feature.weighted), Penalty(ridge, smooth)
    alone = tuple(feature for feature in weighted if not feature.rivalry)
    mean, std = used.evidence.mean(axis=0), used.evidence.std(axis=0) + 1e-9
    return Calibration(
        features=tuple(
            FeatureStatistics(name=name, mean=float(mean[k]), std=float(std[k])) for k, name in enumerate(FEATURES)
        ),
        right=fit_additive(used.evidence, used.right, weights_of(used), weighted, penalty),
        known=fit_additive(used.evidence, used.known, weights_of(used), alone, penalty),
        thresholds=thresholds_of(data, held_out_confidences(data, weighted, penalty)),
        measured_on=measured_on | {"queries": len(data)},
    )


def held_out_confidences(data: CalibrationData, features: Sequence[Feature], penalty: Penalty) -> NDArray[np.float64]:
    """Compute the confidence of every row (n,) by a model that was fitted to other rig families; 0 without registration.

    A bound on the false-accept rate needs queries that the model has not seen. With a single family, the model has not seen the row.

    Args:
        data: the calibration data.
        features: the features that the model may use.
        penalty: penalties on the terms.
    """
    families, number = np.unique(data.family, return_inverse=True)
    fold = (number if len(families) > 1 else np.arange(len(data))) % FOLDS
    has = np.isfinite(data.evidence).all(axis=1)
    found = np.zeros(len(data))
    for k in np.unique(fold):
        own, others = has & (fold == k), data.where(has & (fold != k))
        if own.any():
            model = fit_additive(others.evidence, others.right, weights_of(others), features, penalty)
            found[own] = probability(model.log_odds(data.evidence[own], FEATURES))
    return found


def confidences(calibration: Calibration, data: CalibrationData) -> NDArray[np.float64]:
    """Compute the confidence of every row (n,); 0 without registration.

    Args:
        calibration: the calibration.
        data: the data.
    """
    found = np.zeros(len(data))
    has = np.isfinite(data.evidence).all(axis=1)
    found[has] = calibration.confidence(data.evidence[has])
    return found


def weights_of(data: CalibrationData) -> NDArray[np.float64]:
    """Return the weight of each query (n,), with a mean of 1.

    All families have equal weight. In each family, in-map and out-of-map queries have equal weight.

    Args:
        data: the calibration data.
    """
    weight = np.zeros(len(data))
    for family in np.unique(data.family):
        for known in (True, False):
            rows = (data.family == family) & (data.known == known)
            if rows.any():
                weight[rows] = 1.0 / rows.sum()
    return np.asarray(weight * (len(data) / weight.sum()))


def thresholds_of(data: CalibrationData, confidence: NDArray[np.float64]) -> tuple[Threshold, ...]:
    """Return for each rate the least confidence at which the false-accept rate is at most this, with certainty ``bounds.SURE``.

    The bound of ``bounded_thresholds`` covers the finite number of out-of-map queries. Another city, removed streets, walls and rooms
    have equal weight (decision 0039). Rates that the data cannot support have no threshold.

    Args:
        data: the calibration data.
        confidence: confidence of each query (n,).

    Raises:
        DatasetError: the data support none of the rates.
    """
    outside = ~data.known
    kinds = np.array([out_of_map_kind(str(kind)) for kind in data.kind[outside]])
    _, number, counts = np.unique(kinds, return_inverse=True, return_counts=True)
    weight = 1.0 / (len(counts) * counts[number])
    found = bounded_thresholds(confidence[outside], weight, RATES)
    if not found:
        effective = 1.0 / float((weight**2).sum())
        raise DatasetError(
            f"calibration has {effective:.0f} effective out-of-map queries, which support no false-accept rate of "
            f"{RATES[-1]:g} or less; send more queries from outside the map", field="queries",
        )  # fmt: skip
    return found


def out_of_map_kind(kind: str) -> str:
    """Return the kind of an out-of-map query without the names of its rig and its depth preset.

    Args:
        kind: kind of the query, such as ``car_other_city.sgbm``.
    """
    without_preset = kind.split(".", maxsplit=1)[0]
    return next((name for name in OUT_OF_MAP if without_preset.endswith(name)), without_preset)


def expected_calibration_error(confidence: NDArray[np.float64], right: NDArray[np.bool_], *, bins: int = 15) -> float:
    """Compute the expected calibration error with bins of equal mass (Naeini, Cooper and Hauskrecht, AAAI 2015).

    It is the mean absolute difference between the mean confidence and the share of right answers in a bin, weighted by the bin's size.

    Args:
        confidence: confidence of each answer (n,).
        right: whether each answer is right (n,).
        bins: number of bins.
    """
    order = np.argsort(confidence, kind="stable")
    parts = np.array_split(order, bins)
    gaps = [len(part) * abs(confidence[part].mean() - right[part].mean()) for part in parts if len(part)]
    return float(sum(gaps) / len(order))
