"""The paper's three tables as plots."""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.paper.data import PaperData
from benchmarks.paper.kept import MethodResult
from benchmarks.paper.pace import Pace
from benchmarks.paper.rows import errors_of, minutes_for_paper_images
from benchmarks.paper.tables import PAPER_ACCURACY, PAPER_MED_M, TABLE_II, TITLES, Figures
from research.baselines.paper_data.table_one import CLASS_NAMES, FRAMES_PRINTED, TEST_IMAGES

INK, OURS, THEIRS, PRINTED = "#22303c", "#2a7f62", "#b5532a", "#9aa5ad"
BASELINE_M, PAPER_MIN = 30.3, 138.0  # as Table III prints
#: Lower end of a logarithmic axis, metres.
LEAST_M = 0.01


def clean(axes: Axes) -> None:
    """Remove the upper and right frame of a plot, and add a faint grid.

    Args:
        axes: plot to change.
    """
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)


def table_one(data: PaperData) -> Figure:
    """Draw the frames and test images of each class, the paper's beside ours.

    Args:
        data: shared data.
    """
    figure, panels = plt.subplots(1, 2, figsize=(11, 4.6), sharey=True, layout="tight")
    here = np.bincount(np.asarray(data.frames.street), minlength=len(CLASS_NAMES))
    asked = np.bincount(np.asarray(data.tests["other_drive"].street), minlength=len(CLASS_NAMES))
    at = np.arange(len(CLASS_NAMES))
    for axes, printed, ours, title in (
        (panels[0], FRAMES_PRINTED, here, "LiDAR frames"),
        (panels[1], TEST_IMAGES, asked, "test images (each of both drives)"),
    ):
        axes.barh(at - 0.2, printed, 0.4, color=PRINTED, label="as printed in the paper")
        axes.barh(at + 0.2, ours, 0.4, color=OURS, label="here")
        axes.set_title(title, fontsize=10)
        clean(axes)
    panels[0].set_yticks(at, CLASS_NAMES, fontsize=8)
    panels[0].invert_yaxis()
    panels[1].legend(fontsize=8)
    return figure


def table_two(data: PaperData, results: Mapping[str, MethodResult]) -> Figure:
    """Draw the errors of the five cases on another traversal: images as dots, their median as a line.

    Args:
        data: shared data.
        results: results by method.
    """
    shown = [name for name in ("cnn_knn", "streetfix") if name in results]
    test = data.tests["other_drive"]
    street, rng = np.asarray(test.street), np.random.default_rng(0)
    figure, axes = plt.subplots(figsize=(9, 3.8), layout="tight")
    for k, name in enumerate(shown):
        errors = np.maximum(errors_of(results[name].answers["other_drive"], test), LEAST_M)
        colour = OURS if name == "streetfix" else THEIRS
        for case, (title, _) in enumerate(TABLE_II):
            of_case = errors[street == CLASS_NAMES.index(title)]
            x = case + (k - (len(shown) - 1) / 2) * 0.36
            axes.plot(
                x + rng.uniform(-0.12, 0.12, len(of_case)),
                of_case,
                ".",
                ms=4,
                alpha=0.45,
                color=colour,
                label=name if case == 0 else None,
            )
            if len(of_case):
                axes.plot([x - 0.15, x + 0.15], [np.median(of_case)] * 2, color=INK, lw=1.6)
    axes.set_xticks(range(len(TABLE_II)), [title for title, _ in TABLE_II], fontsize=8)
    # A logarithmic axis without a value cannot be drawn, and a short run may have no image of the five cases.
    drawn = any(np.size(line.get_ydata()) > 0 for line in axes.lines)
    axes.set(yscale="log" if drawn else "linear", ylabel="error, other drive (m)")
    axes.legend(fontsize=8, markerscale=2, loc="upper left", bbox_to_anchor=(1, 1))
    clean(axes)
    return figure


def table_three(results: Mapping[str, MethodResult], figures: Figures, pace: Pace | None) -> Figure:
    """Draw mean error and street accuracy on another traversal, and training minutes for the paper's images, by method.

    Args:
        results: results by method.
        figures: figures by method and split.
        pace: measured training pace; None if absent.
    """
    shown = [name for name in TITLES if name in figures]
    names = ["paper: CNN + K-NN", "paper: its baseline", *shown]
    colours = [PRINTED, PRINTED, *(OURS if name.startswith("streetfix") else THEIRS for name in shown)]
    other = [figures[name]["other_drive"] for name in shown]
    minutes = [minutes_for_paper_images(name, results[name], pace) for name in shown]
    figure, panels = plt.subplots(1, 3, figsize=(13, 0.34 * len(names) + 1.2), sharey=True, layout="tight")
    _bars(
        panels[0],
        [PAPER_MED_M, BASELINE_M, *(e["mean_distance_error_m"] for e in other)],
        colours,
        "mean error (m)",
        log=True,
    )
    _bars(panels[1], [PAPER_ACCURACY, None, *(e["street_accuracy"] for e in other)], colours, "street accuracy")
    _bars(panels[2], [PAPER_MIN, None, *minutes], colours, "minutes of training for the paper's images", log=True)
    panels[0].set_yticks(range(len(names)), names, fontsize=8)
    panels[0].invert_yaxis()
    return figure


def _bars(axes: Axes, values: Sequence[float | None], colours: Sequence[str], title: str, *, log: bool = False) -> None:
    """Draw a bar with its figure for each value; None leaves a gap."""
    known = [value for value in values if value is not None]
    if log:
        axes.set_xscale("log")
        axes.set_xlim(0.5 * min(known), 6 * max(known))
    else:
        axes.set_xlim(0, 1.18)
    for row, (value, colour) in enumerate(zip(values, colours, strict=True)):
        if value is not None:
            axes.barh(row, value, color=colour)
            told = f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
            axes.annotate(told, (value, row), (3, 0), textcoords="offset points", va="center", fontsize=7)
    axes.set_title(title, fontsize=10)
    clean(axes)
