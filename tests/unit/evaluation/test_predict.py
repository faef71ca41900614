import shutil
from typing import Any

import cv2
import numpy as np
import pytest

from model_training.datasets.dataset import Dataset
from model_training.evaluation.predict import RANKED, predict
from service.confidence.features import FEATURES
from service.errors import DatasetError
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.retrieval.prior import Prior
from service.retrieval.query import Query

NAME = "drive1_precise"


@pytest.fixture(scope="module")
def localizer(small_map):
    return Localizer.open(MapBundle.open(small_map))


@pytest.fixture
def own_dataset(small_dataset, tmp_path):
    return Dataset(shutil.copytree(small_dataset.folder, tmp_path / "own"))


def test_every_query_gets_the_answer_that_the_localizer_gives(localizer, small_dataset):
    found = predict(localizer, small_dataset, NAME)
    for k, frame in enumerate(small_dataset.queries(NAME)):
        answer = localizer.localize(
            Query(rgb=frame.rgb(), depth_m=frame.depth_m(), camera=frame.camera.pinhole(), ranked=RANKED)
        )
        np.testing.assert_allclose(found.T_answer[k], answer.T_map_camera_guess)
        np.testing.assert_allclose(found.ranked_xy[k, 0], answer.neighbours[0].position_m[:2])
        assert found.street_answer[k] == answer.street
        np.testing.assert_allclose(found.evidence[k], answer.evidence)
        np.testing.assert_allclose(found.covariance[k], answer.covariance)
    assert np.isfinite(found.evidence).all()
    assert np.isnan(found.confidence).all()  # the map is not calibrated


def test_retrieval_alone_has_neither_evidence_nor_covariance(localizer, small_dataset):
    found = predict(localizer, small_dataset, NAME, refine=False)
    assert np.isfinite(found.T_answer).all()
    for nothing in (found.confidence, found.evidence, found.covariance):
        assert np.isnan(nothing).all()
    assert found.evidence.shape == (5, len(FEATURES))
    assert found.covariance.shape == (5, 6, 6)


def test_truth_is_the_datasets(localizer, small_dataset):
    found = predict(localizer, small_dataset, NAME, workers=1)
    np.testing.assert_array_equal(found.T_true, [frame.T_map_camera for frame in small_dataset.queries(NAME)])
    assert set(found.street_true.tolist()) <= {-1, 0, 1}


def test_ranked_places_are_distinct(localizer, small_dataset):
    for places in predict(localizer, small_dataset, NAME).ranked_place:
        there = places[places >= 0]
        assert len(set(there.tolist())) == len(there) > 1


def test_the_number_of_workers_does_not_change_an_answer(localizer, small_dataset):
    one, three = (predict(localizer, small_dataset, NAME, workers=workers) for workers in (1, 3))
    np.testing.assert_array_equal(one.T_answer, three.T_answer)
    np.testing.assert_array_equal(one.ranked_place, three.ranked_place)


def test_a_query_without_depth_is_unanswered(localizer, own_dataset):
    path = own_dataset.folder / "queries" / NAME / "depth" / "000002.png"
    path.write_bytes(cv2.imencode(".png", np.zeros((72, 96), np.uint16))[1].tobytes())
    found = predict(localizer, own_dataset, NAME)
    assert found.localized.tolist() == [True, True, False, True, True]
    assert np.isnan(found.T_answer[2]).all()
    assert found.street_answer[2] == -1


def test_a_set_without_truth_is_refused(localizer, own_dataset):
    (own_dataset.folder / "queries" / NAME / "poses.txt").unlink()
    with pytest.raises(DatasetError, match=r"poses\.txt"):
        predict(localizer, own_dataset, NAME)


def test_progress_is_reported_for_every_query(localizer, small_dataset):
    told = []
    predict(localizer, small_dataset, NAME, report=lambda *event: told.append(event))
    assert told == [(f"queries {NAME}", k, 5) for k in range(1, 6)]


def test_each_query_has_a_random_prior_around_its_ground_truth(localizer, small_dataset):
    told = []

    def prior_of(T_map_camera, rng):
        told.append((T_map_camera[:2, 3].copy(), rng.normal()))
        return Prior(position_m=T_map_camera[:2, 3])

    asked = []

    class Listening:
        bundle = localizer.bundle

        def localize_frames(self, queries, poses):
            asked.append(queries[0].prior.position_m)
            return localizer.localize_frames(queries, poses)

    listening: Any = Listening()
    found = predict(listening, small_dataset, NAME, refine=False, workers=1, prior_of=prior_of)
    np.testing.assert_allclose(asked, found.T_true[:, :2, 3])
    np.testing.assert_allclose([xy for xy, _ in told], found.T_true[:, :2, 3])
    assert len({chance for _, chance in told}) == len(told)
    again = list(told)
    told.clear()
    predict(listening, small_dataset, NAME, refine=False, workers=2, prior_of=prior_of)
    assert sorted(chance for _, chance in told) == sorted(chance for _, chance in again)


def test_some_of_the_answers(localizer, small_dataset):
    found = predict(localizer, small_dataset, NAME, refine=False)
    rows = np.array([True, False, True, False, False])
    some = found.of(rows)
    np.testing.assert_array_equal(some.T_answer, found.T_answer[[0, 2]])
    np.testing.assert_array_equal(some.status, found.status[[0, 2]])
