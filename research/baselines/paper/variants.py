"""All variants of the paper's method, and their answers.

The paper trains on LiDAR images and queries with fused RGB-D images. These two kinds share no image space, and the
paper does not explain how their features could match. So we run the method as published, and in every way that it could
be meant.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from research.baselines.answers import PlaceAnswers
from research.baselines.learning import CurvePoint, Report
from research.baselines.paper.cnn import CLASSES, PaperCnn
from research.baselines.paper.knn import KS, Gallery, class_centres
from research.baselines.paper.pictures import LidarPictures, Pictures, fused_pictures
from research.baselines.paper.train import CnnPlan, CnnTrainer, Split, aside_pairs, outputs, shown_pairs
from research.baselines.paper_data.frames import Frames
from research.baselines.paper_data.pairs import Pairs

#: Plans by name. The first follows the paper to the letter.
PLANS = {
    "as_printed": CnnPlan("aligned", as_paper=True),
    "converged": CnnPlan("aligned"),
    "without_pca": CnnPlan("plain"),
    "one_space": CnnPlan("view"),
    "one_space_both": CnnPlan("view", pairs_too=True),
}
WHAT = {
    "as_printed": "LiDAR images from above, aligned by PCA, 84 iterations; queries are fused images in the camera's perspective",
    "converged": "as `as_printed`, but trained until the validation accuracy stops rising",
    "without_pca": "as `converged`, but without PCA",
    "one_space": "LiDAR and fused images on the view grid (azimuth x elevation); trained on LiDAR images only",
    "one_space_both": "as `one_space`, but trained on LiDAR images and fused pairs",
}


@dataclass(frozen=True, eq=False)
class VariantAnswers:
    """Answers of a variant to one set of queries.

    Attributes:
        kind: kind of the queries.
        softmax: answers by softmax.
        knn: answers by K-NN, by k.
        truth_xy: ground-truth positions (n, 2), metres, map frame.
        truth_street: ground-truth street classes (n,).
    """

    kind: str
    softmax: PlaceAnswers
    knn: Mapping[int, PlaceAnswers]
    truth_xy: NDArray[np.float64]
    truth_street: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Variant:
    """A trained variant.

    Attributes:
        name: name in ``PLANS``.
        answers_by_set: answers by set of queries.
        processor_s: processor time of the training, seconds.
        images: images shown in training.
        curve: training curve.
        ended: why the training ended.
    """

    name: str
    answers_by_set: Mapping[str, VariantAnswers]
    processor_s: float
    images: int
    curve: list[CurvePoint]
    ended: str


def run_variant(
    name: str,
    frames: Frames,
    pairs: Pairs,
    tests: Mapping[str, Pairs],
    other_lidar: Frames,
    work: Path,
    *,
    budget_s: float,
    report: Report = lambda *_: None,
) -> Variant:
    """Train one variant and answer all sets of queries.

    Args:
        name: name in ``PLANS``.
        frames: LiDAR frames of the survey traversal.
        pairs: RGB-D pairs of the training traversals.
        tests: RGB-D queries by split.
        other_lidar: LiDAR frames of the other traversal at the places of ``tests``. They separate the leak of the
            random split from the gap between the sensors.
        work: folder of the runs.
        budget_s: budget, processor seconds; the published variant takes its 84 iterations instead.
        report: receives the label and the progress per mille.
    """
    plan = PLANS[name]
    trainer = CnnTrainer(plan, frames, pairs if plan.pairs_too else None, work / name, budget_s=budget_s)
    net = trainer.run(f"CNN {name}", report)
    training = trainer.training
    cost, images, why = (
        training.processor_s,
        training.images,
        f"{trainer.iterations} iterations" if plan.as_paper else training.ended or "",
    )
    split, pictures = trainer.split, trainer.pictures
    gallery = _gallery(net, pictures, split, pairs if plan.pairs_too else None)
    centres = class_centres(frames.T_map_lidar[split.known, :2, 3], frames.street[split.known], CLASSES)
    answers_by_set: dict[str, VariantAnswers] = {}

    def ask(
        key: str,
        kind: str,
        drawn: Callable[[NDArray[np.int64]], Pictures],
        xy: NDArray[np.float64],
        street: NDArray[np.int64],
    ) -> None:
        features, scores = outputs(net, drawn, len(street))
        neighbours = gallery.neighbours(features, max(KS))
        best = scores.argmax(axis=1)
        answers_by_set[key] = VariantAnswers(
            kind, PlaceAnswers(centres[best], best), {k: gallery.answers(neighbours[:, :k]) for k in KS}, xy, street
        )

    def lidar(key: str, of: Frames, rows: NDArray[np.int64]) -> None:
        drawn = LidarPictures(of, plan.space)
        ask(key, "LiDAR", lambda chosen: drawn.of(rows[chosen]), of.T_map_lidar[rows, :2, 3], of.street[rows])

    def rgbd(key: str, of: Pairs, rows: NDArray[np.int64], *, colour: bool = True) -> None:
        ask(
            key,
            "RGB-D" if colour else "depth",
            lambda chosen: fused_pictures(of, rows[chosen], plan.space, colour=colour),
            of.T_map_camera[rows, :2, 3],
            of.street[rows],
        )

    lidar("lidar.same_drive", frames, split.tested)
    lidar("lidar.other_drive", other_lidar, np.arange(len(other_lidar)))
    rgbd("aside", pairs, aside_pairs(len(pairs)))
    for which, test in tests.items():
        rgbd(which, test, np.arange(len(test)))
        rgbd(f"depth.{which}", test, np.arange(len(test)), colour=False)
    return Variant(name, answers_by_set, cost, images, training.curve, why)


def _gallery(net: PaperCnn, pictures: LidarPictures, split: Split, pairs: Pairs | None) -> Gallery:
    """Compute the features of the paper's 70 %, views in both directions of the street, and of the training pairs."""
    frames, rows = pictures.frames, split.known
    headings = (0.0, np.pi) if pictures.space == "view" else (0.0,)
    features, xy, street = [], [], []
    for heading in headings:

        def drawn(chosen: NDArray[np.int64], turn: float = heading) -> Pictures:
            return pictures.of(rows[chosen], np.full(len(chosen), turn))

        found, _ = outputs(net, drawn, len(rows))
        features.append(found)
        xy.append(frames.T_map_lidar[rows, :2, 3])
        street.append(frames.street[rows])
    if pairs is not None:
        shown = shown_pairs(len(pairs))
        found, _ = outputs(net, lambda chosen: fused_pictures(pairs, shown[chosen], pictures.space), len(shown))
        features.append(found)
        xy.append(pairs.T_map_camera[shown, :2, 3])
        street.append(pairs.street[shown])
    return Gallery(np.concatenate(features), np.concatenate(xy), np.concatenate(street))


def street_accuracy(answers: PlaceAnswers, truth: VariantAnswers) -> float:
    """Return the share of queries with the correct class; an unanswered query is wrong.

    Args:
        answers: answers to the queries.
        truth: the queries' ground truth.
    """
    return float((answers.street == truth.truth_street).mean())
