from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_y
from service.registration.points import (
    LEAST_NOISE,
    PointSettings,
    below,
    blocks_of,
    inverse_depth_noise,
    points_of,
)

ALL = PointSettings(columns=80, points=100_000, ground_share=0.5)
HIGH_M = 100.0  # so high that no point is of the ground or of a vehicle


def camera_of(width, height):
    return PinholeCamera(width, height, 0.6 * width, 0.6 * width, (width - 1) / 2, (height - 1) / 2)


def points_in(depth, settings=ALL, *, height_m=HIGH_M, R=R_BODY_OPTICAL, camera=None, **options):
    camera = camera_of(*depth.shape[::-1]) if camera is None else camera
    return points_of(depth.astype(np.float32), camera, R, height_m, settings, **options)


def tilted_plane(width, height, *, noise=0.0, seed=0):
    """Return inverse depth that is linear in the pixel, about 0.1 1/m, with noise."""
    v, u = np.mgrid[:height, :width]
    inverse = 0.1 + 0.03 * u / width - 0.02 * v / height
    return (1 / (inverse + np.random.default_rng(seed).normal(0, noise, inverse.shape))).astype(np.float32)


def depths_of(points):
    return points.xyz @ R_BODY_OPTICAL[:, 2].astype(np.float32)


@pytest.mark.parametrize("noise", [1e-4, 5e-4, 3e-3])
def test_the_noise_of_the_inverse_depth_is_read_off_a_plane(noise):
    assert inverse_depth_noise(tilted_plane(320, 240, noise=noise)).total == pytest.approx(noise, rel=0.05)


@pytest.mark.parametrize(
    "depth",
    [
        tilted_plane(320, 240),
        np.full((240, 320), 3.0, np.float32),  # a constant wall: every difference is 0
        (np.round(1000 / np.linspace(0.999, 1.001, 320)).astype(np.float32) * np.ones((240, 1), np.float32))
        / np.float32(1000),
    ],
)
def test_no_picture_is_free_of_noise(depth):
    assert inverse_depth_noise(depth).total == LEAST_NOISE


def test_the_least_noise_is_lost_in_the_least_deviation_of_a_point():
    """So the bound changes no point: at the largest depth it is a twelfth of the least sigma."""
    settings = PointSettings()
    assert LEAST_NOISE * settings.reach_m**2 < 0.1 * settings.floor_m


def test_holes_and_edges_do_not_change_the_noise():
    depth = tilted_plane(320, 240, noise=1e-3)
    depth[:, 100:140] *= 0.5
    depth[np.random.default_rng(1).uniform(size=depth.shape) < 0.2] = 0
    # Between pixels 8 apart, a tenth of the differences cross one of the two edges.
    assert inverse_depth_noise(depth).total == pytest.approx(1e-3, rel=0.2)


def test_with_too_few_pixels_the_noise_is_a_quarter_of_a_pixel():
    depth = np.zeros((240, 320), np.float32)
    depth[:8, :20] = tilted_plane(20, 8, noise=1e-3)
    assert inverse_depth_noise(depth).total == 0.25 / 80


def test_every_block_gives_the_point_in_its_middle():
    """A wall 10 m ahead, 8 x 6 px in blocks of 2. The centre of the first block is the pixel (0.5, 0.5)."""
    camera = PinholeCamera(8, 6, 5.0, 5.0, 3.5, 2.5)
    found = points_in(np.full((6, 8), 10.0), PointSettings(columns=4), camera=camera, focal_baseline_px_m=50.0)
    assert len(found) == 12
    expected = [[10, 10 * (3.5 - u) / 5, 10 * (2.5 - v) / 5] for v in (0.5, 2.5, 4.5) for u in (0.5, 2.5, 4.5, 6.5)]
    np.testing.assert_allclose(found.xyz, expected, rtol=1e-6)
    np.testing.assert_allclose(found.ray * np.linalg.norm(found.xyz, axis=1)[:, None], found.xyz, rtol=1e-5)
    np.testing.assert_allclose(found.q, 0.2, rtol=1e-6)


def test_points_stand_in_the_level_frame():
    """The camera looks 10 degrees down at a wall perpendicular to its axis. The image centre is 10 m along the axis."""
    R = rotation_y(np.deg2rad(10)) @ R_BODY_OPTICAL
    found = points_in(np.full((5, 5), 10.0), camera=PinholeCamera(5, 5, 3.0, 3.0, 2.0, 2.0), R=R)
    middle = found.xyz[12]
    np.testing.assert_allclose(middle, [10 * np.cos(np.deg2rad(10)), 0, -10 * np.sin(np.deg2rad(10))], atol=1e-5)


@pytest.mark.parametrize("columns", [80, 40, 20])
def test_a_wall_square_to_the_axis_stays_flat_in_blocks_of_any_size(columns):
    found = points_in(np.full((60, 80), 7.0), PointSettings(columns=columns))
    np.testing.assert_allclose(depths_of(found), 7.0, rtol=1e-6)


@pytest.mark.parametrize("width", [80, 160, 320, 640, 1280])
def test_points_of_a_facade_along_the_road_lie_on_it_at_any_resolution(width):
    camera = camera_of(width, width * 3 // 4)
    rays = camera.rays_of_pixels()
    facade = np.where(rays[..., 0] > 0.1, 4 / np.maximum(rays[..., 0], 0.1), 0)  # 4 m to the right
    found = points_in(facade, camera=camera)
    assert len(found) > 500
    assert np.abs(found.xyz[:, 1] + 4).max() < 0.01


def test_no_range_is_known_better_than_the_floor():
    np.testing.assert_allclose(points_in(np.full((60, 80), 8.0)).sigma, ALL.floor_m, rtol=1e-3)


def test_the_uncertainty_grows_with_the_square_of_the_depth():
    depth = np.where(np.arange(320) < 160, 10.0, 20.0) * np.ones((240, 1))
    depth = 1 / (1 / depth + np.random.default_rng(3).normal(0, 5e-4, depth.shape))
    found = points_in(depth, replace(ALL, columns=320))
    per_ray = np.sqrt(found.sigma**2 - ALL.floor_m**2) * depths_of(found) / np.linalg.norm(found.xyz, axis=1)
    near = depths_of(found) < 15
    at_10, at_20 = np.median(per_ray[near]), np.median(per_ray[~near])
    assert at_20 == pytest.approx(4 * at_10, rel=0.05)
    assert at_10 == pytest.approx(10**2 * 5e-4, rel=0.1)


def test_a_slanted_ray_is_as_uncertain_as_it_is_long():
    depth = 1 / (0.1 + np.random.default_rng(4).normal(0, 1e-3, (60, 80)))
    found = points_in(depth, replace(ALL, floor_m=0.0))
    length = np.linalg.norm(found.xyz, axis=1)
    np.testing.assert_allclose(found.sigma / (length * depths_of(found)), 1e-3, rtol=0.1)


def test_blocks_on_an_edge_are_left_out():
    """160 x 120 px in blocks of 4. The depth jumps within the 20th column of blocks."""
    found = points_in(np.where(np.arange(160) < 78, 5.0, 10.0) * np.ones((120, 1)), PointSettings(columns=40))
    assert len(found) == 39 * 30
    assert set(np.round(depths_of(found), 4).tolist()) == {5.0, 10.0}


def test_a_block_needs_half_of_its_pixels():
    depth = np.full((120, 160), 5.0)
    depth[0:2, 0:4] = 0  # 8 of 16 are left
    depth[0:2, 4:8] = depth[3, 4] = 0  # 7 of 16
    found = points_in(depth, PointSettings(columns=40))
    assert len(found) == 40 * 30 - 1
    np.testing.assert_allclose(depths_of(found), 5.0, rtol=1e-6)


def test_an_empty_picture_gives_no_points():
    assert len(points_in(np.zeros((60, 80)))) == 0


@pytest.mark.parametrize(("depth_m", "count"), [(39.9, 4800), (40.1, 0)])
def test_points_beyond_reach_are_left_out(depth_m, count):
    assert len(points_in(np.full((60, 80), depth_m))) == count


def over_a_road(height_m=1.5, wall_m=20.0):
    """Return a wall across the road."""
    down = np.maximum(camera_of(80, 60).rays_of_pixels()[..., 1], 1e-6)
    return np.minimum(height_m / down, wall_m)


def test_the_ground_has_its_share_of_the_points_at_most():
    settings = PointSettings(points=400, ground_share=0.25)
    found = points_in(over_a_road(), settings, height_m=1.5)
    ground = found.xyz[:, 2] + 1.5 < 0.3
    assert len(found) == 400
    assert ground.sum() == 100


def test_with_little_else_the_ground_has_fifty_points():
    depth = over_a_road(wall_m=1000.0)
    depth[:3] = 10.0
    found = points_in(depth, PointSettings(points=1500), height_m=1.5)
    ground = found.xyz[:, 2] + 1.5 < 0.3
    assert (~ground).sum() == 3 * 80
    assert ground.sum() == 3 * 80 / 3
    depth[:3] = 1000.0
    assert len(points_in(depth, PointSettings(points=1500), height_m=1.5)) == 50


def test_the_points_are_spread_over_the_whole_picture():
    found = points_in(np.full((60, 80), 10.0), PointSettings(points=100))
    assert len(found) == 100
    corners = 10 * np.array([39.5, 29.5]) / 48
    assert (found.xyz[:, 1:].max(axis=0) > 0.9 * corners).all()
    assert (found.xyz[:, 1:].min(axis=0) < -0.9 * corners).all()


@given(
    seed=st.integers(0, 10**6),
    most=st.integers(1, 3000),
    ground_share=st.floats(0, 0.95),
    height_m=st.floats(0.5, 3),
    known=st.floats(0, 1),
)
@settings(max_examples=40)
def test_there_are_never_more_points_than_wanted_and_no_duplicates(seed, most, ground_share, height_m, known):
    rng = np.random.default_rng(seed)
    depth = np.where(rng.uniform(size=(60, 80)) < known, over_a_road(height_m, rng.uniform(2, 50)), 0)
    found = points_in(depth, PointSettings(points=most, ground_share=ground_share), height_m=height_m)
    assert len(found) <= most
    assert len(np.unique(found.ray, axis=0)) == len(found)


def test_movable_points_have_less_weight():
    """Points of the wall between 0.3 and 2 m above the ground have less weight. Ground and higher points have full weight."""
    found = points_in(over_a_road(wall_m=8.0), height_m=1.5)
    above_m = found.xyz[:, 2] + 1.5
    movable = (above_m > 0.3) & (above_m < 2.0)
    assert min(movable.sum(), (above_m > 2).sum(), (above_m < 0.3).sum()) > 50
    np.testing.assert_allclose(found.weight, np.where(movable, 0.1, 1.0), rtol=1e-6)


@pytest.mark.parametrize("factor", [2, 4])
def test_depth_of_another_size_and_the_same_aspect_gives_the_same_points(factor):
    small = np.where(np.arange(80) < 33, 5.0, 12.0) * np.ones((60, 1))
    large = small.repeat(factor, axis=0).repeat(factor, axis=1)
    expected = points_in(small, camera=camera_of(80, 60), height_m=1.5)
    for depth, camera in (
        (large, camera_of(80, 60)),
        (large, camera_of(80 * factor, 60 * factor)),
        (small, camera_of(80 * factor, 60 * factor)),
    ):
        found = points_in(depth, camera=camera.scaled_to(camera.width, camera.height), height_m=1.5)
        for name in ("xyz", "ray", "sigma", "weight", "q"):
            np.testing.assert_allclose(
                getattr(found, name), getattr(expected, name), atol=2e-2 if name == "xyz" else 2e-3
            )


def test_the_noise_may_be_given_and_is_then_not_read_off_the_picture():
    """An exact wall 10 m ahead with a given noise: 10^2 * 1e-3 m along the central ray."""
    depth = np.full((60, 80), 10.0)
    found = points_in(depth, replace(ALL, floor_m=0.0), noise=1e-3)
    straight = np.argmax(found.ray @ R_BODY_OPTICAL[:, 2])
    assert found.sigma[straight] == pytest.approx(0.1, rel=1e-3)
    assert points_in(depth, replace(ALL, floor_m=0.0)).sigma.max() < 1e-3


def plain_blocks(depth_m, wanted, noise):
    """Return the depth of each block computed in NumPy, 0 for none."""
    height, width = depth_m.shape
    size = max(1, width // wanted.columns)
    rows, columns, skip = height // size, width // size, max(1, size // 4)
    found = np.zeros(rows * columns, np.float32)
    for at in range(rows * columns):
        v, u = at // columns * size, at % columns * size
        block = depth_m[v : v + size : skip, u : u + size : skip].ravel()
        inverse = np.sort(1 / block[block > 0])
        if len(inverse) >= max(1, (len(block) + 1) // 2):
            low, high = inverse[int(0.1 * (len(inverse) - 1))], inverse[int(0.9 * (len(inverse) - 1))]
            middle = (inverse[(len(inverse) - 1) // 2] + inverse[len(inverse) // 2]) / 2
            if high - low - 2.56 * noise < wanted.edge * middle and 1 / middle < wanted.reach_m:
                found[at] = 1 / middle
    return found


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    holes=st.floats(0, 1),
    spread=st.floats(0, 0.2),
    columns=st.sampled_from([10, 13, 22, 46, 70, 999]),
)
def test_the_compiled_blocks_are_those_of_plain_numpy(seed, holes, spread, columns):
    rng = np.random.default_rng(seed)
    depth_m = (rng.uniform(1, 45, (61, 1)) * rng.normal(1, spread, (61, 160)).clip(0.1)).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < holes] = rng.choice([0.0, np.nan, -3.0])
    wanted = replace(ALL, columns=columns)
    expected = plain_blocks(depth_m, wanted, 1e-4)
    found = np.sort(depths_of(points_in(depth_m, wanted, noise=1e-4)))
    np.testing.assert_allclose(found, np.sort(expected[expected > 0]), rtol=1e-5)


def test_noise_is_read_as_plain_numpy_reads_it():
    rng = np.random.default_rng(4)
    depth_m = (1 / (0.1 + rng.normal(0, 0.002, (50, 70)))).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < 0.2] = 0
    with np.errstate(divide="ignore"):
        inverse = np.where(depth_m > 0, 1 / depth_m, np.nan)[::8]
    each = [np.abs(inverse[:, : -2 * k] - 2 * inverse[:, k:-k] + inverse[:, 2 * k :]) for k in (2, 8)]
    expected = max(1.4826 * np.nanmedian(second) / np.sqrt(6) for second in each)
    assert inverse_depth_noise(depth_m).total == pytest.approx(expected, rel=1e-5)


def test_errors_that_neighbours_share_count_as_noise():
    """Matching smooths over its window. Pixels 8 apart show the error that pixels 2 apart share."""
    rng, size = np.random.default_rng(5), 9
    own = rng.normal(0, 1, (240, 320 + size - 1))
    shared = 2e-3 * np.apply_along_axis(np.convolve, 1, own, np.full(size, size**-0.5), mode="valid")
    inverse = 1 / tilted_plane(320, 240) + shared
    found = inverse_depth_noise((1 / inverse).astype(np.float32))
    assert found.total == pytest.approx(2e-3, rel=0.1)
    assert found.independent < 0.6 * found.total


def test_a_stereo_rigs_noise_is_that_of_matching_at_least():
    """Half a pixel at 80 px m is 1 / 160 in inverse depth. Independent errors add in quadrature."""
    floor = 0.5 / 80
    assert inverse_depth_noise(tilted_plane(320, 240), focal_baseline_px_m=80.0).total == pytest.approx(floor, rel=1e-5)
    noisy = tilted_plane(320, 240, noise=floor)
    assert inverse_depth_noise(noisy, focal_baseline_px_m=80.0).total == pytest.approx(floor * 2**0.5, rel=0.05)


def test_depth_above_a_height_is_omitted():
    """A wall 10 m ahead, from a camera at 1.5 m with f = 48 px: a row 9.6 px above the middle shows 3.5 m above the ground."""
    camera, settings = camera_of(80, 60), PointSettings(columns=80)
    blocks = blocks_of(np.full((60, 80), 10.0, np.float32), camera, settings, noise=1e-4)
    limited = below(blocks, R_BODY_OPTICAL, 1.5, 3.5)
    row = np.arange(60)
    above_m = 1.5 - 10.0 * (row - camera.cy) / camera.fy
    assert np.array_equal(limited.z_m[:, 40] > 0, above_m <= 3.5)
    assert (limited.z_m[limited.z_m > 0] == 10.0).all()
    assert limited.z_m.dtype == np.float32
    assert (blocks.z_m == 10.0).all()


@settings(max_examples=30, deadline=None)
@given(st.floats(0.2, 4.0), st.floats(0.0, 20.0), st.floats(-0.3, 0.3))
def test_a_limit_keeps_exactly_the_points_below_it(height_m, highest_m, pitch_rad):
    R = rotation_y(pitch_rad) @ R_BODY_OPTICAL
    depth = tilted_plane(80, 60)
    blocks = blocks_of(depth, camera_of(80, 60), ALL, noise=1e-4)
    limited = below(blocks, R, height_m, highest_m)
    kept = points_in(limited.z_m, height_m=height_m, R=R)
    assert (kept.xyz[:, 2] + height_m <= highest_m + 1e-3).all()
    assert ((limited.z_m == blocks.z_m) | (limited.z_m == 0)).all()
