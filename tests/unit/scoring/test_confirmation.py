from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.rigid import rotation_z
from service.registration.points import DepthBlocks, PointSettings
from service.scoring.confirmation import confirm, confirmation_of, forward
from service.scoring.measured import measure
from service.scoring.structure import CAMERA, StructureScorer, StructureWeights, rendered, structure_image

SHAPE = (CAMERA.height, CAMERA.width)
#: Rotation from the optical frame to a level frame whose x axis is the optical axis.
R_LEVEL_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def seen(z_m, *, noise=1e-3, focal_baseline_px_m=None):
    """Prepare a depth image that the small camera took itself, 1.5 m above the ground."""
    blocks = DepthBlocks(np.asarray(z_m, np.float32), CAMERA, (1.0, 1.0))
    return structure_image(blocks, R_LEVEL_CAMERA, 1.5, noise=noise, focal_baseline_px_m=focal_baseline_px_m)


def wall(z_m=10.0, *, posts=(), post_m=6.0):
    """A wall with posts that are four pixels wide."""
    z = np.full(SHAPE, z_m, np.float32)
    for column in posts:
        z[:, column : column + 4] = post_m
    return z


def confirmed(z_m, here, ahead, behind):
    """Return the numbers of a depth image, for what the map shows at the pose, ahead of it and behind it."""
    return confirmation_of(seen(z_m), here, (ahead, behind))


def test_a_right_pose_among_posts_fits_worse_two_metres_further():
    """Ahead the posts are wider apart in the image, and the wall is nearer: all pixels are off by more than three sigma."""
    here = wall(posts=(20, 50, 85))
    found = confirmed(here, here, wall(8.0, posts=(10, 48, 95), post_m=4.0), wall(12.0, posts=(27, 52, 78), post_m=8.0))
    assert found.upper_front == 0.0
    assert found.along_residual == pytest.approx(1.0 / 0.05)
    assert found.along_edges == pytest.approx(672 / 682)  # 2 edges of 3 posts in 56 rows, none of them shared elsewhere
    assert found.contrast > 0


def test_a_wall_that_looks_alike_further_on_gives_no_confirmation():
    here = wall()
    found = confirmed(here, here, here, here)
    assert (found.along_residual, found.along_edges, found.contrast) == (0.0, 0.0, pytest.approx(0.0, abs=1e-6))


def test_the_better_of_both_neighbours_counts():
    here, other = wall(posts=(20, 50)), wall(20.0)
    expected = confirmed(here, here, here, here)
    for ahead, behind in ((here, other), (other, here)):
        assert confirmed(here, here, ahead, behind) == expected
    assert confirmed(here, here, other, other).along_edges > 0


def test_objects_in_front_count_above_vehicles_only():
    """A tenth of the columns sees something at 5 m. There, rows 0 to 23 are more than 2 m above the ground."""
    z, map_m = wall(), wall()
    z[:, :12] = 5.0
    all_rows = confirmed(z, map_m, map_m, map_m)
    upper = 100 * 26 + 12 * 24
    assert all_rows.upper_front == pytest.approx(12 * 24 / (upper + 20))
    low = wall()
    low[26:, :12] = 5.0
    assert confirmed(low, map_m, map_m, map_m).upper_front == 0.0
    behind = wall()
    behind[:, :12] = 20.0
    assert confirmed(behind, map_m, map_m, map_m).upper_front == 0.0


@given(seed=st.integers(0, 2**32 - 1), noise=st.floats(1e-6, 0.1), scale=st.floats(0.5, 2.0), offset=st.floats(-2, 2))
def test_the_numbers_are_finite_and_in_their_ranges(seed, noise, scale, offset):
    rng = np.random.default_rng(seed)
    z, *shown = (
        np.where(rng.random(SHAPE) < rng.random(), rng.uniform(0.3, 45.0, SHAPE), 0.0).astype(np.float32)
        for _ in range(4)
    )
    image = seen(z, noise=noise, focal_baseline_px_m=100.0)
    found = confirmation_of(image, shown[0], tuple(shown[1:]), scale=scale, offset=offset)
    assert 0 <= found.upper_front < 1
    assert -1 <= found.contrast <= 1
    assert 0 <= found.along_residual <= 20
    assert -1 <= found.along_edges <= 1


@pytest.mark.parametrize("degrees", [-170, -45, 0, 30, 90])
def test_forward_is_where_the_camera_looks(degrees):
    R = rotation_z(np.deg2rad(degrees)) @ R_LEVEL_CAMERA
    assert forward(R) == pytest.approx([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees)), 0.0])


def test_forward_of_a_tilted_camera_is_horizontal_and_a_camera_that_looks_down_has_one():
    tilt = np.deg2rad(50.0)
    pitch = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    assert forward(pitch @ R_LEVEL_CAMERA) == pytest.approx([1.0, 0.0, 0.0])
    assert forward(np.diag([1.0, -1.0, -1.0])).tolist() == [1.0, 0.0, 0.0]


@pytest.fixture
def measured(frame_with, matches_at):
    """Return one frame that measures 8 m everywhere."""
    frame = frame_with(matches_at([(0, 0, 2)], [0], [0.9]))
    query = replace(frame.query, depth_m=np.full_like(frame.query.depth_m, 8.0))
    return measure((replace(frame, query=query),), PointSettings(), focal_baseline_px_m=80.0, is_rig=False)


def test_the_map_is_rendered_at_the_pose_and_two_metres_ahead_and_behind(street_map, measured, candidate):
    pose = candidate(xyz=(0.0, 0.0, 1.5), heading_deg=20.0).registered
    scorer = StructureScorer(street_map, measured, StructureWeights())
    R = pose.R_map_level @ measured[0].frame.R_level_camera
    step = 2.0 * np.array([np.cos(np.deg2rad(20.0)), np.sin(np.deg2rad(20.0)), 0.0])
    here, ahead, behind = (rendered(street_map, R, pose.camera_m + sign * step) for sign in (0, 1, -1))
    assert not np.array_equal(here, ahead)
    expected = confirmation_of(scorer.images[0], here, (ahead, behind))
    assert astuple(confirm(street_map, scorer, pose)) == pytest.approx(astuple(expected), abs=1e-4)


def test_frames_with_points_are_averaged(street_map, measured, candidate):
    (one,) = measured
    pose = candidate(xyz=(0.0, 0.0, 1.5)).registered
    empty = replace(one, is_reference=False, points=one.points.subset(np.zeros(0, np.intp)))
    expected = confirm(street_map, StructureScorer(street_map, measured, StructureWeights()), pose)
    for frames in ((one, replace(one, is_reference=False)), (one, empty)):
        found = confirm(street_map, StructureScorer(street_map, frames, StructureWeights()), pose)
        assert astuple(found) == pytest.approx(astuple(expected))
