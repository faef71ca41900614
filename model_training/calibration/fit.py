"""Fit a ``Calibration``: logistic regression by Newton's method, and thresholds from the out-of-map queries."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.confidence.features import FEATURES, RIVALRY, UNWEIGHED
from service.errors import DatasetError
from service.maps.calibration import Calibration, Logistic, Threshold, expanded, probability, terms

#: False-accept rates with a threshold.
RATES = (0.001, 0.002, 0.003, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1)
#: Strength of the ridge penalty, in queries. It had the smallest loss when each city was predicted from the others (decision 0084).
RIDGE = 10.0


@dataclass(frozen=True)
class Asked:
    """Calibration data: the confidence features of localized queries and their labels.

    Attributes:
        evidence: confidence features in the order of ``FEATURES``; NaN without registration (n, F).
        right: whether the position of the answer is right, within ``RIGHT_M`` (n,).
        known: whether the query lies in the map (n,).
        kind: kind of the query, for thresholds and tables (n,).
    """

    evidence: NDArray[np.float64]
    right: NDArray[np.bool_]
    known: NDArray[np.bool_]
    kind: NDArray[np.str_]

    def __len__(self) -> int:
        return len(self.right)

    def registered(self) -> "Asked":
        """Return the queries with confidence features. The confidence of the others is always 0."""
        keep = np.isfinite(self.evidence).all(axis=1)
        return Asked(self.evidence[keep], self.right[keep], self.known[keep], self.kind[keep])


def pooled(parts: list[Asked]) -> Asked:
    """Join calibration data.

    Args:
        parts: the data to join.
    """
    return Asked(*(np.concatenate([getattr(part, name) for part in parts]) for name in Asked.__dataclass_fields__))


def fit(asked: Asked, *, measured_on: dict[str, str | float], ridge: float = RIDGE) -> Calibration:
    """Fit a calibration.

    The queries in the map and the out-of-map queries have the same total weight, whatever their numbers.

    Args:
        asked: the calibration data.
        measured_on: description of the data for the calibration file; ``calibration_for`` compares its ``encoder_sha256``.
        ridge: strength of the penalty on the weights, in queries.

    Raises:
        DatasetError: the data lack right answers, wrong answers, queries in the map or out-of-map queries.
    """
    used = asked.registered()
    if used.known.all() or not used.known.any() or used.right.all() or not used.right.any():
        raise DatasetError(
            "calibration needs right and wrong answers, and queries in the map and outside it; send "
            "more queries", field="queries"
        )  # fmt: skip
    weight = np.where(used.known, 0.5 / used.known.mean(), 0.5 / (~used.known).mean())
    mean, spread = used.evidence.mean(axis=0), used.evidence.std(axis=0) + 1e-9
    right = _logistic(used.evidence, used.right, weight, mean, spread, ridge, without=UNWEIGHED)
    known = _logistic(used.evidence, used.known, weight, mean, spread, ridge, without=RIVALRY + UNWEIGHED)
    thresholds = _thresholds(asked, right)
    return Calibration(
        features=FEATURES, right=right, known=known, thresholds=thresholds, measured_on=measured_on | {"queries": len(asked)}
    )  # fmt: skip


def _logistic(
    evidence: NDArray[np.float64],
    label: NDArray[np.bool_],
    weight: NDArray[np.float64],
    mean: NDArray[np.float64],
    spread: NDArray[np.float64],
    ridge: float,
    *,
    without: tuple[str, ...],
) -> Logistic:
    wide = expanded(evidence, tuple(mean), tuple(spread))
    silent = [any(FEATURES[k] in without for k in term) for term in terms(len(FEATURES))]
    wide[:, silent] = 0.0
    design = np.c_[wide, np.ones(len(wide))]
    penalty = np.r_[np.full(wide.shape[1], ridge), 1e-6]
    w = np.zeros(design.shape[1])
    for _ in range(100):
        p = probability(design @ w)
        gradient = design.T @ (weight * (p - label)) + penalty * w
        curvature = (design * (weight * p * (1 - p))[:, None]).T @ design + np.diag(penalty)
        step = np.linalg.solve(curvature, gradient)
        w -= step * min(1.0, 5.0 / max(float(np.abs(step).max()), 1e-12))  # a full step far from the optimum overshoots
        if np.abs(step).max() < 1e-9:
            break
    return Logistic(mean=tuple(mean), spread=tuple(spread), weights=tuple(w[:-1]), bias=float(w[-1]))


def _thresholds(asked: Asked, right: Logistic) -> tuple[Threshold, ...]:
    """Return for each rate the confidence that at most this share of the out-of-map queries reaches.

    All kinds of out-of-map queries have equal weight (decision 0039). The worst kind differs between cities, so its threshold would only be
    the highest of several noisy ones.
    """
    confidence = np.zeros(len(asked))
    has = np.isfinite(asked.evidence).all(axis=1)
    confidence[has] = probability(right.log_odds(asked.evidence[has]))
    outside = ~asked.known
    kinds, number, counts = np.unique(asked.kind[outside], return_inverse=True, return_counts=True)
    weight = 1.0 / (len(kinds) * counts[number])
    order = np.argsort(-confidence[outside], kind="stable")
    ranked, passed = confidence[outside][order], np.cumsum(weight[order])
    found = []
    for rate in RATES:
        first_refused = min(int(np.searchsorted(passed, rate * (1 + 1e-9), side="right")), len(ranked) - 1)
        level = float(min(1.0, np.nextafter(ranked[first_refused], 2.0)))
        found.append(Threshold(false_accept_rate=rate, confidence=level))
    return tuple(found)


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
