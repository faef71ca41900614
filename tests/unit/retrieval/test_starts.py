import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.geometry.rigid import (
    R_BODY_OPTICAL,
    rotation_taking,
    rotation_y,
    rotation_z,
    transform_from,
    transform_points,
)
from service.retrieval.prior import Prior
from service.retrieval.starts import StartSettings, starts_from

ANY_SIMILARITY = 3.0  # no two cosines are so far apart


@pytest.fixture(scope="module")
def starts(frame_with):
    """Return starts from one frame with a camera height of 1.4 m, on a map with a LiDAR height of 1.8 m."""

    def made(matches, *, prior=None, less_similar=ANY_SIMILARITY, **options):
        chosen = StartSettings(less_similar=less_similar, temperature=0.02, **options)
        return starts_from((frame_with(matches),), prior, lidar_height_m=1.8, settings=chosen)

    return made


def rows_of(found, matches):
    """Return the matches of the starts. All places differ."""
    xy = matches.T_map_place[:, :2, 3]
    return [int(np.argmin(np.linalg.norm(xy - start.camera_m[:2], axis=1))) for start in found]


def test_a_start_stands_at_the_cameras_height_and_looks_along_the_view(matches_at, starts):
    """1.4 - 1.8 m above a LiDAR at 12 m is 11.6 m."""
    (found,) = starts(matches_at([(5, 6, 12)], [90], [0.8]))
    np.testing.assert_allclose(found.camera_m, [5, 6, 11.6], atol=1e-12)
    np.testing.assert_allclose(found.R_map_level, rotation_z(np.pi / 2), atol=1e-12)
    assert found.hypothesis == 0


def test_on_a_slope_the_start_stands_along_the_grounds_normal(matches_at, starts):
    """A slope of 3 in 4 along x has the normal (-0.6, 0, 0.8)."""
    normal = np.array([-0.6, 0, 0.8])
    slope = rotation_taking(np.array([0, 0, 1.0]), normal)
    (found,) = starts(matches_at([(5, 6, 12)], [0], [0.8], R_map_place=slope))
    np.testing.assert_allclose(found.camera_m, [5.24, 6, 11.68], atol=1e-12)
    np.testing.assert_allclose(found.R_map_level, np.array([[0.8, 0, -0.6], [0, 1, 0], [0.6, 0, 0.8]]), atol=1e-12)


@given(st.floats(-720, 720), st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(-180, 180))
def test_a_level_frame_is_a_rotation_whose_z_is_the_places_up(matches_at, starts, heading_deg, x, y, place_deg):
    up = np.array([x, y, 1.0]) / np.linalg.norm([x, y, 1.0])
    place = rotation_taking(np.array([0.0, 0.0, 1.0]), up) @ rotation_z(np.deg2rad(place_deg))
    R = starts(matches_at([(1, 2, 3)], [heading_deg], [0.5], R_map_place=place))[0].R_map_level
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
def test_two_views_are_distinct_by_place_or_by_heading(matches_at, starts, x_m, heading_deg, count):
    assert len(starts(matches_at([(0, 0, 2), (x_m, 0, 2)], [0, heading_deg], [0.9, 0.8]))) == count


def test_height_does_not_make_two_places_distinct(matches_at, starts):
    assert len(starts(matches_at([(0, 0, 2), (0, 0, 9)], [0, 0], [0.9, 0.8]))) == 1


def test_the_best_of_like_views_stands_for_them(matches_at, starts):
    found = starts(matches_at([(0, 0, 2), (1, 0, 2), (10, 0, 2), (11, 0, 2)], [0, 5, 90, 100], [0.9, 0.8, 0.7, 0.6]))
    assert [each.hypothesis for each in found] == [0, 1]
    np.testing.assert_allclose([each.camera_m[0] for each in found], [0, 10])


@pytest.mark.parametrize(("similarity", "starts_one"), [(0.79, True), (0.77, False)])
def test_a_view_that_is_much_less_similar_than_the_best_starts_nothing(matches_at, starts, similarity, starts_one):
    """The best has 0.9. A view with 0.12 less is still a start."""
    found = starts(matches_at([(0, 0, 2), (10, 0, 2)], [0, 0], [0.9, similarity]), less_similar=0.12)
    assert [round(each.camera_m[0]) for each in found] == ([0, 10] if starts_one else [0])


@given(seed=st.integers(0, 10**6), count=st.integers(1, 40), most=st.integers(1, 10))
@settings(max_examples=40)
def test_starts_are_distinct_the_best_first_and_at_most_so_many(matches_at, starts, seed, count, most):
    rng = np.random.default_rng(seed)
    similarity = np.sort(rng.uniform(0, 1, count))[::-1]
    matches = matches_at(rng.uniform(0, 8, (count, 3)), rng.uniform(-180, 180, count), similarity)
    found = starts(matches, most=most)
    kept = rows_of(found, matches)
    assert len(kept) <= most
    assert kept == sorted(kept)
    assert kept[0] == 0
    assert [each.hypothesis for each in found] == list(range(len(kept)))
    xy, heading = matches.T_map_place[:, :2, 3], matches.heading_rad

    def alike(i, j):
        turn = (heading[i] - heading[j] + np.pi) % (2 * np.pi) - np.pi
        return np.linalg.norm(xy[i] - xy[j]) < 2.2 and abs(turn) < np.deg2rad(20)

    assert not any(alike(i, j) for i in kept for j in kept if i < j)
    left = [row for row in range(count if len(kept) < most else kept[-1]) if row not in kept]
    assert all(any(alike(row, better) for better in kept if better < row) for row in left)
    for each, row in zip(found, kept, strict=True):
        np.testing.assert_allclose(each.camera_m[:2], xy[row])
        assert np.cos(np.arctan2(each.R_map_level[1, 0], each.R_map_level[0, 0]) - heading[row]) == pytest.approx(1)


@pytest.fixture
def row_of_places(matches_at):
    """Return ten places 10 m apart along x, each 0.001 less similar than the one before."""
    return matches_at([(10 * k, 0, 2) for k in range(10)], [0] * 10, [0.9 - 0.001 * k for k in range(10)])


def x_of(found):
    return [round(each.camera_m[0]) for each in found]


def test_half_of_the_starts_are_taken_with_a_prior_and_the_rest_without_it(row_of_places, starts):
    """Prior 20 m around x = 90, 0.02 of similarity per nat: 0.5 sigma costs 0.0025, 1 sigma 0.01, and x = 0 the limit 0.1."""
    prior = Prior(position_m=np.array([90.0, 0.0]), position_std_m=20.0)
    assert x_of(starts(row_of_places, prior=prior, most=5)) == [90, 80, 70, 0, 10]
    assert x_of(starts(row_of_places, prior=prior, most=4)) == [90, 80, 0, 10]
    assert x_of(starts(row_of_places, most=4)) == [0, 10, 20, 30]


def test_with_a_prior_too_every_start_is_numbered_and_taken_once(row_of_places, starts):
    found = starts(row_of_places, prior=Prior(position_m=np.array([0.0, 0.0])), most=10)
    assert sorted(x_of(found)) == [10 * k for k in range(10)]
    assert [each.hypothesis for each in found] == list(range(10))


@pytest.mark.parametrize(("prior_x_m", "expected"), [(10.0, [10, 0]), (0.0, [0])])
def test_a_prior_lets_a_less_similar_view_start_where_it_fits(matches_at, starts, prior_x_m, expected):
    """It has 0.15 less similarity, but the better one loses 0.1 by its distance from the prior."""
    matches = matches_at([(0, 0, 2), (10, 0, 2)], [0, 0], [0.9, 0.75])
    prior = Prior(position_m=np.array([prior_x_m, 0.0]), position_std_m=1.0)
    assert sorted(x_of(starts(matches, prior=prior, less_similar=0.12))) == sorted(expected)
    assert x_of(starts(matches, less_similar=0.12)) == [0]


def test_a_prior_of_the_heading_alone_moves_views_of_that_heading_forward(matches_at, starts):
    matches = matches_at([(0, 0, 2), (10, 0, 2), (20, 0, 2)], [0, 90, 180], [0.9, 0.89, 0.88])
    prior = Prior(heading_rad=np.pi, heading_std_rad=0.3)
    assert x_of(starts(matches, prior=prior, most=2)) == [20, 0]


AHEAD_3_M = transform_from(np.eye(3), np.array([0.0, 0.0, 3.0]))  # optical: z is forward


def test_a_match_of_another_frame_is_transformed_to_the_reference(matches_at, frame_with):
    """A frame 3 m ahead matches x = 10 with a view along y. So the reference is 3 m behind: (10, -3)."""
    reference = frame_with(matches_at([(50, 50, 12)], [0], [0.9]))
    ahead = frame_with(matches_at([(10, 0, 12)], [90], [0.8]), T_reference_camera=AHEAD_3_M)
    found = starts_from(
        (reference, ahead), None, lidar_height_m=1.8, settings=StartSettings(less_similar=ANY_SIMILARITY)
    )
    np.testing.assert_allclose([each.camera_m for each in found], [[50, 50, 11.6], [10, -3, 11.6]], atol=1e-12)
    np.testing.assert_allclose(found[1].R_map_level, rotation_z(np.pi / 2), atol=1e-12)


def test_a_camera_that_looks_left_puts_the_reference_to_the_right_of_its_heading(matches_at, frame_with):
    """The camera is 1 m to the left of the reference and looks left. It matches a view along y, so the reference looks along x."""
    left = transform_from(R_BODY_OPTICAL.T @ rotation_z(np.pi / 2) @ R_BODY_OPTICAL, np.array([-1.0, 0.0, 0.0]))
    reference = frame_with(matches_at([(50, 50, 12)], [0], [0.9]))
    beside = frame_with(matches_at([(10, 0, 12)], [90], [0.8]), T_reference_camera=left)
    found = starts_from(
        (reference, beside), None, lidar_height_m=1.8, settings=StartSettings(less_similar=ANY_SIMILARITY)
    )[1]
    np.testing.assert_allclose(found.camera_m, [10, -1, 11.6], atol=1e-12)
    np.testing.assert_allclose(found.R_map_level, np.eye(3), atol=1e-12)


def test_frames_of_one_drive_agree_on_one_start(matches_at, frame_with):
    """The frame 3 m ahead matches the place 3 m ahead. So both give the same reference pose."""
    reference = frame_with(matches_at([(10, 0, 2)], [0], [0.8]))
    ahead = frame_with(matches_at([(13, 0, 2)], [0], [0.9]), T_reference_camera=AHEAD_3_M)
    assert x_of(
        starts_from((reference, ahead), None, lidar_height_m=1.8, settings=StartSettings(less_similar=ANY_SIMILARITY))
    ) == [10]


def test_the_most_similar_match_comes_first_whichever_frame_found_it(matches_at, frame_with):
    reference = frame_with(matches_at([(50, 0, 2)], [0], [0.8]))
    ahead = frame_with(matches_at([(13, 0, 2)], [0], [0.9]), T_reference_camera=AHEAD_3_M)
    assert x_of(
        starts_from((reference, ahead), None, lidar_height_m=1.8, settings=StartSettings(less_similar=ANY_SIMILARITY))
    ) == [10, 50]


def test_starts_of_several_frames_are_ranked_by_all_frames(matches_at, frame_with):
    """Aliases of single frames at 50 and 80 displace 10, which is second best for all frames."""
    asked = []

    def similarity_at(T_map_level):
        asked.append(T_map_level[:, 0, 3])
        return np.where(np.abs(T_map_level[:, 0, 3] - 10) < 1, 0.85, 0.3)

    reference = frame_with(matches_at([(50, 0, 2), (10, 0, 2)], [0, 0], [0.95, 0.85]))
    ahead = frame_with(matches_at([(83, 0, 2), (13, 0, 2)], [0, 0], [0.96, 0.84]), T_reference_camera=AHEAD_3_M)

    def found(**options):
        chosen = StartSettings(most=2, less_similar=ANY_SIMILARITY, **options)
        return starts_from((reference, ahead), None, lidar_height_m=1.8, settings=chosen, similarity_at=similarity_at)

    assert x_of(found()) == [10, 80]
    assert found()[0].similarity == pytest.approx(0.85)
    assert sorted(asked[0]) == [10, 50, 80]  # one start of the two that agree
    assert x_of(found(pooled=2)) == [80, 50]  # what is not in the pool is not compared


def test_starts_that_all_frames_find_less_like_the_map_than_the_best_start_nothing(matches_at, frame_with):
    reference = frame_with(matches_at([(50, 0, 2), (10, 0, 2)], [0, 0], [0.9, 0.85]))
    found = starts_from(
        (reference, reference),
        None,
        lidar_height_m=1.8,
        settings=StartSettings(less_similar=0.1),
        similarity_at=lambda T: np.where(T[:, 0, 3] < 30, 0.8, 0.69),
    )
    assert x_of(found) == [10]


def test_a_prior_moves_starts_of_several_frames_forward_too(matches_at, frame_with):
    reference = frame_with(matches_at([(0, 0, 2), (50, 0, 2), (100, 0, 2)], [0, 0, 0], [0.9, 0.9, 0.9]))
    prior = Prior(position_m=np.array([100.0, 0.0]), position_std_m=5.0)
    found = starts_from(
        (reference, reference),
        prior,
        lidar_height_m=1.8,
        settings=StartSettings(most=2, less_similar=ANY_SIMILARITY),
        similarity_at=lambda T: np.where(T[:, 0, 3] == 50, 0.9, 0.8),
    )
    assert x_of(found) == [100, 50]


angle = st.floats(-0.3, 0.3)


@given(angle, angle, st.floats(-3, 3), st.lists(st.floats(-5, 5), min_size=3, max_size=3))
def test_a_point_is_the_same_point_in_the_level_frames_of_both_cameras(
    matches_at, frame_with, pitch, other_pitch, turn, position
):
    """Via the cameras, or from level frame to level frame, the result is equal."""
    R_level_camera, R_level_reference = (rotation_y(each) @ R_BODY_OPTICAL for each in (pitch, other_pitch))
    T_reference_camera = transform_from(rotation_y(turn), np.array(position))
    in_camera = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 9.0]])
    through = transform_points(T_reference_camera, in_camera) @ R_level_reference.T
    matches = matches_at([(0, 0, 2)], [0], [0.9])
    reference = frame_with(matches, R_level_camera=R_level_reference)
    frame = frame_with(matches, R_level_camera=R_level_camera, T_reference_camera=T_reference_camera)
    T = frame.T_reference_level(reference)
    np.testing.assert_allclose(transform_points(T, in_camera @ R_level_camera.T), through, atol=1e-9)


@given(angle, st.floats(-3, 3), st.lists(st.floats(-5, 5), min_size=3, max_size=3))
def test_the_pose_of_the_level_frame_and_that_of_the_camera_follow_from_each_other(
    matches_at, frame_with, pitch, turn, position
):
    """A point in front of the camera has the same coordinates in the map by both poses."""
    frame = frame_with(matches_at([(0, 0, 2)], [0], [0.9]), R_level_camera=rotation_y(pitch) @ R_BODY_OPTICAL)
    T_map_camera = transform_from(rotation_y(turn), np.array(position))
    T_map_level = frame.pose_of_level(T_map_camera)
    np.testing.assert_allclose(frame.pose_of_camera(T_map_level), T_map_camera, atol=1e-12)
    in_camera = np.array([[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(
        transform_points(T_map_level, in_camera @ frame.R_level_camera.T),
        transform_points(T_map_camera, in_camera),
        atol=1e-9,
    )
