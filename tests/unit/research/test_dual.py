import json
from typing import Any

import numpy as np
import pytest
import torch

from research.baselines import dual
from research.baselines.dual.encode import encoded_pictures, encoded_places
from research.baselines.dual.learn import (
    LearnSettings,
    Lesson,
    learn,
    size_of,
    step,
    towers_of,
    views_of,
    watch_score,
)
from research.baselines.dual.lidar_views import CameraField, WholePanorama, fan
from research.baselines.dual.pairing import frames_near, watched
from research.baselines.dual.pictures import FIELD, WHOLE, Sweeps, pictures_of
from research.baselines.dual.towers import Tower
from service.errors import DatasetError
from service.imaging.view_grid import ViewGrid, view_from_panorama

GRID = ViewGrid()
KINDS = ("dual", "fov")
TINY: dict[str, Any] = {"pairs": 4, "widths": (4, 4, 4), "descriptor": 8, "points": 2}


@pytest.fixture(autouse=True)
def one_thread():
    """Small networks are slower on several threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def sweeps_of(frames):
    return Sweeps.of(frames, np.arange(len(frames)))


@pytest.fixture
def lesson_of(street_frames, street_pairs):
    def made(kind, settings, places=12):
        pictures = pictures_of(pairs := street_pairs(list(range(places)), [0.0] * places), size_of(kind))
        views = views_of(kind, pictures.camera, GRID)
        return Lesson.of(pictures, pairs.views, sweeps_of(street_frames(places)), views, settings)

    return made


# pictures


def test_a_whole_picture_keeps_the_field_and_a_cut_one_sees_what_a_lidar_does(street_pairs):
    pairs = street_pairs([0], [0.0])
    for size, half_deg in ((WHOLE, 36.9), (FIELD, 15.0)):
        pictures = pictures_of(pairs, size)
        camera = pictures.camera
        assert pictures.rgb.shape == (1, *size, 3)
        assert np.rad2deg(np.arctan((camera.height / 2) / camera.fy)) == pytest.approx(half_deg, abs=0.3)
        assert np.rad2deg(np.arctan((camera.width / 2) / camera.fx)) == pytest.approx(45.0, abs=0.1)


def test_planes_are_colour_and_log_depth_where_something_was_measured_near_enough(street_pairs):
    pairs = street_pairs([0], [0.0])
    pairs.rgb[:], pairs.depth_mm[:] = 255, 20_000
    pairs.depth_mm[:, :112], pairs.depth_mm[:, 112:120] = 0, 50_000
    planes = pictures_of(pairs, WHOLE).planes(np.array([0]))[0]
    np.testing.assert_allclose(planes[:3], (1 - 0.45) / 0.25, atol=1e-6)
    np.testing.assert_array_equal(planes[3:, :59], 0)
    np.testing.assert_allclose(planes[3, 61:], np.log(2), atol=1e-3)
    np.testing.assert_array_equal(planes[4, 61:], 1)


def test_light_is_changed_in_training_and_depth_is_not(street_pairs):
    pictures = pictures_of(street_pairs([0, 1], [0.0, 0.0]), WHOLE)
    rows = np.arange(2)
    plain, changed = pictures.planes(rows), pictures.planes(rows, np.random.default_rng(0))
    assert not torch.allclose(plain[:, :3], changed[:, :3], atol=0.05)
    assert torch.equal(plain[:, 3:], changed[:, 3:])


# what of a panorama is shown


def test_a_whole_panorama_is_the_same_for_every_heading(street_frames):
    sweeps, views = sweeps_of(street_frames(2)), WholePanorama(GRID)
    one, other = (views.planes(sweeps, np.array([1]), np.array([heading])) for heading in (0.0, 2.0))
    assert one.shape == (1, 3, 32, 512)
    assert torch.equal(one, other)


@pytest.mark.parametrize("heading_deg", [0.0, 45.0, 170.0, -100.0])
def test_a_camera_field_measures_what_a_view_along_the_heading_does(street_frames, street_pairs, heading_deg):
    frames, heading = street_frames(3), np.deg2rad(heading_deg)
    camera = pictures_of(street_pairs([0], [0.0]), FIELD).camera
    planes = CameraField(camera, GRID).planes(sweeps_of(frames), np.array([2]), np.array([heading]))[0]
    panorama = np.stack([frames.panoramas[2], frames.intensities[2]]).astype(np.float32)
    view = view_from_panorama(panorama, heading, GRID)[0]
    rays = camera.rays_of_pixels()
    row = np.rint((15 - np.rad2deg(np.arctan2(-rays[..., 1], np.hypot(rays[..., 0], 1)))) / 30 * 31).astype(int)
    column = np.rint((45 - np.rad2deg(np.arctan(-rays[..., 0]))) / 90 * 128 - 0.5).astype(int)
    z = view[row.clip(0, 31), column.clip(0, 127)] / np.linalg.norm(rays, axis=-1)
    same = np.isclose(np.exp(planes[0].numpy()) * 10 * planes[1].numpy(), z, rtol=0.02, atol=0.01)
    assert same.mean() > 0.9  # cells beside an edge may fall to either side


def test_a_camera_and_the_lidar_s_view_along_its_heading_measure_the_same_walls(street_frames, street_pairs):
    frames, pairs = street_frames(5), street_pairs([4], [30.0])
    pictures = pictures_of(pairs, FIELD)
    view = CameraField(pictures.camera, GRID).planes(sweeps_of(frames), np.array([4]), np.deg2rad([30.0]))[0]
    camera = pictures.planes(np.array([0]))[0, 3:]
    level = slice(15, 17)  # walls, for either sensor's height
    same = torch.isclose(view[0, level], camera[0, level], atol=0.05)
    assert same.float().mean() > 0.9


def test_a_fan_goes_all_round_in_equal_steps(street_pairs):
    headings = fan(CameraField(pictures_of(street_pairs([0], [0.0]), FIELD).camera, GRID))
    assert len(headings) == 24
    np.testing.assert_allclose(np.diff(np.r_[headings, 2 * np.pi]), np.deg2rad(15.0))


# towers


@pytest.mark.parametrize("kind", KINDS)
def test_both_towers_end_in_unit_descriptors_of_one_size(kind, lesson_of):
    settings = LearnSettings(kind)
    lesson = lesson_of(kind, settings, places=3)
    towers = towers_of(settings, lesson.views)
    pictures = encoded_pictures(towers, lesson.pictures, np.arange(3))
    places = encoded_places(towers, lesson.views, lesson.sweeps, np.array([1, 2]))
    assert pictures.shape == (3, 256)
    assert places.shape == (2 * lesson.views.headings, 256)
    for found in (pictures, places):
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)


@pytest.mark.parametrize(("around", "follows"), [(True, True), (False, False)])
def test_cells_of_a_closed_panorama_turn_with_it(around, follows):
    torch.manual_seed(0)
    tower = Tower(3, (32, 64), widths=(4, 6, 8), patch_pair=True, descriptor=8, around=around).eval()
    planes = torch.randn(2, 3, 32, 64)
    cells, turned = tower.cells(planes), tower.cells(planes.roll(16, dims=3))  # one cell is 16 columns wide
    assert torch.allclose(turned, cells.roll(1, dims=3), atol=1e-5) == follows
    assert not torch.allclose(tower(planes), tower(planes.roll(16, dims=3)), atol=1e-3)


# learning


def test_pictures_are_paired_with_the_frames_within_reach():
    near = frames_near(np.array([[0.0, 0], [50, 0]]), np.array([[0.0, 1.9], [0, 2.1], [-1, 0]]))
    assert [rows.tolist() for rows in near] == [[0, 2], []]


def test_pieces_of_the_street_are_kept_back_whole():
    xy = np.column_stack([np.arange(2000) * 0.5, np.zeros(2000)])
    held = watched(xy, np.random.default_rng(0))
    assert 0.05 <= held.mean() < 0.08
    edges = np.flatnonzero(np.diff(np.r_[0, held.astype(int), 0]))
    lengths = np.diff(edges)[::2]
    assert lengths.min() > 16 or held[[0, -1]].any()


def test_pairs_of_another_city_are_refused(street_frames, street_pairs):
    pairs = street_pairs([50], [0.0])
    pictures = pictures_of(pairs, WHOLE)
    with pytest.raises(DatasetError, match="near a LiDAR frame"):
        Lesson.of(pictures, pairs.views, sweeps_of(street_frames(2)), WholePanorama(GRID), LearnSettings("dual"))


def test_a_batch_holds_each_picture_with_a_frame_near_it(lesson_of):
    settings = LearnSettings("fov", **TINY)
    lesson = lesson_of("fov", settings, places=40)
    planes, xy, views, views_xy = next(lesson.batches(settings, np.random.default_rng(0)))
    assert planes.shape == (4, 5, *FIELD)
    assert views.shape == (4, 3, *FIELD)
    assert torch.linalg.norm(xy - views_xy, dim=1).max() <= 2.0


@pytest.mark.parametrize("kind", KINDS)
def test_a_few_places_are_learnt_by_heart(kind, lesson_of):
    torch.manual_seed(0)
    settings = LearnSettings(kind, pairs=8, widths=(4, 8, 8), descriptor=16)
    lesson = lesson_of(kind, settings, places=9)
    towers = towers_of(settings, lesson.views)
    optimiser = torch.optim.AdamW(towers.parameters(), lr=3e-3)
    batch = next(lesson.batches(settings, np.random.default_rng(0)))
    losses = [step(towers.train(), optimiser, batch, settings) for _ in range(20)]
    assert losses[-1] < 0.3 * losses[0]


def test_a_watched_picture_counts_where_its_best_place_is_near(lesson_of, monkeypatch):
    settings = LearnSettings("dual", **TINY)
    lesson = lesson_of("dual", settings)
    rows = lesson.watch_places
    own = np.eye(len(rows), dtype=np.float32)
    monkeypatch.setattr("research.baselines.dual.learn.encoded_places", lambda *_: own)
    for shift, expected in ((0, 1.0), (1, 1.0), (3, 0.0)):  # places lie 3 m apart
        asked = own[(lesson.kept_back + shift) % len(rows)]
        monkeypatch.setattr("research.baselines.dual.learn.encoded_pictures", lambda *_, asked=asked: asked)
        assert watch_score(towers_of(settings, lesson.views), lesson) == expected


@pytest.mark.parametrize("kind", KINDS)
def test_a_stopped_training_goes_on_and_answers(kind, street_frames, street_pairs, tmp_path):
    frames, pairs = street_frames(20), street_pairs(list(range(20)), [0.0] * 20)
    tests = {"a": street_pairs([3, 7], [0.0, 0.0]), "b": street_pairs([5], [0.0])}
    settings = LearnSettings(kind, **TINY)

    def run(budget_s):
        return dual.run(frames, pairs, tests, tmp_path, kind=kind, budget_s=budget_s, settings=settings)

    first = run(0.3)
    more = run(first.processor_s + 0.3)
    again = run(first.processor_s)
    assert more.images > first.images > 0
    assert more.processor_s > first.processor_s
    assert again.images == more.images  # nothing is left to spend
    assert {name: found.xy.shape for name, found in again.answers.items()} == {"a": (2, 2), "b": (1, 2)}
    np.testing.assert_array_equal(again.answers["a"].xy, more.answers["a"].xy)
    assert len([json.loads(line) for line in more.curve.read_text().splitlines()]) >= 2


def test_progress_since_the_last_checkpoint_is_saved_at_the_end(lesson_of, tmp_path, monkeypatch):
    due = {0: 0.0}  # the first at once, no other before the end
    monkeypatch.setattr("research.baselines.dual.learn._next_point", lambda run, *_: due.get(len(run.curve), 2.0))
    settings = LearnSettings("dual", **TINY)
    training = learn(lesson_of("dual", settings), settings, tmp_path, budget_s=1.0, report=lambda *_: None)
    assert len(training.curve) == 2
    assert training.curve[1].images > training.curve[0].images


def test_a_folder_of_other_settings_is_refused(lesson_of, tmp_path):
    settings = LearnSettings("dual", **TINY)
    lesson = lesson_of("dual", settings, places=40)
    learn(lesson, settings, tmp_path, budget_s=0.1, report=lambda *_: None)
    with pytest.raises(DatasetError, match="other settings"):
        learn(lesson, LearnSettings("dual"), tmp_path, budget_s=0.1, report=lambda *_: None)
