from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `training`")

from benchmarks.choices.__main__ import _nearest_to_fixed, _vote
from benchmarks.choices.registration import POINTS
from benchmarks.choices.trainings import VARIATIONS
from benchmarks.choices.validation_city import Seen, validation_plan
from model_training.training.loop import TrainingConfig
from model_training.training.recipe import VALIDATION_SEEDS
from service.scoring import measured


def test_a_place_is_as_like_a_query_as_its_best_view_at_the_best_turn():
    views = np.zeros((3, 2, 4), np.float32)
    views[0, 0, 0], views[1, 1, 1], views[2, 0, 2] = 1.0, 1.0, 1.0
    turns = np.array([[[0.6, 0.8, 0.0, 0.0], [0.0, 0.0, 0.9, 0.1]]], np.float32)
    seen = Seen(views, {"drive": turns})
    np.testing.assert_allclose(seen.similarity("drive"), [[0.6, 0.8, 0.9]])
    first_only = np.tile([True, False], (3, 1))
    np.testing.assert_allclose(seen.similarity("drive", first_only), [[0.6, 0.0, 0.9]])


def test_the_fixed_fan_takes_the_view_that_points_there():
    headings = np.deg2rad([[10.0, 100.0, 190.0, 280.0, 55.0], [-170.0, -80.0, 5.0, 95.0, 179.0]])
    found = _nearest_to_fixed(headings, 4)
    np.testing.assert_array_equal(found, [[1, 1, 1, 1, 0], [0, 1, 1, 1, 1]])


@pytest.mark.parametrize(
    ("streets", "similarity", "street"),
    [
        ([3, 1, 1], [0.90, 0.89, 0.89], 1),
        ([3, 1, 1], [0.90, 0.70, 0.70], 3),  # far less alike, they hardly count
        ([-1, -1, 2], [0.9, 0.9, 0.9], -1),  # in no street
    ],
)
def test_neighbours_vote_with_the_weight_of_their_likeness(streets, similarity, street):
    assert _vote(np.array(streets), np.array(similarity, np.float32)) == street


def test_variations_differ_from_the_reference_in_one_thing_and_are_configurations():
    reference = TrainingConfig(memory_after=None)
    for name, variation in VARIATIONS.items():
        config = TrainingConfig.model_validate({"memory_after": None} | variation.changed)
        assert (config, variation.cities) != (reference, VARIATIONS["reference"].cities) or name == "reference"
        assert set(variation.blind) <= {"range_m", "v1", "v2", "height_m", "observed", "brightness"}


def test_choices_are_measured_in_a_validation_city():
    assert validation_plan().seed in VALIDATION_SEEDS


def test_each_ablation_of_registration_replaces_a_function_that_it_calls():
    assert callable(getattr(measured, POINTS))
    assert f"points = {POINTS}(" in Path(measured.__file__).read_text()
