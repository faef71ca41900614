"""Plots of answers: errors, recall, confidence against ground truth, and query sets side by side."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model_training.evaluation.error_measures import wilson_interval
from model_training.evaluation.failures import position_errors
from model_training.evaluation.measures import RIGHT_M, recall_at
from model_training.evaluation.predict import RANKED, Predictions, joined
from model_training.reporting.svg import COLOURS, Axis, Series, histogram, percent_axis, plot

_METRES = Axis(
    "distance from the truth, m", 0.01, 300.0,
    ((0.01, "0.01"), (0.1, "0.1"), (0.5, "0.5"), (1.0, "1"), (5.0, "5"), (20.0, "20"), (100.0, "100")), log=True,
)  # fmt: skip
_BINS = 10


def series_of(runs: Mapping[str, Predictions]) -> dict[str, Predictions]:
    """Return the answers to plot by name: all queries, and each set if there are enough colours.

    Args:
        runs: answers by query set.
    """
    if len(runs) == 1 or len(runs) >= COLOURS:
        return {"all queries": joined(list(runs.values()))}
    return {"all queries": joined(list(runs.values())), **runs}


def error_curve(runs: Mapping[str, Predictions]) -> str:
    """Plot the share of all queries whose answer lies within a distance, whatever its status; return SVG.

    Args:
        runs: answers by name.
    """
    reach = np.geomspace(_METRES.low, _METRES.high, 90)
    drawn = [Series(name, np.column_stack([reach, _share_within(p, reach)])) for name, p in runs.items()]
    first = next(iter(runs.values()))
    told = "; ".join(
        f"{share:.1%} within {m:g} m" for m, share in zip((0.5, 1, 5), _share_within(first, [0.5, 1, 5]), strict=True)
    )
    return plot("Share of queries within a distance", told, _METRES, percent_axis("share of queries, %"), drawn)


def _share_within(p: Predictions, reach: ArrayLike) -> NDArray[np.float64]:
    shares = (position_errors(p)[:, None] <= np.asarray(reach)).mean(axis=0)
    return np.asarray(shares, np.float64)


def error_histogram(p: Predictions) -> str:
    """Plot a histogram of position errors; return SVG. Errors beyond the axis count at its end.

    Args:
        p: answers with ground truth.
    """
    errors = position_errors(p)
    edges = np.geomspace(_METRES.low, _METRES.high, 46)
    counts, _ = np.histogram(np.clip(errors[np.isfinite(errors)], edges[0], edges[-1]), edges)
    told = f"{int(np.isfinite(errors).sum())} answers; half of them within {_median(errors):.2f} m"
    return histogram("Answers by distance from the truth", told, _METRES, edges, counts)


def _median(errors: NDArray[np.float64]) -> float:
    answered = errors[np.isfinite(errors)]
    return float(np.median(answered)) if len(answered) else float("nan")


def recall_curves(runs: Mapping[str, Predictions]) -> str:
    """Plot the share of queries with the correct place among the first k neighbours; return SVG.

    Args:
        runs: answers by name.
    """
    k = np.arange(1, RANKED + 1)
    recalls = {name: [recall_at(p.ranked_xy, p.T_true[:, :2, 3], int(n)).mean() for n in k] for name, p in runs.items()}
    axis = Axis("most similar places that are looked at", 1, RANKED, tuple((float(n), str(n)) for n in k))
    first = next(iter(recalls.values()))
    told = f"{first[0]:.1%} at one place, {first[4]:.1%} at five, {first[-1]:.1%} at ten"
    drawn = [Series(name, np.column_stack([k, recall]).astype(np.float64)) for name, recall in recalls.items()]
    return plot("Recall at 5 m", told, axis, percent_axis("share of queries, %"), drawn)


def reliability(p: Predictions) -> tuple[str, float] | None:
    """Plot the share of correct answers by confidence; return SVG and the expected calibration error, or None without confidences.

    Args:
        p: answers with ground truth.
    """
    known = np.isfinite(p.confidence)
    if not known.any():
        return None
    confidence, right = p.confidence[known], position_errors(p)[known] <= RIGHT_M
    in_bin = np.minimum((confidence * _BINS).astype(int), _BINS - 1)
    points, intervals, gap = [], [], 0.0
    for number in range(_BINS):
        chosen = in_bin == number
        if chosen.any():
            points.append([confidence[chosen].mean(), right[chosen].mean()])
            intervals.append(wilson_interval(int(right[chosen].sum()), int(chosen.sum())))
            gap += abs(points[-1][0] - points[-1][1]) * chosen.mean()
    told = "; ".join(f"of confidence {c:.2f}: {share:.0%} right" for c, share in points)
    axis = Axis("confidence", 0.0, 1.0, tuple((j / 5, f"{j / 5:g}") for j in range(6)))
    drawn = Series("answers", np.array(points), line=False, intervals=np.array(intervals))
    return plot("Confidence against truth", told, axis, percent_axis("within 1 m, %"), [drawn], diagonal=True), float(
        gap
    )


def side_by_side(shares: Mapping[str, tuple[float, float, float]], label: str) -> str:
    """Plot a share of each query set with its interval; return SVG.

    Args:
        shares: share, lower end and upper end by query set.
        label: name of the share.
    """
    names = list(shares)
    axis = Axis(
        "query set, in the table's order",
        0.5,
        len(names) + 0.5,
        tuple((k + 1.0, str(k + 1)) for k in range(len(names))),
    )
    values = np.array([shares[name] for name in names])
    points = np.column_stack([np.arange(1, len(names) + 1), values[:, 0]])
    told = "; ".join(f"{name} {share:.1%} ({low:.1%} to {high:.1%})" for name, (share, low, high) in shares.items())
    return plot(
        label, told, axis, percent_axis(f"{label}, %"), [Series(label, points, line=False, intervals=values[:, 1:])]
    )
