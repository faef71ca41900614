"""Fit a generalized additive logistic model of monotone, piecewise linear terms."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from service.confidence.features import FEATURES, Feature
from service.maps.calibration import AdditiveModel, Term, probability

#: Quantiles of the calibration data at the knots of a term. Beyond the outer ones the term is constant.
QUANTILES = (0.002, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 0.998)


@dataclass(frozen=True, slots=True)
class Penalty:
    """Penalties of the fit.

    Attributes:
        ridge: strength of the penalty on the squared rise between two knots, in queries.
        smooth: strength of the penalty on the squared change of this rise to the next, in queries.
    """

    ridge: float
    smooth: float


def fit_additive(
    evidence: NDArray[np.float64],
    label: NDArray[np.bool_],
    weight: NDArray[np.float64],
    features: Sequence[Feature],
    penalty: Penalty,
) -> AdditiveModel:
    """Fit the probability of an event by penalized maximum likelihood, with terms that respect the signs of the features.

    Each term is a sum of ramps, one between each two knots. A feature whose sign is known has ramps of this sign only, so its term is
    monotone (Ramsay, Monotone regression splines in action, Statistical Science 1988).

    Args:
        evidence: confidence features in the order of ``FEATURES`` (n, F).
        label: whether the event happened (n,).
        weight: weight of each row (n,).
        features: the features that get a term.
        penalty: penalties on the terms.

    Returns:
        The model. A feature without effect or with a constant value has no term.
    """
    columns = [FEATURES.index(feature.name) for feature in features]
    knots = [_knots(evidence[:, column]) for column in columns]
    design, owner = (
        _ramps(evidence[:, columns], knots),
        np.repeat(np.arange(len(features)), [len(k) - 1 for k in knots]),
    )
    centre = np.average(design, axis=0, weights=weight)
    design -= centre
    adjacent = owner[1:] == owner[:-1]

    def loss(w: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        odds, rises = design @ w[:-1] + w[-1], w[:-1]
        bends = np.where(adjacent, np.diff(rises), 0.0)
        value = float((weight * (np.logaddexp(0, odds) - label * odds)).sum())
        value += 0.5 * penalty.ridge * float(rises @ rises) + 0.5 * penalty.smooth * float(bends @ bends)
        residual = weight * (probability(odds) - label)
        gradient = np.r_[design.T @ residual + penalty.ridge * rises, residual.sum()]
        gradient[1:-1] += penalty.smooth * bends
        gradient[:-2] -= penalty.smooth * bends
        return value, gradient

    limits = {1: (0.0, None), -1: (None, 0.0), 0: (None, None)}
    bounds = [limits[features[int(k)].sign] for k in owner] + [(None, None)]
    best = minimize(
        loss, np.zeros(design.shape[1] + 1), jac=True, bounds=bounds, method="L-BFGS-B", options={"maxiter": 2000, "ftol": 1e-12}
    )  # fmt: skip
    rises = best.x[:-1]
    terms = []
    for k, feature in enumerate(features):
        steps = rises[owner == k]
        if np.abs(steps).max(initial=0.0) < _NONE:
            continue
        contribution = np.r_[0.0, np.cumsum(steps)] - float(steps @ centre[owner == k])
        terms.append(Term(feature=feature.name, knots=tuple(knots[k]), log_odds=tuple(contribution)))
    return AdditiveModel(terms=tuple(terms), bias=float(best.x[-1]))


#: A term whose largest rise is smaller than this, nats, is left out.
_NONE = 1e-3


def _knots(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the knots of a feature: distinct quantiles of its values, none if it is constant."""
    found = np.unique(np.quantile(values, QUANTILES))
    apart = np.r_[True, np.diff(found) > 1e-6 * max(1.0, float(np.ptp(found)))]
    return np.asarray(found[apart])


def _ramps(values: NDArray[np.float64], knots: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return a column for each interval between two knots: 0 before it, 1 after it, linear in between (n, R)."""
    columns = [
        np.clip((values[:, k] - low) / (high - low), 0, 1)
        for k, ends in enumerate(knots)
        for low, high in pairwise(ends)
    ]
    return np.stack(columns, axis=1) if columns else np.empty((len(values), 0))
