from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.camera import PinholeCamera
from service.registration.points import DepthBlocks, PointSettings
from service.scoring.measured import measure
from service.scoring.structure import (
    CAMERA,
    Structure,
    StructureScorer,
    StructureWeights,
    compare,
    depth_edges,
    structure_image,
)

SHAPE = (CAMERA.height, CAMERA.width)
#: Rotation from the optical frame to a level frame whose x axis is the optical axis.
R_LEVEL_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def seen(z_m, *, noise=1e-3, height_m=1.5, camera=CAMERA, focal_baseline_px_m=None):
    """Prepare a depth image that the small camera took itself."""
    blocks = DepthBlocks(np.asarray(z_m, np.float32), camera, (1.0, 1.0))
    return structure_image(blocks, R_LEVEL_CAMERA, height_m, noise=noise, focal_baseline_px_m=focal_baseline_px_m)


def wall_with_posts(columns=(20, 50, 85), wall_m=12.0, post_m=6.0):
    """A wall with posts that are four pixels wide."""
    z = np.full(SHAPE, wall_m, np.float32)
    for column in columns:
        z[:, column : column + 4] = post_m
    return z


def test_depth_edges_are_where_the_depth_changes_by_a_quarter():
    """From 4 to 5.1 m is an edge, from 5.1 to 6 m is none; beside an unknown depth there is none."""
    found = depth_edges(np.array([[4.0, 5.1, 6.0, 0.0, 2.0, 1.0]], np.float32))
    assert found.known.tolist() == [[True, True, False, False, True]]
    assert found.rising[0].tolist() == [[True, False, False, False, False]]
    assert found.rising[1].tolist() == [[False, False, False, False, True]]
    assert found.near[0].tolist() == [[True, True, False, False, False]]
    assert found.near[1].tolist() == [[False, False, False, True, True]]


def test_a_map_that_equals_the_image_shares_all_edges_and_all_points():
    """Three posts have 2 edges in each of 56 rows: 336 in each image, so the share is 672 / (672 + 10)."""
    z = wall_with_posts()
    found = compare(seen(z), z)
    assert found.shared_edges == pytest.approx(672 / 682)
    upper = seen(z).upper.sum()
    assert found.upper_inliers == pytest.approx((upper + 10) / (upper + 20))
    assert found.contrast > 0.2


def test_edges_are_shared_within_one_pixel_and_in_the_same_direction_only():
    z = wall_with_posts()
    beside, apart, inside_out = (
        np.roll(z, 1, axis=1),
        np.roll(z, 6, axis=1),
        np.where(z == 6.0, np.float32(12.0), np.float32(6.0)),
    )
    share = {name: compare(seen(z), each).shared_edges for name, each in
             {"beside": beside, "apart": apart, "inside out": inside_out}.items()}  # fmt: skip
    assert share["beside"] == pytest.approx(672 / 682)
    assert share["apart"] == share["inside out"] == 0.0


def test_a_bare_wall_has_no_contrast():
    """The image of a wall that fills the view does not change by a shift. So nothing tells the pose from its neighbours."""
    wall = np.full(SHAPE, 10.0, np.float32)
    found = compare(seen(wall), wall)
    assert found.contrast == pytest.approx(0.0, abs=1e-6)
    assert found.shared_edges == 0.0


def test_points_below_the_height_of_vehicles_do_not_count_as_upper_points():
    """With 10 m of depth, row v is (27.5 - v) / 40 * 10 m above a camera at 1.5 m: rows 0 to 25 are above 2 m."""
    image = seen(np.full(SHAPE, 10.0, np.float32))
    assert np.flatnonzero(image.upper.all(axis=1)).tolist() == list(range(26))
    assert np.flatnonzero(image.raised.all(axis=1)).tolist() == list(range(33))  # 0.3 m is 4.8 rows below the camera


def test_without_points_the_numbers_say_nothing():
    empty = np.zeros(SHAPE, np.float32)
    assert compare(seen(empty), wall_with_posts()) == Structure(0.0, 0.5, 0.0)
    assert compare(seen(wall_with_posts()), empty) == Structure(0.0, 0.5, 0.0)


def test_scale_and_disparity_offset_of_the_pose_correct_the_depth():
    """The depth is 6 % too short, or a disparity of 80 px m has an offset of 1 px. Corrected, it lies on the map again."""
    z = wall_with_posts()
    exact = compare(seen(z), z)
    short = compare(seen(z / 1.06), z, scale=1.06)
    assert (short.upper_inliers, short.shared_edges) == pytest.approx(
        (exact.upper_inliers, exact.shared_edges), abs=1e-3
    )
    assert compare(seen(z / 1.06), z).upper_inliers < 0.9 * exact.upper_inliers
    shifted = z / (1 - z / 80.0)  # shifted / (1 + shifted / 80) = z
    assert compare(seen(shifted, focal_baseline_px_m=80.0), z, offset=1.0).upper_inliers == pytest.approx(
        exact.upper_inliers, abs=0.02
    )


def test_a_camera_of_another_focal_length_is_resampled_to_the_same_angles():
    """A camera of twice the focal length sees the middle half of the view, with the same depth at the same angle."""
    narrow = PinholeCamera(112, 56, 80.0, 80.0, 55.5, 27.5)
    image = seen(wall_with_posts(columns=(55,)), camera=narrow)
    measured = np.flatnonzero(image.z_m.any(axis=0))
    assert (measured[0], measured[-1]) == (28, 83)
    posts = np.flatnonzero((image.z_m == 6.0).any(axis=0))
    assert posts.tolist() == [56, 57]


@given(seed=st.integers(0, 2**32 - 1), noise=st.floats(1e-6, 0.1), scale=st.floats(0.5, 2.0), offset=st.floats(-2, 2))
def test_the_numbers_are_finite_and_in_their_ranges(seed, noise, scale, offset):
    rng = np.random.default_rng(seed)
    z, map_m = (
        np.where(rng.random(SHAPE) < 0.7, rng.uniform(0.3, 45.0, SHAPE), 0.0).astype(np.float32) for _ in range(2)
    )
    found = compare(seen(z, noise=noise, focal_baseline_px_m=100.0), map_m, scale=scale, offset=offset)
    assert 0 <= found.shared_edges <= 1
    assert 0 < found.upper_inliers < 1
    assert -1 <= found.contrast <= 1


@pytest.fixture
def measured(frame_with, matches_at):
    """Return one frame that measures 8 m everywhere."""
    frame = frame_with(matches_at([(0, 0, 2)], [0], [0.9]))
    query = replace(frame.query, depth_m=np.full_like(frame.query.depth_m, 8.0))
    return measure((replace(frame, query=query),), PointSettings(), focal_baseline_px_m=80.0, is_rig=False)


@pytest.fixture
def pose(candidate):
    return candidate(xyz=(0.0, 0.0, 1.5)).registered


def test_the_score_is_the_weighted_sum_and_several_frames_are_averaged(street_map, measured, pose):
    weights = StructureWeights(shared_edges=3.0, upper_inliers=2.0, contrast=1.0)
    found = StructureScorer(street_map, measured, weights).score((pose,))
    edges, inliers, contrast = (found.details[name][0] for name in ("shared_edges", "upper_inliers", "contrast"))
    assert inliers != 0.5
    assert found.values[0] == pytest.approx(3 * edges + 2 * inliers + contrast)
    (one,) = measured
    twice = StructureScorer(street_map, (one, replace(one, is_reference=False)), weights).score((pose,))
    assert twice.values[0] == pytest.approx(found.values[0])


def test_a_frame_without_points_does_not_count(street_map, measured, pose):
    (one,) = measured
    empty = replace(one, is_reference=False, points=one.points.subset(np.zeros(0, np.intp)))
    alone = StructureScorer(street_map, (one,), StructureWeights()).score((pose,))
    beside = StructureScorer(street_map, (one, empty), StructureWeights()).score((pose,))
    assert beside.values.tolist() == alone.values.tolist()


@pytest.mark.parametrize(
    ("width", "height", "focal", "centre"), [(48, 64, 51.0, (23.5, 31.5)), (112, 56, 40.0, (10.0, 50.0))]
)
def test_portrait_cameras_and_principal_points_off_centre_keep_the_angles(width, height, focal, centre):
    """A wall whose depth grows with the angle to the right has the same depth at the same angle for every camera."""
    camera = PinholeCamera(width, height, focal, focal, *centre)
    right = (np.arange(width) - centre[0]) / focal
    image = seen(np.broadcast_to(10 + 2 * right, (height, width)), camera=camera)
    expected = 10 + 2 * (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    rows, columns = np.nonzero(image.z_m)
    assert len(rows) > 1000
    np.testing.assert_allclose(image.z_m[rows, columns], expected[columns], atol=2 * 0.51 / focal)
