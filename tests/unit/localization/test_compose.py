"""Places that registration verifies come before perceptual aliases."""

from collections.abc import Callable

import numpy as np
import pytest

from service.localization.compose import VERIFIED_M, reranked
from service.retrieval.knn import Neighbour
from service.scoring.candidates import Candidate


def place(number: int, x: float) -> Neighbour:
    return Neighbour(number, 1.0 - 0.01 * number, 0.1, -1, np.array([x, 0.0, 1.8]), 0.0)


PLACES = (place(0, 100.0), place(1, 0.0), place(2, 2.0), place(3, 50.0))


@pytest.mark.parametrize(
    ("at", "expected"),
    [
        ((), [0, 1, 2, 3]),
        ((1.5,), [2, 0, 1, 3]),
        ((1.5, 0.0), [2, 1, 0, 3]),
        ((49.0, 1.5, 50.5), [3, 2, 0, 1]),  # the second pose near place 3 finds it taken
        ((100.0 + VERIFIED_M + 0.1,), [0, 1, 2, 3]),
        ((-VERIFIED_M + 0.1,), [1, 0, 2, 3]),
    ],
)
def test_the_place_nearest_to_each_registered_pose_comes_first(
    candidate: Callable[..., Candidate], at: tuple[float, ...], expected: list[int]
) -> None:
    found = reranked(PLACES, tuple(candidate(xyz=(x, 0.0, 1.5)) for x in at))
    assert [each.place for each in found] == expected


def test_more_poses_than_places_are_no_harm(candidate: Callable[..., Candidate]) -> None:
    found = reranked(PLACES[:1], tuple(candidate(xyz=(100.0, 0.0, 1.5)) for _ in range(3)))
    assert [each.place for each in found] == [0]
