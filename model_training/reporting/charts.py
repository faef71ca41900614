"""Plots of answers: errors, recall, confidence against ground truth, and query sets side by side."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from model_training.evaluation.error_measures import wilson_interval
from model_training.evaluation.failures import position_errors
from model_training.evaluation.measures import recall_at
from model_training.evaluation.predict import RANKED, Predictions, joined
from model_training.reporting.chart import SERIES, chart, shares_up
from service.maps.calibration import RIGHT_M

#: Ends of the axis of distances, and the distances with a number, metres.
_NEAR_M, _FAR_M = 0.01, 300.0
_NUMBERED_M = (0.01, 0.1, 0.5, 1.0, 5.0, 20.0, 100.0)
_BINS = 10


def series_of(runs: Mapping[str, Predictions]) -> dict[str, Predictions]:
    """Return the answers to plot by name: all queries, and each set if there are enough colours.

    Args:
        runs: answers by query set.
    """
    if len(runs) == 1 or len(runs) >= len(SERIES):
        return {"all queries": joined(list(runs.values()))}
    return {"all queries": joined(list(runs.values())), **runs}


def error_curve(runs: Mapping[str, Predictions]) -> str:
    """Plot the share of all queries whose answer lies within a distance, whatever its status; return HTML.

    Args:
        runs: answers by name.
    """
    reach = np.geomspace(_NEAR_M, _FAR_M, 90)
    first = next(iter(runs.values()))
    alt_text = "; ".join(
        f"{share:.1%} within {m:g} m" for m, share in zip((0.5, 1, 5), _share_within(first, [0.5, 1, 5]), strict=True)
    )

    def draw(axes: Axes) -> None:
        for name, p in runs.items():
            axes.plot(reach, _share_within(p, reach), label=name, clip_on=False)
        _metres_across(axes)
        shares_up(axes, "share of queries, %")

    return chart("Share of queries within a distance", alt_text, draw, legend=len(runs) > 1)


def _metres_across(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_xticks(_NUMBERED_M, [f"{metres:g}" for metres in _NUMBERED_M])
    axes.set_xticks([], minor=True)
    axes.set(xlim=(_NEAR_M, _FAR_M), xlabel="distance from the truth, m")


def _share_within(p: Predictions, reach: ArrayLike) -> NDArray[np.float64]:
    shares = (position_errors(p)[:, None] <= np.asarray(reach)).mean(axis=0)
    return np.asarray(shares, np.float64)


def error_histogram(p: Predictions) -> str:
    """Plot a histogram of position errors; return HTML. Errors beyond the axis count at its end.

    Args:
        p: answers with ground truth.
    """
    errors = position_errors(p)
    edges = np.geomspace(_NEAR_M, _FAR_M, 46)
    counts, _ = np.histogram(np.clip(errors[np.isfinite(errors)], edges[0], edges[-1]), edges)
    alt_text = f"{int(np.isfinite(errors).sum())} answers; half of them within {_median(errors):.2f} m"

    def draw(axes: Axes) -> None:
        axes.stairs(counts, edges, fill=True, color=SERIES[1])
        _metres_across(axes)
        axes.set(ylim=(0.0, 1.05 * max(1, int(counts.max()))), ylabel="queries")
        axes.yaxis.set_major_locator(MaxNLocator("auto", integer=True))

    return chart("Answers by distance from the truth", alt_text, draw)


def _median(errors: NDArray[np.float64]) -> float:
    answered = errors[np.isfinite(errors)]
    return float(np.median(answered)) if len(answered) else float("nan")


def recall_curves(runs: Mapping[str, Predictions]) -> str:
    """Plot the share of queries with the correct place among the first k neighbours; return HTML.

    Args:
        runs: answers by name.
    """
    k = np.arange(1, RANKED + 1)
    recalls = {name: [recall_at(p.ranked_xy, p.T_true[:, :2, 3], int(n)).mean() for n in k] for name, p in runs.items()}
    first = next(iter(recalls.values()))
    alt_text = f"{first[0]:.1%} at one place, {first[4]:.1%} at five, {first[-1]:.1%} at ten"

    def draw(axes: Axes) -> None:
        for name, recall in recalls.items():
            axes.plot(k, recall, label=name, clip_on=False)
        axes.set(xlim=(1, RANKED), xticks=k, xlabel="number of most similar places")
        shares_up(axes, "share of queries, %")

    return chart("Recall at 5 m", alt_text, draw, legend=len(runs) > 1)


def reliability(p: Predictions) -> tuple[str, float] | None:
    """Plot the share of correct answers by confidence; return HTML and the expected calibration error, or None without confidences.

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
    alt_text = "; ".join(f"of confidence {c:.2f}: {share:.0%} right" for c, share in points)

    def draw(axes: Axes) -> None:
        axes.axline((0, 0), (1, 1), color=SERIES[0], linewidth=1, linestyle="--")
        _dots(axes, np.array(points), np.array(intervals))
        axes.set(xlim=(0.0, 1.0), xlabel="confidence")
        shares_up(axes, "within 1 m, %")

    return chart("Confidence against truth", alt_text, draw), float(gap)


def _dots(axes: Axes, points: NDArray[np.float64], intervals: NDArray[np.float64]) -> None:
    """Draw points (n, 2), each with the ends of its vertical interval (n, 2)."""
    axes.vlines(points[:, 0], intervals[:, 0], intervals[:, 1], color=SERIES[1], linewidth=2)
    axes.plot(points[:, 0], points[:, 1], "o", color=SERIES[1], clip_on=False, zorder=3)


def side_by_side(shares: Mapping[str, tuple[float, float, float]], label: str) -> str:
    """Plot a share of each query set with its interval; return HTML.

    Args:
        shares: share, lower end and upper end by query set.
        label: name of the share.
    """
    values = np.array(list(shares.values()))
    number = np.arange(1, len(shares) + 1)
    alt_text = "; ".join(f"{name} {share:.1%} ({low:.1%} to {high:.1%})" for name, (share, low, high) in shares.items())

    def draw(axes: Axes) -> None:
        _dots(axes, np.column_stack([number, values[:, 0]]), values[:, 1:])
        axes.set(xlim=(0.5, len(shares) + 0.5), xticks=number, xlabel="query set, in the table's order")
        shares_up(axes, f"{label}, %")

    return chart(label, alt_text, draw)
