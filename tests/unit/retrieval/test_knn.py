import numpy as np
import pytest

from service.retrieval.knn import Neighbour, vote


def neighbours_of(*rows: tuple[float, int]) -> tuple[Neighbour, ...]:
    return tuple(Neighbour(n, similarity, 0.0, street, np.zeros(3), 0.0) for n, (similarity, street) in enumerate(rows))


def test_equal_neighbours_vote_by_number() -> None:
    result = vote(neighbours_of((0.9, 1), (0.9, 0), (0.9, 0)), 0.05)
    assert (result.street, result.share) == (0, pytest.approx(2 / 3))


def test_one_much_nearer_neighbour_outvotes_two() -> None:
    assert vote(neighbours_of((0.95, 1), (0.7, 0), (0.7, 0)), 0.05).street == 1


def test_the_shares_of_all_streets_sum_to_one() -> None:
    result = vote(neighbours_of((0.9, 1), (0.8, 0), (0.7, -1)), 0.05)
    assert [street for street, _ in result.shares] == [1, 0, -1]
    assert sum(share for _, share in result.shares) == pytest.approx(1)


def test_where_most_lie_in_no_street_none_wins() -> None:
    assert vote(neighbours_of((0.9, -1), (0.9, -1), (0.9, 4)), 0.05).street == -1
