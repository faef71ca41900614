"""Modes of an evaluation: several images in one query, a prior, a moving robot."""

import shutil
from typing import Any

import numpy as np
import pytest

from model_training.datasets.dataset import Dataset, write_tum
from model_training.evaluation import query_mode
from model_training.evaluation.priors import prior_with_std
from model_training.evaluation.query_mode import MOST_FRAMES, QueryMode, predict_in_mode
from model_training.evaluation.tracks import answers_on
from service.contract import schema
from service.errors import DatasetError, NoDepthError
from service.geometry.rigid import inverse, transform_from
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle

NAME = "drive1_precise"


class Listening:
    """A localizer that keeps the queries and answers none."""

    def __init__(self, bundle: MapBundle) -> None:
        self.bundle = bundle
        self.queries = list[Any]()
        self.poses = list[Any]()

    def localize_frames(self, queries: Any, poses: Any) -> None:
        self.queries.append(queries)
        self.poses.append(poses)
        raise NoDepthError("nothing")


@pytest.fixture
def listening(small_map) -> Any:
    return Listening(MapBundle.open(small_map))


@pytest.fixture
def own(small_dataset, tmp_path):
    return Dataset(shutil.copytree(small_dataset.folder, tmp_path / "own"))


def truth_of(dataset):
    return np.array([frame.T_map_camera for frame in dataset.queries(NAME)])


def write_odometry(dataset, count=5):
    """Write an odometry of steps of 2 m ahead, from its own origin."""
    poses = np.array([transform_from(np.eye(3), np.array([7.0, 0.0, 2.0 * k])) for k in range(count)])
    write_tum(dataset.folder / "queries" / NAME / "odometry.txt", np.arange(float(count)), poses)


def test_single_images_have_neither_odometry_nor_prior(listening, small_dataset):
    found, source = predict_in_mode(listening, small_dataset, NAME, QueryMode(), workers=1)
    assert source is None
    assert [len(queries) for queries in listening.queries] == [1] * 5
    assert [queries[0].prior for queries in listening.queries] == [None] * 5
    np.testing.assert_array_equal(found.T_true, truth_of(small_dataset))


def test_each_image_with_enough_before_it_is_the_end_of_a_query(listening, small_dataset):
    told = []
    found, source = predict_in_mode(
        listening,
        small_dataset,
        NAME,
        QueryMode(frames=3),
        workers=1,
        report=lambda *event: told.append(event),
    )
    truth = truth_of(small_dataset)
    assert source == "ground truth, with simulated errors"
    np.testing.assert_array_equal(found.T_true, truth[2:])
    assert told == [(f"queries {NAME}", k, 3) for k in (1, 2, 3)]
    for last, poses in zip((2, 3, 4), listening.poses, strict=True):
        for back, T in enumerate(poses):
            step = inverse(truth[last]) @ truth[last - back]
            np.testing.assert_allclose(T[:3, 3], step[:3, 3], atol=1e-9 + 0.1 * float(np.linalg.norm(step[:3, 3])))


def test_recorded_odometry_gives_the_relative_poses(listening, own):
    write_odometry(own)
    _, source = predict_in_mode(listening, own, NAME, QueryMode(frames=3), workers=1)
    assert source == "odometry.txt"
    for poses in listening.poses:
        np.testing.assert_allclose([T[:3, 3] for T in poses], [[0, 0, 0], [0, 0, -2], [0, 0, -4]], atol=1e-6)


def test_the_error_of_a_prior_has_the_stated_standard_deviation(listening, small_dataset):
    predict_in_mode(listening, small_dataset, NAME, QueryMode(prior_std_m=3.0), workers=1)
    priors = [queries[0].prior for queries in listening.queries]
    assert [prior.position_std_m for prior in priors] == [3.0] * 5
    prior_of = prior_with_std(3.0)
    apart = np.array([prior_of(np.eye(4), np.random.default_rng(seed)).position_m for seed in range(2000)], np.float64)
    np.testing.assert_allclose(np.std(apart, axis=0), 3.0, rtol=0.06)


@pytest.mark.parametrize("mode", [QueryMode(frames=3), QueryMode(track=True)])
def test_an_odometry_without_a_line_for_each_image_is_refused(listening, own, mode):
    write_odometry(own, count=4)
    with pytest.raises(DatasetError, match=r"odometry\.txt has 4 lines, none for 000004\.\w+; write a line per image"):
        predict_in_mode(listening, own, NAME, mode)


def test_more_images_in_a_query_than_the_set_has_are_refused(listening, small_dataset):
    with pytest.raises(DatasetError, match=f"--frames 6: query set '{NAME}' .* has 5 images; give at most this number"):
        predict_in_mode(listening, small_dataset, NAME, QueryMode(frames=6))


def test_a_track_answers_every_image_from_its_odometry(small_map, own, monkeypatch):
    """The first image alone has a prior."""
    write_odometry(own)
    steps = []

    def watched(localizer, drive, **options):
        steps.extend(drive)
        return answers_on(localizer, drive, **options)

    monkeypatch.setattr(query_mode, "answers_on", watched)
    told = []
    localizer = Localizer.open(MapBundle.open(small_map))
    found, source = predict_in_mode(
        localizer, own, NAME, QueryMode(track=True, prior_std_m=2.0), report=lambda *event: told.append(event)
    )
    assert source == "odometry.txt"
    assert told == [(f"queries {NAME}", k, 5) for k in range(1, 6)]
    np.testing.assert_array_equal(found.T_true, truth_of(own))
    assert np.isfinite(found.T_answer).all()
    assert steps[0].T_previous_camera is None
    np.testing.assert_allclose([step.T_previous_camera[:3, 3] for step in steps[1:]], [[0, 0, 2]] * 4, atol=1e-6)


@pytest.mark.parametrize(
    ("mode", "text"),
    [
        (QueryMode(), "single images"),
        (QueryMode(frames=5), "5 consecutive images in one query"),
        (QueryMode(frames=5, prior_std_m=3), "5 consecutive images in one query, prior of 3 m"),
        (QueryMode(track=True), "the images as one moving robot (track)"),
        (
            QueryMode(track=True, prior_std_m=3),
            "the images as one moving robot (track), prior of 3 m for the first image",
        ),
    ],
)
def test_a_mode_is_described(mode, text):
    assert mode.described() == text


def test_a_query_has_as_many_images_as_the_contract_allows():
    assert MOST_FRAMES == schema.MOST_FRAMES
