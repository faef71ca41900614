import json

import numpy as np
import pytest

from model_training.evaluation.measures import measure, recall_at
from model_training.evaluation.predict import RANKED, Predictions, headings_of, joined
from service.confidence.features import FEATURES
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from

STREETS = ["Street 1", "Street 2"]


def pose(x, y, heading_deg=0.0):
    return transform_from(rotation_z(np.deg2rad(heading_deg)) @ R_BODY_OPTICAL, np.array([x, y, 1.5]))


def make_predictions(errors_m, *, answered=None, street_answer=None, street_true=None, turns_deg=None):
    """Return predictions for queries 100 m apart along x, with lateral errors ``errors_m``. NaN means no answer."""
    count = len(errors_m)
    T_true = np.stack([pose(100.0 * k, 0.0) for k in range(count)])
    turns = np.zeros(count) if turns_deg is None else turns_deg
    T_answer = np.stack([pose(100.0 * k, e, t) for k, (e, t) in enumerate(zip(errors_m, turns, strict=True))])
    nothing = np.isnan(errors_m)
    T_answer[nothing] = np.nan
    ranked = np.full((count, RANKED, 2), np.nan)
    ranked[:, 0] = T_answer[:, :2, 3]
    return Predictions(
        T_true,
        T_answer,
        np.zeros(count, int) if street_true is None else np.array(street_true),
        np.zeros(count, int) if street_answer is None else np.array(street_answer),
        ranked,
        np.full((count, RANKED), -1),
        np.where(~nothing if answered is None else np.array(answered), "LOCALIZED", ""),
        np.full(count, np.nan),
        np.full((count, len(FEATURES)), np.nan),
        np.full((count, 6, 6), np.nan),
        np.full(count, 20.0),
        np.arange(float(count)),
    )


def test_shares_within_distances_count_all_queries():
    found = measure(make_predictions([0.2, 0.8, 3.0, 20.0]), STREETS)
    assert [found[f"within_{name}_m"] for name in ("0_5", "1", "5")] == [0.25, 0.5, 0.75]


def test_an_unanswered_query_is_wrong_in_every_share():
    found = measure(make_predictions([0.2, np.nan], street_answer=[0, -1]), STREETS)
    names = ("street_accuracy", "within_0_5_m", "within_1_m", "within_5_m", "recall_at_1_5m", "localized")
    assert {found[name] for name in names} == {0.5}


def test_distances_are_over_answered_queries():
    found = measure(make_predictions([1.0, 3.0, np.nan]), STREETS)
    assert (found["mean_distance_error_m"], found["mse_m2"]) == pytest.approx((2.0, 5.0))
    assert found["rms_distance_error_m"] == pytest.approx(np.sqrt(5.0))


def test_forced_distances_are_over_every_query_with_a_hypothesis():
    found = measure(make_predictions([1.0, 9.0, np.nan], answered=[True, False, False]), STREETS)
    assert found["mean_distance_error_m"] == pytest.approx(1.0)
    assert found["forced"]["mean_distance_error_m"] == pytest.approx(5.0)
    assert found["forced"]["answered"] == pytest.approx(2 / 3)


def test_a_right_street_that_is_not_localized_does_not_count():
    found = measure(make_predictions([1.0, 1.0], answered=[True, False]), STREETS)
    assert found["street_accuracy"] == 0.5


def test_queries_outside_of_all_streets_do_not_count_for_streets():
    found = measure(make_predictions([1.0, 1.0, 1.0], street_true=[0, 1, -1], street_answer=[0, 0, 0]), STREETS)
    assert found["street_accuracy"] == 0.5
    assert found["error_rate"] == 0.5


def test_a_map_without_streets_has_no_street_accuracy():
    found = measure(make_predictions([1.0], street_true=[-1]), [])
    assert found["street_accuracy"] is found["error_rate"] is found["confusion"] is None


def test_the_confusion_has_a_column_for_no_answer():
    found = measure(
        make_predictions(
            [1.0] * 4, street_true=[0, 0, 1, 1], street_answer=[0, 1, 1, 1], answered=[True, True, True, False]
        ),
        STREETS,
    )
    assert found["confusion"] == {"classes": STREETS, "matrix": [[1, 1, 0], [0, 1, 1]]}


def test_the_median_heading_error_is_of_answered_queries():
    found = measure(make_predictions([1.0, 1.0, 1.0], turns_deg=[2.0, -4.0, 350.0]), STREETS)
    assert found["median_heading_error_deg"] == pytest.approx(4.0)


def test_the_95th_percentile_and_the_median_are_numpys():
    errors = list(np.random.default_rng(0).uniform(0, 9, 41))
    found = measure(make_predictions(errors), STREETS)
    assert found["median_distance_error_m"] == pytest.approx(np.median(errors))
    assert found["p95_distance_error_m"] == pytest.approx(np.percentile(errors, 95))


def test_without_any_answer_there_are_shares_but_no_distances():
    found = measure(make_predictions([np.nan, np.nan]), STREETS)
    assert found["localized"] == 0.0
    assert found["mean_distance_error_m"] is None
    assert found["median_heading_error_deg"] is None


def test_shares_have_intervals_around_them():
    found = measure(make_predictions([0.2] * 8 + [7.0] * 2), STREETS)
    assert found["ci95"]["within_5_m"] == pytest.approx([0.4902, 0.9433], abs=1e-4)


def test_figures_are_plain_json():
    found = measure(make_predictions([0.2, np.nan]), STREETS)
    assert json.loads(json.dumps(found, allow_nan=False)) == found


@pytest.mark.parametrize(
    ("k", "found"), [(1, [False, False]), (2, [False, False]), (3, [True, False]), (10, [True, False])]
)
def test_recall_looks_at_the_first_k_places(k, found):
    ranked = np.full((2, RANKED, 2), np.nan)
    ranked[0, :3] = [[50, 0], [9, 0], [3, 4]]  # the third is 5 m away, which is near enough
    ranked[1, 0] = [5.01, 0]
    assert recall_at(ranked, np.zeros((2, 2)), k).tolist() == found


def test_joined_sets_keep_their_order():
    both = joined([make_predictions([1.0]), make_predictions([2.0, 3.0])])
    assert len(both.ms) == 3
    np.testing.assert_allclose(both.T_answer[:, 1, 3], [1, 2, 3])


def test_predictions_survive_a_file_without_pickle(tmp_path):
    predictions = make_predictions([1.0, np.nan])
    predictions.save(tmp_path / "predictions.npz")
    with np.load(tmp_path / "predictions.npz", allow_pickle=False) as stored:
        for name in Predictions.__dataclass_fields__:
            np.testing.assert_array_equal(stored[name], getattr(predictions, name))
    again = Predictions.load(tmp_path / "predictions.npz")
    for name in Predictions.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(predictions, name))
    assert [each.name for each in tmp_path.iterdir()] == ["predictions.npz"]


def test_headings_are_of_the_optical_axis():
    np.testing.assert_allclose(headings_of(np.stack([pose(0, 0, 30), pose(0, 0, -120)])), np.deg2rad([30, -120]))
