import numpy as np
import pytest

from benchmarks.ground import at_a_kerb, on_a_ramp, without_ground
from benchmarks.plans import ground_plan, height_plan
from service.geometry.camera import PinholeCamera
from service.retrieval.query import Query

CAMERA = PinholeCamera(160, 120, 80.0, 80.0, 79.5, 59.5)
HEIGHT_M, WALL_M = 1.5, 12.0


@pytest.fixture
def query():
    """A level camera 1.5 m above a plane, 12 m in front of a wall."""
    rays = CAMERA.rays_of_pixels()
    with np.errstate(divide="ignore"):
        ground = np.where(rays[..., 1] > 0, HEIGHT_M / rays[..., 1], np.inf)
    depth = np.minimum(ground, WALL_M).astype(np.float32)
    return Query(rgb=np.zeros((120, 160, 3), np.uint8), depth_m=depth, camera=CAMERA)


def points_of(query):
    """Return the points: to the right, down, ahead, metres."""
    return query.depth_m[..., None] * CAMERA.rays_of_pixels()


def test_at_a_kerb_the_road_on_the_left_is_lower(query):
    right, down, ahead = np.moveaxis(points_of(at_a_kerb(query)), -1, 0)
    was_ground = query.depth_m < WALL_M - 0.5
    left = was_ground & (points_of(query)[..., 0] < -0.9) & (ahead < 8)
    other = was_ground & (points_of(query)[..., 0] > -0.7)
    np.testing.assert_allclose(down[left], 1.65, atol=0.03)
    np.testing.assert_allclose(down[other], 1.5, atol=1e-4)
    assert left.sum() > 500
    np.testing.assert_array_equal(at_a_kerb(query).depth_m[:40], query.depth_m[:40])  # the wall
    assert right[left].max() < 0


def test_without_ground_only_what_stands_on_it_is_measured(query):
    changed = without_ground(query)
    kept = changed.depth_m > 0
    np.testing.assert_allclose(changed.depth_m[kept], WALL_M)
    down = points_of(query)[..., 1]
    assert kept[down < 1.15].all()
    assert not kept[down > 1.25].any()


def test_on_a_ramp_the_near_ground_is_the_plane_of_the_wheels(query):
    """A camera that looks up sees level ground farther below. The ramp hides it up to 6 m and fills holes there."""
    query.depth_m[110:, :20] = 0
    changed = on_a_ramp(query, height_m=1.2)
    _, down, ahead = np.moveaxis(points_of(changed), -1, 0)
    rows = CAMERA.rays_of_pixels()[..., 1]
    near = rows > 1.2 / 6
    np.testing.assert_allclose(down[near], 1.2, atol=1e-4)
    assert ahead[near].max() <= 6.001
    np.testing.assert_array_equal(changed.depth_m[~near], query.depth_m[~near])


def test_the_queries_lie_in_the_city_of_the_map():
    plan, city = ground_plan(), height_plan(1.5)
    assert (plan.seed, plan.size_m, plan.camera_height_m) == (city.seed, city.size_m, city.camera_height_m)
    assert [query.pitch_deg for query in plan.queries] == [0.0, -8.0, 20.0]
    assert not {query.traversal for query in plan.queries} & {query.traversal for query in city.queries}
