import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.rigid import rotation_x, rotation_z, transform_from
from service.retrieval.hypotheses import ClusterSettings, Hypothesis, cluster
from service.retrieval.knn import ViewMatches, similarity_weights

SETTINGS = ClusterSettings(views=10, radius_m=4.0, heading_rad=np.deg2rad(25), temperature=0.1)


def matches_of(*rows: tuple[float, float, float, float, int]) -> ViewMatches:
    """Return matches from rows: similarity, x, y, heading in degrees, street. Places have the number of their row."""
    similarity, x, y, heading, street = (np.array(column, np.float64) for column in zip(*rows, strict=True))
    positions = np.stack([x, y, np.full(len(rows), 2.0)], axis=1)
    return ViewMatches(
        view=np.arange(len(rows)),
        similarity=similarity,
        place=np.arange(len(rows), dtype=np.int32),
        street=street.astype(np.int32),
        heading_rad=np.deg2rad(heading),
        T_map_place=np.stack([transform_from(np.eye(3), position) for position in positions]),
    )


def test_weights_fall_by_e_for_each_temperature() -> None:
    weights = similarity_weights(np.array([0.9, 0.8]), 0.1)
    assert weights[0] / weights[1] == pytest.approx(np.e)
    assert weights.sum() == pytest.approx(1)


def test_equal_views_of_one_street_give_their_mean() -> None:
    best = cluster(matches_of((0.9, 0, 0, 10, 0), (0.9, 2, 1, 20, 0)), SETTINGS)[0]
    np.testing.assert_allclose(best.position_m, [1.0, 0.5, 2.0])
    assert np.rad2deg(best.heading_rad) == pytest.approx(15)
    assert best.weight == pytest.approx(1)


def test_headings_are_averaged_across_the_half_turn() -> None:
    best = cluster(matches_of((0.9, 0, 0, 175, 0), (0.9, 1, 0, -175, 0)), SETTINGS)[0]
    assert abs(np.rad2deg(best.heading_rad)) == pytest.approx(180)


def test_two_streets_are_never_averaged_however_near() -> None:
    found = cluster(matches_of((0.9, 0, 0, 0, 0), (0.89, 0, 2, 0, 1)), SETTINGS)
    assert [(h.street, h.position_m[1]) for h in found] == [(0, 0.0), (1, 2.0)]


def test_a_view_in_no_street_joins_its_neighbours_street() -> None:
    found = cluster(matches_of((0.9, 0, 0, 0, -1), (0.9, 1, 0, 0, 3), (0.9, 2, 0, 0, 4)), SETTINGS)
    assert [(h.street, h.members) for h in found] == [(3, 2), (4, 1)]


def test_opposite_headings_of_one_place_are_two_hypotheses() -> None:
    assert len(cluster(matches_of((0.9, 0, 0, 0, 0), (0.9, 0, 0, 180, 0)), SETTINGS)) == 2


def test_several_good_views_outweigh_one_better_one_elsewhere() -> None:
    best = cluster(
        matches_of((0.90, 50, 0, 0, 1), (0.88, 0, 0, 0, 0), (0.88, 1, 0, 0, 0), (0.88, 2, 0, 0, 0)), SETTINGS
    )[0]
    assert (best.street, best.members, best.place) == (0, 3, 1)


def test_only_the_most_similar_views_take_part() -> None:
    settings = ClusterSettings(views=1, radius_m=4.0, heading_rad=0.4, temperature=0.1)
    found = cluster(matches_of((0.9, 0, 0, 0, 0), (0.9, 1, 0, 0, 0)), settings)
    assert [h.members for h in found] == [1]


rows = st.tuples(st.floats(0.5, 1), st.floats(-20, 20), st.floats(-20, 20), st.floats(-180, 180), st.integers(-1, 2))


@given(st.lists(rows, min_size=1, max_size=10))
def test_every_view_is_in_exactly_one_cluster_and_the_heaviest_is_first(
    drawn: list[tuple[float, float, float, float, int]],
) -> None:
    found = cluster(matches_of(*sorted(drawn, reverse=True)), SETTINGS)
    assert sum(h.members for h in found) == len(drawn)
    assert sum(h.weight for h in found) == pytest.approx(1)
    assert [h.weight for h in found] == sorted((h.weight for h in found), reverse=True)


@given(st.floats(-3, 3), st.floats(-0.3, 0.3), st.floats(-3, 3))
def test_the_level_frame_is_a_rotation_that_keeps_the_heading_and_the_normal(
    heading: float, tilt: float, about: float
) -> None:
    normal = (rotation_z(about) @ rotation_x(tilt))[:, 2]
    hypothesis = Hypothesis(1.0, np.zeros(3), heading, normal, 0, 0, 0.9, 1)
    R = hypothesis.R_map_level
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(R[:, 2], normal, atol=1e-12)
    # On a slope the axis lies in the ground; seen from above it still points close to the heading.
    assert np.cos(np.arctan2(R[1, 0], R[0, 0]) - heading) > 0.99
