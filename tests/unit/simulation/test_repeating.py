import numpy as np
import pytest
from scipy.spatial import cKDTree

from model_training.simulation.plan import SimulationPlan
from model_training.simulation.repeating import BLOCK_M, BLOCKS, RepeatingCity, landmarks_m
from model_training.simulation.simulate import _city
from model_training.simulation.terrain import Cover

LANDMARKS = (2, 7, 12, 17)
START_M = -BLOCKS * BLOCK_M / 2


@pytest.fixture(scope="module")
def repeating():
    return RepeatingCity(seed=3)


@pytest.fixture(scope="module")
def block_of(repeating):
    """Return triangles above the ground in the middle of a block, relative to its start. Trees may extend over its ends."""
    triangles = repeating.static.triangles.astype(np.float64)
    middle, top = triangles.mean(axis=1)[:, 0], triangles[..., 2].max(axis=1)

    def block(number, margin_m=9.0):
        start = START_M + number * BLOCK_M
        rows = (middle > start + margin_m) & (middle < start + BLOCK_M - margin_m) & (top > 0.05)
        return np.c_[
            (triangles[rows] - [start, 0, 0]).reshape(-1, 9),
            repeating.static.albedo[rows],
            repeating.static.material[rows],
        ]

    return block


def away(one, other):
    """Return the distance of each point of the second to the nearest of the first."""
    return cKDTree(one).query(other)[0]


def same(one, other):
    """Check that every triangle of each has an equal one in the other, within a millimetre."""
    return all(away(a, b).max() < 1e-3 for a, b in ((one, other), (other, one)))


def test_blocks_are_equal_except_for_those_with_a_landmark(block_of):
    blocks = [block_of(number) for number in range(BLOCKS)]
    assert len(blocks[0]) > 500
    assert [k for k in range(BLOCKS) if not same(blocks[k], blocks[0])] == list(LANDMARKS)


def test_blocks_are_equal_to_their_ends_if_their_neighbours_are(block_of):
    first, second = block_of(4, margin_m=-0.01), block_of(9, margin_m=0.0)
    assert (away(first, second) < 1e-3).mean() > 0.99


def test_landmarks_differ_from_each_other(block_of):
    blocks = [block_of(number) for number in LANDMARKS]
    assert not any(same(blocks[k], blocks[j]) for k in range(4) for j in range(k))


def test_landmarks_stand_in_the_middles_of_their_blocks():
    np.testing.assert_allclose(landmarks_m(), [-270, -90, 90, 270])


def test_the_ground_is_equal_in_every_block(repeating):
    """Away from the ends, where road markings begin."""
    x, y = np.meshgrid(np.arange(0.25, BLOCK_M, 0.5), np.arange(-8, 8, 0.05))
    covers = [
        repeating.ground.at(np.stack([x.ravel() + START_M + k * BLOCK_M, y.ravel()], axis=1))
        for k in range(3, BLOCKS - 3)
    ]
    assert {Cover.ASPHALT, Cover.PAVING} <= {Cover(value) for value in np.unique(covers[0])}
    assert all((cover == covers[0]).mean() > 0.999 for cover in covers)


@pytest.mark.parametrize("traversal", [0, 1, 2])
def test_nobody_parks_and_people_stand_beside_the_carriageway(repeating, traversal):
    """No vehicle is as low and wide as a person. People are at most 2 m high."""
    people = repeating.occupants(traversal).triangles
    assert len(people) > 0
    size = np.ptp(people.reshape(-1, 10, 3, 3).reshape(-1, 30, 3), axis=1)  # a box has ten triangles
    assert size[:, :2].max() < 0.8
    assert people[..., 2].max() < 2.0
    assert np.abs(people[..., 1]).min() > 4.0
    np.testing.assert_array_equal(people, repeating.occupants(traversal, parked_changed=1.0).triangles)


def test_people_are_others_on_every_drive(repeating):
    one, other = repeating.occupants(1).triangles, repeating.occupants(2).triangles
    assert one.shape != other.shape or np.abs(one - other).max() > 0.5


def test_the_street_is_straight_and_level_and_one_plan_names_it(repeating):
    (street,) = repeating.streets
    assert np.ptp(street.lines[0][:, 1]) == 0
    assert np.ptp(street.lines[0][:, 0]) == BLOCKS * BLOCK_M
    assert {repeating.height(x, y) for x, y in ((0.0, 0.0), (300.0, 20.0), (-200.0, -5.0))} == {0.0}
    made = _city(SimulationPlan(name="r", city="repeating", seed=3))
    np.testing.assert_array_equal(made.static.triangles, repeating.static.triangles)


def test_another_seed_is_another_block(repeating):
    other = RepeatingCity(seed=4).static.triangles
    assert other.shape != repeating.static.triangles.shape or np.abs(other - repeating.static.triangles).max() > 1
