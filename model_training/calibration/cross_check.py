"""Predict each rig family by a calibration that was fitted without it: what a user with another rig can expect."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model_training.calibration.fit import CalibrationData, confidences, expected_calibration_error, fit
from service.confidence.decision import is_acceptable
from service.maps.calibration import Calibration
from service.option_limits import FALSE_ACCEPT_RATE


@dataclass(frozen=True, slots=True)
class FamilyFigures:
    """Figures of a rig family, by a calibration without it. Shares refer to the queries in the map unless stated otherwise.

    A share of nothing is NaN.

    Attributes:
        family: name of the family.
        inside: number of queries in the map.
        outside: number of out-of-map queries.
        accepted: number of LOCALIZED answers, in the map and outside it.
        ece: expected calibration error over all queries.
        within_1_m: share of answers within 1 m, whatever their status.
        localized: share of LOCALIZED answers.
        right_but_refused: share of answers that are right and not LOCALIZED.
        wrong_of_localized: share of the LOCALIZED answers that are wrong. It counts all queries; outside the map each answer is wrong.
        outside_accepted: share of the out-of-map queries that are LOCALIZED.
    """

    family: str
    inside: int
    outside: int
    accepted: int
    ece: float
    within_1_m: float
    localized: float
    right_but_refused: float
    wrong_of_localized: float
    outside_accepted: float


def cross_check(
    data: CalibrationData, *, not_fitted: Sequence[str] = (), false_accept_rate: float = FALSE_ACCEPT_RATE
) -> list[FamilyFigures]:
    """Predict each rig family from the others.

    Args:
        data: calibration data of all families.
        not_fitted: names of the families that take part in no fit.
        false_accept_rate: the rate whose threshold decides the status.

    Raises:
        DatasetError: the other families lack right answers, wrong answers, queries in the map or out-of-map queries.
    """
    usable = ~np.isin(data.family, not_fitted)
    found = []
    for family in np.unique(data.family):
        own = data.family == family
        calibration = fit(data.where(usable & ~own), measured_on={})
        found.append(figures_of(str(family), data.where(own), calibration, false_accept_rate))
    return found


def cross_check_groups(
    data: CalibrationData,
    groups: Mapping[str, Sequence[str]],
    *,
    not_fitted: Sequence[str] = (),
    false_accept_rate: float = FALSE_ACCEPT_RATE,
) -> list[FamilyFigures]:
    """Predict each group of rig families from the families outside of it: what a LiDAR, a camera or a depth type of a new kind can expect.

    Args:
        data: calibration data of all families.
        groups: names of the families of each group, by the name of the group. Families without data do not count.
        not_fitted: names of the families that take part in no fit. They do not count in a group either.
        false_accept_rate: the rate whose threshold decides the status.

    Returns:
        The figures of each group with two families or more. For one family, ``cross_check`` has the same figures.

    Raises:
        DatasetError: the other families lack right answers, wrong answers, queries in the map or out-of-map queries.
    """
    usable, found = ~np.isin(data.family, not_fitted), []
    for name, families in groups.items():
        own = np.isin(data.family, families) & usable
        if len(np.unique(data.family[own])) > 1:
            calibration = fit(data.where(usable & ~own), measured_on={})
            found.append(figures_of(name, data.where(own), calibration, false_accept_rate))
    return found


def figures_of(name: str, own: CalibrationData, calibration: Calibration, false_accept_rate: float) -> FamilyFigures:
    """Return the figures of some queries.

    Args:
        name: name of these queries.
        own: the queries.
        calibration: calibration that was fitted to others.
        false_accept_rate: the rate whose threshold decides the status.
    """
    confidence = confidences(calibration, own)
    localized = accepted(own, calibration, confidence, false_accept_rate)
    inside, outside = own.known, ~own.known
    return FamilyFigures(
        family=name,
        inside=int(inside.sum()),
        outside=int(outside.sum()),
        accepted=int(localized.sum()),
        ece=expected_calibration_error(confidence, own.right),
        within_1_m=_share(own.right[inside]),
        localized=_share(localized[inside]),
        right_but_refused=_share((own.right & ~localized)[inside]),
        wrong_of_localized=_share(~own.right[localized]),
        outside_accepted=_share(localized[outside]),
    )


def accepted(
    data: CalibrationData, calibration: Calibration, confidence: NDArray[np.float64], false_accept_rate: float
) -> NDArray[np.bool_]:
    """Return whether each answer is LOCALIZED (n,), by the rules of ``service.confidence.decision.decide``.

    Args:
        data: calibration data.
        calibration: calibration of the map.
        confidence: confidence of each query (n,).
        false_accept_rate: the rate whose threshold decides.
    """
    found = confidence >= calibration.threshold(false_accept_rate)
    for k in np.flatnonzero(found):
        found[k] = is_acceptable(calibration, data.evidence[k], false_accept_rate)
    return found


def table(figures: list[FamilyFigures]) -> list[str]:
    """Return the figures as lines of text, the largest calibration error first.

    Args:
        figures: figures of the families.
    """
    heads = (f"{head:>{width}}" for head, width in zip(_HEADS, _WIDTHS, strict=True))
    lines = [
        "each rig family, by a calibration without it (shares in %)",
        f"{'family':<14}{'queries':>12}" + "".join(heads),
    ]
    for each in sorted(figures, key=lambda figure: -figure.ece):
        queries = f"{each.inside}+{each.outside}"
        shares = (
            each.ece,
            each.within_1_m,
            each.localized,
            each.right_but_refused,
            each.wrong_of_localized,
            each.outside_accepted,
        )
        columns = (f"{_percent(share):>{width}}" for share, width in zip(shares, _WIDTHS, strict=True))
        lines.append(f"{each.family:<14}{queries:>12}" + "".join(columns))
    return lines


#: Columns of ``table``.
_HEADS = ("ECE", "within 1 m", "LOCALIZED", "right, refused", "wrong of LOCALIZED", "outside accepted")
_WIDTHS = (7, 12, 11, 16, 20, 18)


def _share(events: NDArray[np.bool_]) -> float:
    return float(events.mean()) if len(events) else float("nan")


def _percent(share: float) -> str:
    return "-" if np.isnan(share) else f"{100 * share:.1f}"
