import numpy as np
import pytest

from model_training.calibration.collect import asked_of, preset_of
from model_training.evaluation.predict import RANKED, Predictions
from service.maps.calibration import FEATURES


def predictions(errors_m, *, up_m=0.0):
    """Queries that were answered so far to the side; NaN for no answer."""
    count = len(errors_m)
    T_true = np.tile(np.eye(4), (count, 1, 1))
    T_answer = T_true.copy()
    T_answer[:, 0, 3], T_answer[:, 2, 3] = 0.6 * np.array(errors_m), up_m
    T_answer[:, 1, 3] = 0.8 * np.array(errors_m)
    return Predictions(
        T_true, T_answer, np.zeros(count, int), np.zeros(count, int), np.zeros((count, RANKED, 2)), np.zeros((count, RANKED), int),
        np.ones(count, bool), np.full(count, 0.5), np.arange(count * len(FEATURES), dtype=float).reshape(count, -1),
        np.zeros((count, 6, 6)), np.zeros(count), np.zeros(count),
    )  # fmt: skip


def test_an_answer_within_a_metre_on_the_ground_is_right():
    found = asked_of(predictions([0.0, 0.99, 1.01, 50.0, np.nan], up_m=3.0), "clear_precise", known=True)
    assert found.right.tolist() == [True, True, False, False, False]
    assert found.known.all()
    assert set(found.kind.tolist()) == {"clear_precise"}
    np.testing.assert_array_equal(found.evidence, predictions([0.0] * 5).evidence)


def test_outside_the_map_no_answer_is_right():
    found = asked_of(predictions([0.0, 50.0]), "other_city.precise", known=False)
    assert not found.right.any()
    assert not found.known.any()


@pytest.mark.parametrize(
    ("name", "preset"), [("clear_precise", "precise"), ("cars_changed_stereo", "stereo"), ("x", "x")]
)
def test_the_preset_is_the_last_part_of_a_sets_name(name, preset):
    assert preset_of(name) == preset
