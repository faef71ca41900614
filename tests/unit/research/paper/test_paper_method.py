import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from research.baselines.paper import train as training_module
from research.baselines.paper.cnn import CLASSES, FEATURES, PaperCnn, layer_table
from research.baselines.paper.knn import Gallery, class_centres
from research.baselines.paper.pictures import LidarPictures, drawn_views, fused_pictures
from research.baselines.paper.train import CnnPlan, CnnTrainer, aside_pairs, shown_pairs, split_of
from research.baselines.paper.variants import PLANS, run_variant
from research.baselines.paper_data.frames import Frames
from research.baselines.paper_data.pairs import Pairs
from service.geometry.camera import PinholeCamera
from service.imaging.view_grid import ViewGrid

GRID = ViewGrid()


def frames_of(count: int, seed: int = 0) -> Frames:
    """Return frames whose images encode their class: a bright square at a class-specific position."""
    rng = np.random.default_rng(seed)
    street = np.arange(count) % 4
    aligned = rng.integers(0, 30, (count, 224, 224)).astype(np.uint8)
    panoramas = rng.uniform(20, 39, (count, GRID.rows, GRID.around)).astype(np.float16)
    for k, each in enumerate(street):
        aligned[k, 40 * each : 40 * each + 40, 100:140] = 220
        panoramas[k, 8 * each : 8 * each + 8] = 3.0
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 0, 3], T[:, 1, 3] = 50.0 * street, np.arange(count) * 0.1
    places = np.c_[T[:, 0, 3], T[:, 1, 3], np.zeros(count), np.full(count, 1.8)]
    return Frames(aligned, aligned.copy(), panoramas, np.zeros_like(aligned[:, :1]), places, T, street)


def pairs_of(count: int) -> Pairs:
    rng = np.random.default_rng(1)
    street = np.arange(count) % 4
    ranges = rng.uniform(20, 39, (count, GRID.rows, GRID.columns)).astype(np.float16)
    for k, each in enumerate(street):
        ranges[k, 8 * each : 8 * each + 8] = 3.0
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 0, 3] = 50.0 * street
    return Pairs(
        np.full((count, 224, 224, 3), 90, np.uint8),
        np.full((count, 224, 224), 9000, np.uint16),
        ranges,
        np.full((count, GRID.rows, GRID.columns, 3), 90, np.uint8),
        np.zeros((count, 4)),
        T,
        street,
        PinholeCamera(224, 224, 112.0, 149.3, 111.5, 111.5),
    )


def test_twelve_layers_are_five_convolutions_five_poolings_and_two_full_connections() -> None:
    net = PaperCnn().eval()

    features = net.features(torch.zeros(2, 3, 224, 224))

    kinds = [type(layer) for layer in net.modules()]
    counted = [torch.nn.Conv2d, torch.nn.MaxPool2d, torch.nn.Linear]
    assert [kinds.count(kind) for kind in counted] == [5, 5, 2]
    assert features.shape == (2, FEATURES)
    assert net(torch.zeros(2, 3, 224, 224)).shape == (2, CLASSES)
    numbered = [int(number.split()[0]) for number, _, _ in layer_table() if number != "input" and number]
    assert numbered == list(range(1, 13))


def test_the_paper_s_split_is_seventy_to_thirty_and_watches_whole_stretches_of_the_seventy() -> None:
    split = split_of(46_741)

    assert len(split.tested) == 14_022
    together = np.concatenate([split.learnt, split.watched, split.tested])
    assert sorted(together) == list(range(46_741))
    neighbours = np.isin(split.watched + 1, split.learnt) | np.isin(split.watched - 1, split.learnt)
    assert neighbours.mean() < 0.05  # a watched frame has no neighbour that was learnt, but at the ends


def test_the_paper_s_batches_follow_from_its_84_iterations() -> None:
    split = split_of(46_741)
    learnt = len(split.learnt) + len(split.watched)

    assert learnt == 32_719
    assert math.ceil(learnt / training_module.ITERATIONS_AN_EPOCH) == 1559
    assert training_module.ITERATIONS_AN_EPOCH * training_module.EPOCHS == 84


def test_pairs_aside_are_never_shown() -> None:
    assert not set(shown_pairs(100)) & set(aside_pairs(100))
    assert sorted([*shown_pairs(100), *aside_pairs(100)]) == list(range(100))


@pytest.mark.parametrize("k", [1, 3])
def test_knn_answers_the_nearest_frame_of_the_class_that_wins(k: int) -> None:
    gallery = Gallery(
        np.array([[0.0], [1.0], [1.1], [9.0]], np.float32),
        np.array([[0.0, 0.0], [5.0, 0.0], [6.0, 0.0], [99.0, 0.0]]),
        np.array([7, 3, 3, 1]),
    )

    neighbours = gallery.neighbours(np.array([[0.2]], np.float32), k)
    answers = gallery.answers(neighbours)

    assert neighbours[0].tolist() == [0, 1, 2][:k]
    assert answers.street.tolist() == ([7] if k == 1 else [3])
    assert answers.xy.tolist() == ([[0.0, 0.0]] if k == 1 else [[5.0, 0.0]])


def test_a_tie_goes_to_the_nearer_class() -> None:
    gallery = Gallery(np.array([[0.0], [1.0]], np.float32), np.array([[0.0, 0.0], [5.0, 0.0]]), np.array([7, 3]))

    assert gallery.answers(np.array([[1, 0]])).street.tolist() == [3]


def test_class_centres_are_means_and_a_class_without_frames_has_none() -> None:
    xy = np.array([[0.0, 0.0], [2.0, 4.0], [9.0, 9.0]])

    centres = class_centres(xy, np.array([0, 0, 2]), 3)

    assert np.allclose(centres, [[1.0, 2.0], [np.nan, np.nan], [9.0, 9.0]], equal_nan=True)


def test_a_view_turned_by_a_half_circle_looks_back() -> None:
    frames = frames_of(1)
    panorama = np.full((GRID.rows, GRID.around), 30.0, np.float16)
    panorama[:, : GRID.around // 8] = 3.0  # azimuth -180 to -135 degrees: behind, to the right
    frames = replace(frames, panoramas=panorama[None])
    pictures = LidarPictures(frames, "view")

    ahead, back = (
        pictures.of(np.array([0]), np.array([turn]))[0].astype(int).mean(axis=(0, 2)) for turn in (0.0, np.pi)
    )

    assert np.ptp(ahead) == 0
    # Looking back, behind-right lies to the left of the picture, and near is bright.
    assert back[:100].mean() > back[124:].mean() + 50


def test_depth_alone_is_grey_and_fusion_keeps_the_colour() -> None:
    ranges = np.full((1, GRID.rows, GRID.columns), 10.0, np.float16)
    red = np.zeros((1, GRID.rows, GRID.columns, 3), np.uint8)
    red[..., 0] = 200

    grey, fused = drawn_views(ranges, None)[0], drawn_views(ranges, red)[0]

    assert (np.ptp(grey.astype(int), axis=2) == 0).all()
    assert fused[..., 0].mean() > fused[..., 1].mean() + 20


def test_unmeasured_cells_are_black_in_both_kinds() -> None:
    frames = frames_of(1)
    frames.panoramas[:] = 0

    assert not LidarPictures(frames, "view").of(np.array([0])).any()
    assert not fused_pictures(
        replace(pairs_of(1), depth_mm=np.zeros((1, 224, 224), np.uint16)), np.array([0]), "plain"
    ).any()


def test_the_cnn_learns_to_separate_the_classes_and_stops(tmp_path: Path) -> None:
    frames = frames_of(96)
    trainer = CnnTrainer(CnnPlan("aligned", batch=8), frames, None, tmp_path, budget_s=60.0, patience=10)

    net = trainer.run("test")

    assert trainer.training.ended in ("stopped gaining", "budget")
    assert trainer.training.curve[-1].loss < trainer.training.curve[0].loss
    with torch.inference_mode():
        rows = trainer.split.tested
        found = net(training_module.as_input(trainer.pictures.of(rows))).argmax(dim=1).numpy()
    assert (found == frames.street[rows]).mean() > 0.9


def test_a_run_as_the_paper_has_it_goes_on_where_it_was_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_module, "ITERATIONS_AN_EPOCH", 3)
    monkeypatch.setattr(training_module, "EPOCHS", 2)
    frames = frames_of(80)

    class StoppedError(Exception):
        pass

    def stop(_name: str, done: int, _of: int) -> None:
        if done >= 500:
            raise StoppedError

    with pytest.raises(StoppedError):
        CnnTrainer(CnnPlan("aligned", as_paper=True), frames, None, tmp_path, budget_s=1.0).run("test", stop)
    again = CnnTrainer(CnnPlan("aligned", as_paper=True), frames, None, tmp_path, budget_s=1.0)
    kept = again.training.images
    assert 0 < kept < 6 * 19

    again.run("test")

    assert again.training.images == 6 * 19  # 56 frames in batches of a third
    assert [point.images for point in again.training.curve] == sorted({point.images for point in again.training.curve})


def test_every_variant_answers_every_set(tmp_path: Path) -> None:
    frames, pairs = frames_of(96), pairs_of(40)
    tests = {"same_drive": pairs_of(6), "other_drive": pairs_of(5)}

    found = run_variant("one_space_both", frames, pairs, tests, frames_of(7, seed=5), tmp_path, budget_s=1.0)

    assert set(found.answers_by_set) == {
        "lidar.same_drive",
        "lidar.other_drive",
        "aside",
        "same_drive",
        "other_drive",
        "depth.same_drive",
        "depth.other_drive",
    }
    assert len(found.answers_by_set["other_drive"].softmax.street) == 5
    assert set(found.answers_by_set["aside"].knn) == set(range(1, 22, 2))
    assert found.processor_s > 0
    assert found.images > 0


def test_plans_differ_in_what_they_say() -> None:
    assert len(set(PLANS.values())) == len(PLANS)


def test_training_frames_exclude_neighbours_of_validation_frames(tmp_path: Path) -> None:
    trainer = CnnTrainer(
        CnnPlan("view", pairs_too=True, batch=12), frames_of(100), pairs_of(40), tmp_path, budget_s=1.0
    )

    pictures, street = trainer._drawn(12)

    assert pictures.shape == (12, 224, 224, 3)
    assert street.dtype == np.int64
    drawn: NDArray[np.int64] = street[8:]  # a third are pairs
    assert len(drawn) == 4
