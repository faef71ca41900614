"""Counterparts of the paper's figures, and the distribution of the methods' errors."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from numpy.typing import NDArray

from benchmarks.paper.data import PaperData, test_set
from benchmarks.paper.kept import MethodResult
from benchmarks.paper.pace import Pace
from benchmarks.paper.rows import errors_of
from benchmarks.paper.table_figures import INK, OURS, THEIRS, clean, table_one, table_three, table_two
from benchmarks.paper.tables import DRIVES, TITLES, Figures
from model_training.datasets.dataset import Dataset, QueryFrame
from research.baselines.learning import CurvePoint
from research.baselines.paper.knn import KS
from research.baselines.paper.pictures import LidarPictures, fused_pictures
from research.baselines.regression.locate import STAGES
from service.imaging.fusion import fuse, picture_of
from service.maps.streets import Streets

COLOURS = ("#2a7f62", "#b5532a", "#3b6ea5", "#8a5aa8", "#c79a1b", "#5b6b7b", "#d1495b", "#4a8f9c", "#1b1b1b", "#e08fb0")
MAX_DEPTH_M = 40.0


def draw_figures(
    folder: Path, data: PaperData, results: Mapping[str, MethodResult], figures: Figures, pace: Pace | None = None
) -> dict[str, str]:
    """Draw all figures that the results allow; return titles and paths relative to the page beside ``folder``.

    Args:
        folder: folder of the images.
        data: shared data.
        results: results by method.
        figures: figures by method and split.
        pace: measured training pace; None if absent.
    """
    folder.mkdir(parents=True, exist_ok=True)
    drawn: dict[str, str] = {}

    def keep(name: str, title: str, figure: Figure | None) -> None:
        if figure is None:
            return
        figure.savefig(folder / f"{name}.png", dpi=90, bbox_inches="tight")
        plt.close(figure)
        drawn[title] = f"{folder.name}/{name}.png"

    keep("figure4", "Figure 4: the sensors", _setup())
    keep("figure5", "Figure 5: RGB and depth of one test image", _rgb_and_depth(data.dataset))
    keep("figure6", "Figures 6 and 7: one LiDAR frame, from the side and from above", _scan(data.dataset))
    keep("pictures25d", "2.5D images of neighbouring frames, with PCA (top) and without PCA", _pictures25d(data))
    keep("figure8", "Figure 8: the city and its nine streets", _city(data.dataset))
    keep("figure10", "Figure 10: validation curve of each training", _curves(results))
    keep("figure11", "Figure 11: RGB, depth, and both fused by IHS", _fused(data.dataset))
    keep("one_space", "LiDAR view (top) and fused query on the same view grid", _one_space(data))
    keep("table1", "Table I as bars", table_one(data))
    keep("table2", "Table II: all images of the five classes; lines are medians", table_two(data, results))
    keep(
        "table3",
        "Table III as bars; figures of the paper as printed, for its own drive",
        table_three(results, figures, pace),
    )
    keep("errors", "Errors on both drives", _errors(data, results))
    keep("k", "K-NN by k; dashed lines are softmax", _by_k(results))
    return drawn


def _setup() -> Figure:
    figure, axes = plt.subplots(figsize=(8, 2.8))
    axes.add_patch(Rectangle((-1.6, 0.35), 2.6, 0.75, facecolor="#cfd8dc", edgecolor=INK))
    for x in (-1.1, 0.5):
        axes.add_patch(Circle((x, 0.35), 0.33, facecolor=INK))
    axes.plot([-0.4, -0.4], [1.1, 1.75], color=INK, lw=2)
    for angle in np.deg2rad(np.linspace(-15, 15, 9)):
        for way in (1, -1):
            reach = 9.0 if angle >= 0 else min(9.0, 1.8 / np.sin(-angle))
            axes.plot(
                [-0.4, -0.4 + way * reach * np.cos(angle)],
                [1.8, 1.8 + reach * np.sin(angle)],
                color=OURS,
                lw=0.6,
                alpha=0.6,
            )
    slope = np.tan(np.arctan(240 / 320))
    axes.fill([1.0, 9.0, 9.0, 1.0 + 1.5 / slope], [1.5, 1.5 + 8 * slope, 0, 0], color=THEIRS, alpha=0.12)
    axes.plot(1.0, 1.5, "s", color=THEIRS, ms=7)
    axes.plot(-0.4, 1.8, "o", color=OURS, ms=8)
    axes.axhline(0, color=INK, lw=1)
    for text, at, where, side, colour in (
        ("LiDAR, 32 beams, +-15 degrees, 1.8 m", (-0.4, 1.8), (-8.7, 4.1), "left", OURS),
        ("RGB and depth, 640 x 480, 90 degrees, 1.5 m", (1.0, 1.5), (8.7, 4.1), "right", THEIRS),
    ):
        axes.annotate(text, at, where, arrowprops={"arrowstyle": "-", "color": INK}, color=colour, ha=side, fontsize=9)
    axes.set(xlim=(-9, 9), ylim=(-0.2, 4.7), aspect="equal", xlabel="m", ylabel="m")
    return figure


def _first(dataset: Dataset, split: str = "other_drive", number: int = 5) -> QueryFrame:
    frames = list(dataset.queries(test_set(split)))
    return frames[min(number, len(frames) - 1)]


def _shown_depth(depth_m: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.where(depth_m > 0, depth_m, np.nan).astype(np.float64)


def _rgb_and_depth(dataset: Dataset) -> Figure:
    frame = _first(dataset)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4))
    axes[0].imshow(frame.rgb())
    shown = axes[1].imshow(_shown_depth(frame.depth_m()), cmap="viridis_r", vmax=MAX_DEPTH_M)
    figure.colorbar(shown, ax=axes[1], label="depth (m)", fraction=0.035)
    for each in axes:
        each.axis("off")
    return figure


def _fused(dataset: Dataset) -> Figure:
    frame = _first(dataset)
    rgb, depth = frame.rgb(), frame.depth_m()
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.1))
    axes[0].imshow(rgb)
    axes[1].imshow(_shown_depth(depth), cmap="viridis_r", vmax=MAX_DEPTH_M)
    axes[2].imshow(picture_of(fuse(rgb, depth).planes, MAX_DEPTH_M))
    for each in axes:
        each.axis("off")
    return figure


def _scan(dataset: Dataset) -> Figure:
    points = dataset.scan(len(dataset.survey_poses()) // 3)[:, :3]
    near = points[np.hypot(points[:, 0], points[:, 1]) < 40]
    figure = plt.figure(figsize=(11, 4))
    side = figure.add_subplot(1, 2, 1, projection="3d")
    side.scatter(near[:, 0], near[:, 1], near[:, 2], c=near[:, 2], s=0.4, cmap="viridis")
    side.set_box_aspect((1, 1, 0.2))
    side.set_zticks([0, 8])
    side.view_init(elev=28, azim=-60)
    above = figure.add_subplot(1, 2, 2)
    shown = above.scatter(near[:, 0], near[:, 1], c=near[:, 2], s=0.4, cmap="viridis")
    above.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    figure.colorbar(shown, ax=above, label="z (m)")
    return figure


def _pictures25d(data: PaperData) -> Figure:
    total = len(data.frames)
    rows = np.array([total // 3, total // 3 + 1, total // 2, total // 2 + 1])
    figure, axes = plt.subplots(2, 4, figsize=(11, 5.6))
    for line, space in zip(axes, ("aligned", "plain"), strict=True):
        for each, picture in zip(line, LidarPictures(data.frames, space).of(rows), strict=True):  # type: ignore[arg-type]
            each.imshow(np.sqrt(picture[..., 0] / 255.0), cmap="magma")
            each.axis("off")
    return figure


def _one_space(data: PaperData) -> Figure:
    test, frames = data.tests["same_drive"], data.frames
    figure, axes = plt.subplots(2, 3, figsize=(9, 6), layout="tight")
    rows = np.linspace(0, len(test) - 1, 5).astype(np.int64)[1:4]
    for (top, low), row in zip(axes.T, rows, strict=True):
        away = np.linalg.norm(np.asarray(frames.places)[:, :2] - test.views[row, :2], axis=1)
        near = np.array([away.argmin()])
        turn = np.array([test.views[row, 2] - frames.places[near[0], 2]])
        top.imshow(LidarPictures(frames, "view").of(near, turn)[0])
        low.imshow(fused_pictures(test, np.array([row]), "view")[0])
        for each in (top, low):
            each.axis("off")
    return figure


def _city(dataset: Dataset) -> Figure:
    streets = Streets.from_geojson(dataset.streets())
    figure, axes = plt.subplots(figsize=(6.4, 8))
    names = list(dict.fromkeys(street.street for street in streets.features))
    palette = plt.get_cmap("tab10")
    for street in streets.features:
        colour = palette(names.index(street.street) % 10)
        for k, rings in enumerate(street.polygons):
            axes.fill(*rings[0].T, color=colour, alpha=0.85 if street.section != "end" else 0.5)
            if k == 0:
                x, y = rings[0].mean(axis=0)
                label = (
                    "between"
                    if street.street == "between"
                    else street.street + {"beginning": "b", "end": "e"}.get(street.section or "", "")
                )
                axes.text(
                    x,
                    y,
                    label,
                    ha="center",
                    va="center",
                    fontsize=9,
                    color=INK,
                    bbox={"facecolor": "white", "alpha": 0.8, "pad": 1.5, "lw": 0},
                )
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    return figure


#: Quantity of a training curve, by the beginning of the method's name.
WATCHED = (
    ("cnn_knn_one_space_both", "street accuracy, pairs"),
    ("cnn_", "street accuracy, LiDAR"),
    ("streetfix", "own view first of its batch"),
    ("googlenet", "median error (m)"),
    ("PointNetLK", "median error (m)"),
    ("", "recall at 1 within 5 m"),
)


def _curves(results: Mapping[str, MethodResult]) -> Figure | None:
    shown = {
        name: (r.curve, r.ended)
        for name, r in results.items()
        if len(r.curve) > 1 and name not in ("cnn_knn", *STAGES[1:]) and not name.startswith("cnn_softmax")
    }
    if STAGES[-1] in results:
        curve = [CurvePoint(**point) for point in results[STAGES[-1]].extra["pointnet_lk"]]
        shown["PointNetLK"] = (curve, results[STAGES[-1]].extra.get("pointnet_lk_ended", "budget"))
    if not shown:
        return None
    columns = 3
    lines = -(-len(shown) // columns)
    figure, grid = plt.subplots(lines, columns, figsize=(11, 2.7 * lines), squeeze=False)
    for axes, (name, (curve, ended)) in zip(grid.ravel(), shown.items(), strict=False):
        minutes, scores = [point.processor_s / 60 for point in curve], [abs(point.score) for point in curve]
        axes.plot(minutes, scores, color=OURS if name.startswith("streetfix") else THEIRS)
        axes.set_title(f"{name.removeprefix('cnn_knn_')} ({ended})", fontsize=9)
        axes.set_xlabel("processor minutes", fontsize=8)
        axes.set_ylabel(next(what for begin, what in WATCHED if name.startswith(begin)), fontsize=8)
        axes.set_ylim(bottom=0)
        clean(axes)
    for axes in grid.ravel()[len(shown) :]:
        axes.axis("off")
    figure.tight_layout()
    return figure


def _errors(data: PaperData, results: Mapping[str, MethodResult]) -> Figure:
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.2), sharey=True)
    for each, split in zip(axes, ("same_drive", "other_drive"), strict=True):
        for k, name in enumerate(
            n for n in TITLES if n in results and n not in ("cnn_softmax", "googlenet", "googlenet_pointnetlk")
        ):
            errors = np.sort(errors_of(results[name].answers[split], data.tests[split]))
            share = (np.arange(len(errors)) + 1) / len(errors)
            each.plot(
                np.maximum(errors, 0.01),
                share,
                color=COLOURS[k % len(COLOURS)],
                label=name,
                lw=2.2 if name == "streetfix" else 1.3,
            )
        each.set(xscale="log", xlabel="error (m)", title=DRIVES[split], ylim=(0, 1.01))
        clean(each)
    axes[0].set_ylabel("share of queries within")
    figure.legend(
        *axes[0].get_legend_handles_labels(), fontsize=8, loc="lower center", ncols=5, bbox_to_anchor=(0.5, -0.16)
    )
    return figure


def _by_k(results: Mapping[str, MethodResult]) -> Figure | None:
    known = {name: r for name, r in results.items() if name.startswith("cnn_knn_")}
    if not known:
        return None
    sets: Mapping[str, str] = {
        "lidar.same_drive": "LiDAR, same drive",
        "lidar.other_drive": "LiDAR, other drive",
        "other_drive": "RGB-D, other drive",
    }
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.4), sharey=True)
    for each, (key, title) in zip(axes, sets.items(), strict=True):
        for k, (name, result) in enumerate(known.items()):
            told = result.extra["asked"][key]
            each.plot(
                KS,
                [told["knn"][str(n)][0] for n in KS],
                "o-",
                ms=3,
                color=COLOURS[k],
                label=name.removeprefix("cnn_knn_"),
            )
            each.axhline(told["softmax"][0], color=COLOURS[k], ls="--", lw=0.9)
        each.set(title=title, xlabel="k", ylim=(0, 1.02))
        clean(each)
    axes[0].set_ylabel("street accuracy")
    axes[-1].legend(fontsize=7, loc="center right", bbox_to_anchor=(1.0, 0.33))
    return figure
