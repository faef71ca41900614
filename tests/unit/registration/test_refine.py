import numpy as np
import pytest

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, heading_of_camera, rotation_y, rotation_z, transform_from
from service.localization.refine import RefineSettings, refine

CAMERA = PinholeCamera(80, 60, 50.0, 50.0, 39.5, 29.5)
R_LEVEL_CAMERA = rotation_y(np.deg2rad(4.0)) @ R_BODY_OPTICAL
HEADING_DEG = 5.0
TRUE = transform_from(rotation_z(np.deg2rad(HEADING_DEG)) @ R_LEVEL_CAMERA, np.array([0.8, 0.5, 1.5]))


@pytest.fixture(scope="module")
def cloud(scene_of, streets_at):
    """The street, and 40 m beside it its like without lorry and pillar."""
    return scene_of(*streets_at(-6.0, 0.0), *streets_at(-6.0, 40.0)[:4]).survey()


@pytest.fixture(scope="module")
def depth(street):
    """Taken in the street itself, with some noise."""
    inverse = 1 / np.maximum(street.depth(CAMERA, TRUE), 1e-3)
    return (1 / (inverse + np.random.default_rng(8).normal(0, 1e-4, inverse.shape))).astype(np.float32)


def refined(cloud, depth, matches, **options):
    return refine(
        cloud, depth, CAMERA, matches, R_level_camera=R_LEVEL_CAMERA, height_m=1.5, lidar_height_m=1.8,
        settings=RefineSettings(**options),
    )  # fmt: skip


@pytest.fixture
def both(matches_at):
    """The similar views lie in the street beside the true one, and in the true one."""
    return matches_at([(0, 40, 1.8), (0, 0, 1.8)], [0, 0], [0.9, 0.4])


def test_a_picture_is_found_where_it_was_taken(cloud, depth, matches_at):
    found = refined(cloud, depth, matches_at([(0, 0, 1.8)], [0], [0.9]))
    assert found is not None
    np.testing.assert_allclose(found.T_map_camera[:3, 3], TRUE[:3, 3], atol=0.05)
    assert np.rad2deg(heading_of_camera(found.T_map_camera)) == pytest.approx(HEADING_DEG, abs=0.2)
    np.testing.assert_allclose(found.T_map_camera[:3, :3], TRUE[:3, :3], atol=0.005)
    np.testing.assert_array_equal(found.T_map_camera[3], [0, 0, 0, 1])


def test_the_pose_and_its_covariance_are_those_of_the_first_candidate(cloud, depth, both):
    found = refined(cloud, depth, both)
    best = found.candidates[0]
    np.testing.assert_array_equal(found.T_map_camera[:3, 3], best.camera_m)
    np.testing.assert_allclose(found.T_map_camera[:3, :3] @ R_LEVEL_CAMERA.T, best.R_map_level, atol=1e-12)
    np.testing.assert_array_equal(found.covariance, found.covariance.T)
    deviation = np.sqrt(np.diag(found.covariance)[:3])
    assert (np.abs(TRUE[1, 3] + 40 * (best.hypothesis == 0) - best.camera_m[1])) < 4 * deviation[1] + 0.02
    assert deviation.max() < 0.3


@pytest.mark.parametrize(("weight", "y_m"), [(0.0, 0.5), (1.0, 40.5)])
def test_the_weight_of_the_similarity_decides_between_two_like_streets(cloud, depth, both, weight, y_m):
    """The true street fits better; the view of the other one is more similar."""
    found = refined(cloud, depth, both, similarity_weight=weight)
    inliers = {each.hypothesis: each.inliers for each in reversed(found.candidates)}
    assert inliers[0] < inliers[1] < inliers[0] + 0.5
    assert found.T_map_camera[1, 3] == pytest.approx(y_m, abs=0.3)
    assert found.candidates[0].hypothesis == (0 if weight else 1)


def test_like_similarity_leaves_it_to_the_points(cloud, depth, matches_at):
    matches = matches_at([(0, 40, 1.8), (0, 0, 1.8)], [0, 0], [0.7, 0.7])
    assert refined(cloud, depth, matches).T_map_camera[1, 3] == pytest.approx(0.5, abs=0.05)


def test_candidates_come_in_the_order_of_their_support(cloud, depth, both):
    found = refined(cloud, depth, both, similarity_weight=0.3)
    support = [each.inliers + 0.3 * (0.9, 0.4)[each.hypothesis] for each in found.candidates]
    assert len(support) > 1
    assert support == sorted(support, reverse=True)


def test_an_empty_picture_is_not_registered(cloud, depth, both):
    assert refined(cloud, np.zeros_like(depth), both) is None


def test_a_picture_of_too_few_points_is_not_registered(cloud, depth, both):
    few = np.zeros_like(depth)
    few[20, 10:39] = depth[20, 10:39]
    assert refined(cloud, few, both) is None
    few[20, 39:45] = depth[20, 39:45]
    assert refined(cloud, few, both) is not None
