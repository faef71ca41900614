"""Numbers as drawings."""

import re

import numpy as np
import pytest

from model_training.reporting.charts import error_curve, recall_curves, reliability, series_of
from model_training.reporting.pictures import FARTHEST_M, depth_bgr
from model_training.reporting.svg import Axis, Series, histogram, plot

X = Axis("x", 0.0, 10.0, ((0.0, "0"), (10.0, "10")))


def test_points_lie_where_their_axes_say():
    drawn = plot("t", "w", X, X, [Series("a", np.array([[0.0, 0.0], [10.0, 10.0], [5.0, 20.0]]))])
    assert re.search(r'points="52.0,254.0 466.0,10.0 259.0,10.0"', drawn)  # what is beyond stays on the frame


def test_a_logarithmic_axis_spaces_by_factors():
    axis = Axis("m", 0.01, 100.0, (), log=True)
    np.testing.assert_allclose(axis.share(np.array([0.01, 0.1, 1.0, 100.0])), [0, 0.25, 0.5, 1])


def test_an_empty_histogram_is_drawn():
    assert "<rect" not in histogram("t", "w", X, np.array([0.0, 5.0, 10.0]), np.array([0, 0]))


def test_words_tell_the_shares_within_distances(answers_of):
    drawn = error_curve({"all": answers_of([[0, 0]] * 4, [[0.2, 0], [0.8, 0], [3, 0], [np.nan, np.nan]])})
    assert "25.0% within 0.5 m; 50.0% within 1 m; 75.0% within 5 m" in drawn


def test_recall_is_told_at_one_five_and_ten_places(answers_of):
    p = answers_of([[0, 0], [0, 0]], [[9, 0], [1, 0]])
    p.ranked_xy[0, 4] = (2.0, 0.0)
    assert "50.0% at one place, 100.0% at five, 100.0% at ten" in recall_curves({"all": p})


def test_calibration_error_is_the_mean_gap_between_confidence_and_truth(answers_of):
    p = answers_of([[0, 0]] * 4, [[0.5, 0], [9, 0], [0.5, 0], [0.5, 0]], confidence=[0.75, 0.75, 1.0, 1.0])
    drawn = reliability(p)
    assert drawn is not None
    assert drawn[1] == pytest.approx(0.125)


def test_without_confidence_there_is_no_reliability(answers_of):
    assert reliability(answers_of([[0, 0]], [[0, 0]])) is None


def test_sets_are_drawn_while_there_are_colours_for_them(answers_of):
    p = answers_of([[0, 0]], [[0, 0]])
    assert list(series_of({"a": p})) == ["all queries"]
    assert list(series_of({"a": p, "b": p})) == ["all queries", "a", "b"]
    assert list(series_of({str(k): p for k in range(9)})) == ["all queries"]


def test_depth_that_was_not_measured_is_grey_and_near_is_brighter_than_far():
    picture = depth_bgr(np.array([[0.0, 2.0, np.nan, FARTHEST_M]], np.float32).repeat(2, axis=0), width=4)
    assert (picture[0, [0, 2]] == 128).all()
    assert int(picture[0, 1].sum()) > int(picture[0, 3].sum())
