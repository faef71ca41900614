import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.geometry.rigid import rotation_taking, rotation_z
from service.localization.starts import StartSettings, starts_from

HEIGHTS = {"height_m": 1.4, "lidar_height_m": 1.8}


def starts(matches, **options):
    return starts_from(matches, **(HEIGHTS | {"settings": StartSettings(**options)}))


def rows_of(found, matches):
    """Which matches the starts were made of: their similarities are all different."""
    return [int(np.flatnonzero(matches.similarity == each)[0]) for each in found[1]]


def test_a_start_stands_at_the_cameras_height_and_looks_along_the_view(matches_at):
    """1.4 - 1.8 m above a LiDAR that is at 12 m: 11.6 m."""
    found, similarities = starts(matches_at([(5, 6, 12)], [90], [0.8]))
    np.testing.assert_allclose(found[0].camera_m, [5, 6, 11.6], atol=1e-12)
    np.testing.assert_allclose(found[0].R_map_level, rotation_z(np.pi / 2), atol=1e-12)
    assert found[0].hypothesis == 0
    assert similarities.tolist() == [0.8]


def test_on_a_slope_the_start_stands_along_the_grounds_normal(matches_at):
    """A slope of 3 in 4 up along x has the normal (-0.6, 0, 0.8)."""
    normal = np.array([-0.6, 0, 0.8])
    slope = rotation_taking(np.array([0, 0, 1.0]), normal)
    found = starts(matches_at([(5, 6, 12)], [0], [0.8], R_map_place=slope))[0][0]
    np.testing.assert_allclose(found.camera_m, [5.24, 6, 11.68], atol=1e-12)
    np.testing.assert_allclose(found.R_map_level, [[0.8, 0, -0.6], [0, 1, 0], [0.6, 0, 0.8]], atol=1e-12)


@given(st.floats(-720, 720), st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(-180, 180))
def test_a_level_frame_is_a_rotation_whose_z_is_the_places_up(matches_at, heading_deg, x, y, place_deg):
    up = np.array([x, y, 1.0]) / np.linalg.norm([x, y, 1.0])
    place = rotation_taking(np.array([0.0, 0.0, 1.0]), up) @ rotation_z(np.deg2rad(place_deg))
    R = starts(matches_at([(1, 2, 3)], [heading_deg], [0.5], R_map_place=place))[0][0].R_map_level
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(R[:, 2], up, atol=1e-12)
    ahead = np.array([np.cos(np.deg2rad(heading_deg)), np.sin(np.deg2rad(heading_deg)), 0])
    assert R[:, 0] @ ahead > 0.9
    assert R[:, 1] @ np.cross(up, ahead) > 0.9
    assert abs(R[:, 1] @ ahead) < 1e-9


@pytest.mark.parametrize(
    ("x_m", "heading_deg", "count"),
    [(2.1, 0, 1), (2.3, 0, 2), (0, 19, 1), (0, 21, 2), (0, -19, 1), (0, -21, 2), (2.1, 19, 1), (2.1, 21, 2),
     (2.3, 19, 2), (0, 359, 1), (0, 181, 2)],
)  # fmt: skip
def test_two_views_are_distinct_by_place_or_by_heading(matches_at, x_m, heading_deg, count):
    found, _ = starts(matches_at([(0, 0, 2), (x_m, 0, 2)], [0, heading_deg], [0.9, 0.8]))
    assert len(found) == count


def test_height_does_not_make_two_places_distinct(matches_at):
    assert len(starts(matches_at([(0, 0, 2), (0, 0, 9)], [0, 0], [0.9, 0.8]))[0]) == 1


def test_the_best_of_like_views_stands_for_them(matches_at):
    matches = matches_at([(0, 0, 2), (1, 0, 2), (10, 0, 2), (11, 0, 2)], [0, 5, 90, 100], [0.9, 0.8, 0.7, 0.6])
    found, similarities = starts(matches)
    assert similarities.tolist() == [0.9, 0.7]
    assert [each.hypothesis for each in found] == [0, 1]
    np.testing.assert_allclose([each.camera_m[0] for each in found], [0, 10])


@given(seed=st.integers(0, 10**6), count=st.integers(1, 40), most=st.integers(1, 10))
@settings(max_examples=40)
def test_starts_are_distinct_the_best_first_and_at_most_so_many(matches_at, seed, count, most):
    rng = np.random.default_rng(seed)
    similarity = np.sort(rng.uniform(0, 1, count))[::-1]
    matches = matches_at(rng.uniform(0, 8, (count, 3)), rng.uniform(-180, 180, count), similarity)
    found = starts(matches, most=most)
    kept = rows_of(found, matches)
    assert len(kept) == len(found[0]) == len(found[1]) <= most
    assert kept == sorted(kept)
    assert kept[0] == 0
    assert [each.hypothesis for each in found[0]] == list(range(len(kept)))
    xy, heading = matches.T_map_place[:, :2, 3], matches.heading_rad

    def alike(i, j):
        turn = (heading[i] - heading[j] + np.pi) % (2 * np.pi) - np.pi
        return np.linalg.norm(xy[i] - xy[j]) < 2.2 and abs(turn) < np.deg2rad(20)

    assert not any(alike(i, j) for i in kept for j in kept if i < j)
    left = [row for row in range(count if len(kept) < most else kept[-1]) if row not in kept]
    assert all(any(alike(row, better) for better in kept if better < row) for row in left)
    for each, row in zip(found[0], kept, strict=True):
        np.testing.assert_allclose(each.camera_m[:2], xy[row])
