import numpy as np

from research.baselines.gallery import answers_of, thinned

XY = np.array([[0.0, 0], [10, 0], [20, 0], [30, 0], [40, 0], [50, 0]])


def test_places_are_kept_in_their_order_where_none_kept_before_is_nearer():
    xy = np.array([[0.0, 0], [0.6, 0], [1.0, 0], [1.5, 0], [0.0, 0.9], [2.0, 0]])
    assert thinned(xy, 1.0).tolist() == [0, 2, 5]


def test_the_street_is_that_of_most_of_the_five_nearest_and_the_place_that_of_the_nearest():
    similarity = np.array([[9, 8, 7, 6, 5, 0]], np.float32)
    found = answers_of(similarity, XY, np.array([3, 1, 1, 2, 1, 3]))
    assert found.xy.tolist() == [[0, 0]]
    assert found.street.tolist() == [1]


def test_equal_votes_go_to_the_street_with_the_nearest_place():
    similarity = np.array([[9, 8, 7, 6, 5, 0]], np.float32)
    found = answers_of(similarity, XY, np.array([4, 2, 0, 2, 4, 2]))
    assert found.street.tolist() == [4]


def test_a_place_is_as_near_as_its_best_view():
    similarity = np.zeros((1, 12), np.float32)
    similarity[0, 7] = 1.0
    assert answers_of(similarity, XY, np.zeros(6, np.int64), views=2).xy.tolist() == [[30, 0]]


def test_a_query_that_is_like_nothing_gets_no_answer():
    found = answers_of(np.full((1, 6), -np.inf, np.float32), XY, np.zeros(6, np.int64))
    assert np.isnan(found.xy).all()
    assert found.street.tolist() == [-1]
