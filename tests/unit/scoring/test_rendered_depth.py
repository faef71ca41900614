from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_x, rotation_y, rotation_z, transform_from
from service.registration.kernel import BeamModel, consistency
from service.registration.register import Registered
from service.registration.surfel_map import SurfelMap
from service.scoring import rendered_depth as rendered
from service.scoring.rendered_depth import Agreement, agreement, project_points

#: Off the middle, and larger than what is drawn: 4 pixels of it are one of the drawn ones.
CAMERA = PinholeCamera(320, 240, 200.0, 200.0, 139.5, 129.5)
ORIGIN = np.array([100.0, -50.0, 7.0])
AT_ORIGIN = Registered(np.eye(3), ORIGIN, 1.0, 0.0, 0.9, np.eye(8), 0)
WALL = ((10, -30, -30), (0, 60, 0), (0, 0, 60))  # 10 m ahead of the origin


@pytest.fixture(autouse=True)
def counted(monkeypatch):
    """Constants that these tests assume."""
    beam = BeamModel(
        hit=0.6,
        new=0.25,
        removed=0.02,
        outlier=0.05,
        roughness_m=0.15,
        span_m=40.0,
        threshold_sigmas=3.0,
        margin_m=0.25,
        unmapped_m=60.0,
    )
    for name, value in {"_BEAM": beam, "WIDTH": 80, "SURFEL_M": 0.4, "REACH_M": 45.0}.items():
        monkeypatch.setattr(rendered, name, value)


@pytest.fixture(scope="module")
def map_of(scene_of):
    """Return surfels every 0.3 m on rectangles, in one tile. The rectangles are relative to ``ORIGIN``."""

    def made(*rectangles):
        surfels = scene_of(*rectangles).surfels()
        return SurfelMap.prepare(ORIGIN, surfels)

    return made


@pytest.fixture(scope="module")
def wall(map_of):
    return map_of(WALL)


@pytest.fixture(scope="module")
def seeing(points_at):
    """Return points at depth ``z_m`` (one number, or one per point) on the rays (x, y, 1) of a camera."""

    def made(z_m, rays=None, *, sigma=0.1, R_level_camera=R_BODY_OPTICAL, **options):
        if rays is None:
            x, y = np.meshgrid(np.linspace(-0.6, 0.6, 21), np.linspace(-0.5, 0.4, 21))
            rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
        in_camera = np.array(rays, np.float64) * np.broadcast_to(z_m, len(rays))[:, None]
        return points_at(in_camera @ R_level_camera.T, sigma=sigma, **options)

    return made


def agreed(cloud, points, pose=AT_ORIGIN, *, R_level_camera=R_BODY_OPTICAL):
    return agreement(cloud, project_points(points, CAMERA, R_level_camera), pose)


def shares(found):
    return found.through, found.front, found.unmapped


def moved(x, y=0.0, z=0.0, *, R=None):
    return replace(AT_ORIGIN, camera_m=ORIGIN + [x, y, z], R_map_level=np.eye(3) if R is None else R)


def test_a_view_of_the_mapped_wall_is_consistent(wall, seeing):
    """Density of a hit, 0.6 / (sqrt(2 pi) hypot(0.1, 0.15)), and of an outlier, 0.05 / 40; 0.25 / 10 if just in front."""
    points = seeing(10.0, [(0, 0, 1)])
    found = agreed(wall, points)
    assert shares(found) == (0, 0, 0)
    hit = 0.6 / (np.sqrt(2 * np.pi) * np.hypot(0.1, 0.15))
    assert np.log(hit + 0.00125) - 1e-4 <= found.likelihood <= np.log(hit + 0.00125 + 0.025) + 1e-4


@pytest.mark.parametrize(
    ("z_m", "density"),
    [
        (7.0, 0.25 / 10 + 0.05 / 40),
        (13.0, (0.02 + 0.05) / 40),
        (9.8, 0.6 / (np.sqrt(2 * np.pi) * 0.15) * np.exp(-0.5 * (0.2 / 0.15) ** 2) + 0.25 / 10 + 0.05 / 40),
        (10.2, 0.6 / (np.sqrt(2 * np.pi) * 0.15) * np.exp(-0.5 * (0.2 / 0.15) ** 2) + 0.07 / 40),
    ],
)
def test_the_likelihood_by_hand(wall, seeing, z_m, density):
    """Exact points in front of and behind a wall at 10 m with a roughness of 0.15 m."""
    assert agreed(wall, seeing(z_m, sigma=0.0)).likelihood == pytest.approx(np.log(density), abs=1e-3)


def test_the_likelihood_is_the_mean_over_the_points(wall, seeing):
    one, other = agreed(wall, seeing(7.0)).likelihood, agreed(wall, seeing(13.0)).likelihood
    both = agreed(wall, seeing([7.0, 13.0, 13.0, 13.0], [(0, 0, 1), (0.1, 0, 1), (0.1, 0.2, 1), (-0.3, 0.1, 1)]))
    assert both.likelihood == pytest.approx((one + 3 * other) / 4, abs=1e-3)


def test_the_likelihood_is_best_at_the_true_depth_and_falls_to_either_side(wall, seeing):
    offsets = [0.0, 0.1, 0.2, 0.4, 0.8]
    before, behind = ([agreed(wall, seeing(10.0 + sign * d)).likelihood for d in offsets] for sign in (-1, 1))
    assert before == sorted(before, reverse=True)
    assert behind == sorted(behind, reverse=True)
    assert min(before[0], behind[0]) > max(before[1], behind[1])


@given(st.floats(0.3, 5.0))
def test_to_look_through_a_wall_is_less_likely_than_to_see_something_as_far_before_it(wall, seeing, away_m):
    before, behind = (agreed(wall, seeing(10.0 + sign * away_m)) for sign in (-1, 1))
    assert behind.likelihood < before.likelihood


@pytest.mark.parametrize(
    ("z_m", "expected"),
    [(14.0, (1, 0, 0)), (10.6, (1, 0, 0)), (10.5, (0, 0, 0)), (9.5, (0, 0, 0)), (9.4, (0, 1, 0)), (3.0, (0, 1, 0))],
)
def test_points_behind_the_wall_are_seen_through_it_and_points_before_it_stand_in_front(wall, seeing, z_m, expected):
    """Sigma is 0.1 m. The limit is three sigma plus 0.25 m."""
    points = seeing(z_m, [(0, 0, 1)])
    assert shares(agreed(wall, points)) == expected


def test_shares_are_of_the_points(wall, seeing):
    z = [14.0] * 3 + [10.0] * 5 + [5.0] * 2
    rays = [(0.1 * k - 0.4, 0.05 * k - 0.2, 1) for k in range(10)]
    assert shares(agreed(wall, seeing(z, rays))) == pytest.approx((0.3, 0.2, 0))


@pytest.mark.parametrize(("sigma", "through"), [(0.1, 1), (1.2, 1), (1.3, 0)])
def test_a_point_that_is_hardly_known_is_not_held_against_the_wall(wall, seeing, sigma, through):
    """The point is 4 m behind the wall."""
    assert agreed(wall, seeing(14.0, [(0, 0, 1)], sigma=sigma)).through == through


@pytest.mark.parametrize(
    ("z_m", "expected"), [(12.6, (0, 0, 0)), (12.7, (1, 0, 0)), (7.4, (0, 0, 0)), (7.3, (0, 1, 0))]
)
def test_the_uncertainty_along_a_slanted_ray_counts_as_far_as_it_points_ahead(map_of, seeing, z_m, expected):
    """For the ray (3, 0, 4) / 5, sigma 1 m along it is 0.8 m in depth: the limit is 2.65 m, not 3.25 m."""
    wide = map_of(WALL)
    assert shares(agreed(wide, seeing(z_m, [(0.75, 0, 1)], sigma=1.0))) == expected


def test_where_the_map_shows_nothing_points_are_unmapped_and_neither_before_nor_behind(map_of, seeing):
    """One wall is out of reach, one is behind the camera. The distance of the points has no effect."""
    for x in (46, -10):
        nothing = map_of(((x, -30, -30), (0, 60, 0), (0, 0, 60)))
        for z_m in (1.0, 10.0, 59.0, 61.0, 200.0):
            assert shares(agreed(nothing, seeing(z_m))) == (0, 0, 1)
    assert shares(agreed(map_of(((44, -30, -30), (0, 60, 0), (0, 0, 60))), seeing(10.0, [(0, 0, 1)]))) == (0, 1, 0)


@pytest.mark.parametrize(
    ("ray", "unmapped"),
    [((-0.3, 0, 1), 0), ((0.3, 0, 1), 1), ((-0.3, -0.3, 1), 0), ((-0.3, 0.3, 1), 1), ((0.3, -0.3, 1), 1), ((-0.05, -0.05, 1), 0)],
)  # fmt: skip
def test_each_point_is_compared_with_the_wall_where_it_is_seen(map_of, seeing, ray, unmapped):
    """A wall fills the left and upper quarter of the view. Camera: x right, y down. Map: y left, z up."""
    quarter = map_of(((10, 0, 0), (0, 30, 0), (0, 0, 30)))
    assert shares(agreed(quarter, seeing(10.0, [ray]))) == (0, 0, unmapped)


def test_pictures_edges_are_as_good_as_their_middle(wall, seeing):
    """The outermost pixels, and points that rounding moves beyond them."""
    u, v = np.meshgrid([-0.5, 0, 160, 319, 319.5], [-0.5, 0, 120, 239, 239.5])
    rays = np.stack([(u.ravel() - 139.5) / 200, (v.ravel() - 129.5) / 200, np.ones(25)], axis=1)
    assert shares(agreed(wall, seeing(10.0, rays))) == (0, 0, 0)


def test_beside_an_edge_both_depths_agree(map_of, seeing):
    """A pole is 5 m in front of the wall. A pixel beside its edge may show either depth."""
    poled = map_of(WALL, ((5, -0.5, -9), (0, 1, 0), (0, 0, 18)))
    edge = [(side * (0.1 + d), 0.02 * k, 1) for side in (-1, 1) for d in (-0.01, 0.0, 0.01) for k in range(-5, 5)]
    for z_m in (5.0, 10.0):
        assert shares(agreed(poled, seeing(z_m, edge))) == (0, 0, 0)
    middle, beside = [(0, 0, 1)], [(0.3, 0, 1)]
    assert shares(agreed(poled, seeing(10.0, middle))) == (1, 0, 0)
    assert shares(agreed(poled, seeing(5.0, beside))) == (0, 1, 0)


def test_the_depths_scale_is_taken_into_account(wall, seeing):
    points = seeing(10.0 / 1.1)
    assert agreed(wall, points).front == 1
    scaled = agreed(wall, points, replace(AT_ORIGIN, scale=1.1))
    assert shares(scaled) == (0, 0, 0)
    assert scaled.likelihood == pytest.approx(agreed(wall, seeing(10.0)).likelihood, abs=0.02)


def test_the_disparity_offset_is_taken_into_account(wall, seeing):
    """A rig of 80 px m sees the wall at 8 px. A reading of 10 px is 8 m, with an offset of 2 px."""
    points = seeing(8.0, focal_baseline_px_m=80.0)
    assert agreed(wall, points).front == 1
    corrected = agreed(wall, points, replace(AT_ORIGIN, offset=-2.0))
    assert shares(corrected) == (0, 0, 0)
    assert corrected.likelihood == pytest.approx(agreed(wall, seeing(10.0)).likelihood, abs=0.02)
    assert agreed(wall, points, replace(AT_ORIGIN, offset=2.0)).front == 1
    without_rig = seeing(8.0)
    assert agreed(wall, without_rig, replace(AT_ORIGIN, offset=-2.0)) == agreed(wall, without_rig)


def test_scale_and_offset_correct_together(wall, seeing):
    """8 m are 10 px. With the offset they are 8.8 px, or 9.0909 m. Times 1.1 that is 10 m."""
    found = agreed(wall, seeing(8.0, focal_baseline_px_m=80.0), replace(AT_ORIGIN, scale=1.1, offset=-1.2))
    assert found.likelihood == pytest.approx(agreed(wall, seeing(10.0)).likelihood, abs=0.02)


@pytest.mark.parametrize(
    ("pose", "expected"), [(moved(1.0), (1, 0, 0)), (moved(-1.0), (0, 1, 0)), (moved(0, 3.0, -2.0), (0, 0, 0))]
)
def test_the_map_is_drawn_where_the_candidate_stands(wall, seeing, pose, expected):
    """A metre too far ahead, the wall is rendered at 9 m and the points are behind it. Lateral shifts change nothing."""
    assert shares(agreed(wall, seeing(10.0), pose)) == expected


def test_a_candidate_that_looks_away_sees_nothing_of_the_wall(wall, seeing):
    assert shares(agreed(wall, seeing(10.0), moved(0, R=rotation_z(np.pi)))) == (0, 0, 1)


turn = st.floats(-0.35, 0.35)


@given(yaw=turn, pitch=st.floats(-0.2, 0.2), roll=st.floats(-0.2, 0.2), x=st.floats(-2, 2), y=st.floats(-2, 2))
def test_a_tilted_and_rotated_camera_agrees_with_its_true_depth(wall, scene_of, points_at, yaw, pitch, roll, x, y):
    """Depths of an exact image at every 8th pixel. Level frame and camera are tilted against each other."""
    R_level_camera = rotation_y(pitch) @ rotation_x(roll) @ R_BODY_OPTICAL
    pose = moved(x, y, R=rotation_z(yaw))
    T = transform_from(pose.R_map_level @ R_level_camera, pose.camera_m - ORIGIN)
    z = scene_of(WALL).depth(CAMERA, T)[4::8, 4::8]
    in_camera = (CAMERA.rays_of_pixels()[4::8, 4::8] * z[..., None])[z > 0]
    found = agreed(wall, points_at(in_camera @ R_level_camera.T, sigma=0.1), pose, R_level_camera=R_level_camera)
    assert shares(found) == (0, 0, 0)
    assert found.likelihood > 0


@pytest.mark.parametrize(
    ("ray", "column", "row"),
    [
        ((0.006, 0, 1), 35, 32),
        ((0.204, -0.1, 1), 45, 27),
        ((0.196, -0.106, 1), 44, 27),
        ((-0.296, 0.4, 1), 20, 52),
        ((3.0, 0, 1), 79, 32),  # beyond the edge: the last that there is
        ((-3.0, 0, 1), 0, 32),
        ((0.006, 3.0, 1), 35, 59),
        ((0.006, -3.0, 1), 35, 0),
    ],
)
@pytest.mark.parametrize("z_m", [0.7, 20.0])
def test_a_point_lies_in_the_pixel_of_the_small_image_that_its_ray_intersects(seeing, ray, column, row, z_m):
    """Focal length 50 px, centre (34.5, 32), at any depth."""
    seen = project_points(seeing(z_m, [ray]), CAMERA, R_BODY_OPTICAL)
    assert (seen.camera.width, seen.camera.height, seen.camera.cx, seen.camera.cy) == (80, 60, 34.5, 32.0)
    assert seen.pixel.tolist() == [row * 80 + column]


def test_depth_and_sigma_are_along_the_optical_axis_and_depth_is_as_measured(seeing):
    """For the ray (3, 0, 4) / 5, 1 m along it is 0.8 m in depth."""
    leaning = rotation_z(0.4) @ rotation_y(0.3) @ R_BODY_OPTICAL
    points = seeing([8.0, 4.0], [(0.75, 0, 1), (0, 0, 1)], sigma=1.0, R_level_camera=leaning, focal_baseline_px_m=80.0)
    seen = project_points(points, CAMERA, leaning)
    assert seen.z.tolist() == pytest.approx([8.0, 4.0], rel=1e-5)
    assert seen.sigma.tolist() == pytest.approx([0.8, 1.0], rel=1e-5)
    np.testing.assert_array_equal(seen.q, points.q)
    np.testing.assert_array_equal(seen.R_level_camera, leaning)
    assert len(seen) == 2


def test_a_query_that_was_prepared_once_serves_every_candidate(wall, seeing):
    """The second pose gets the same result as alone. It has another scale and offset than the first."""
    points = seeing([8.0, 9.0, 10.0], [(0, 0, 1), (0.1, 0, 1), (0.2, 0.1, 1)], focal_baseline_px_m=80.0)
    once = project_points(points, CAMERA, R_BODY_OPTICAL)
    poses = [AT_ORIGIN, replace(AT_ORIGIN, scale=1.1, offset=-1.2), moved(1.0), moved(0, R=rotation_z(0.3)), AT_ORIGIN]
    found = [agreement(wall, once, pose) for pose in poses]
    assert found == [agreed(wall, points, pose) for pose in poses]
    assert found[0] == found[-1]
    assert len({each.likelihood for each in found}) == 4


def test_the_mean_of_several_pictures():
    mean = Agreement.mean([Agreement(-1.0, 0.1, 0.2, 0.3), Agreement(-3.0, 0.3, 0.4, 0.9)])
    assert (mean.likelihood, mean.through, mean.front, mean.unmapped) == pytest.approx((-2.0, 0.2, 0.3, 0.6))


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), shape=st.sampled_from([(60, 80), (1, 1), (1, 9), (7, 2)]), empty=st.floats(0, 1))
def test_the_compiled_consistency_equals_numpy(seed, shape, empty):
    rng = np.random.default_rng(seed)
    model = BeamModel(
        hit=0.5,
        new=0.3,
        removed=0.05,
        outlier=0.1,
        roughness_m=0.2,
        span_m=30.0,
        threshold_sigmas=2.0,
        margin_m=0.3,
        unmapped_m=60.0,
    )
    drawn = rng.uniform(1, 45, shape).astype(np.float32) * (rng.random(shape) >= empty)
    row, column = rng.integers(0, shape[0], 50), rng.integers(0, shape[1], 50)
    z, sigma, q = rng.uniform(1, 50, 50), rng.uniform(0.01, 1, 50), rng.uniform(0, 0.5, 50).astype(np.float32)
    found = consistency(drawn, (row * shape[1] + column).astype(np.int32), z, sigma, q, model, scale=1.01, offset=0.2)

    depth = np.pad(np.where(drawn > 0, drawn, 60.0), 1, mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(depth, (3, 3))[row, column].reshape(50, 9)
    low, mapped, high = around.min(axis=1), around[:, 4], around.max(axis=1)
    z = z * 1.01 / (1 + 0.2 * q)
    spread, off = np.hypot(sigma, 0.2), 2.0 * sigma + 0.3
    hit = np.exp(-0.5 * ((z - mapped) / spread) ** 2) / (np.sqrt(2 * np.pi) * spread)
    density = 0.5 * hit + 0.3 * (z < mapped) / np.maximum(mapped, 2.0) + (0.05 * (z > mapped) + 0.1) / 30.0
    off_map = low >= 60.0
    expected = [
        np.log(density).mean(),
        (~off_map & (z > high + off)).mean(),
        (~off_map & (z < low - off)).mean(),
        off_map.mean(),
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("pixel", [[], [-1], [6], [0, 1]])
def test_points_that_do_not_lie_on_the_picture_are_refused(pixel):
    model = BeamModel(
        hit=0.5,
        new=0.3,
        removed=0.05,
        outlier=0.1,
        roughness_m=0.2,
        span_m=30.0,
        threshold_sigmas=2.0,
        margin_m=0.3,
        unmapped_m=60.0,
    )
    one = np.ones(1)
    with pytest.raises((ValueError, TypeCheckError)):  # whichever looks first
        consistency(
            np.ones((2, 3), np.float32),
            np.array(pixel, np.int32),
            one,
            one,
            one.astype(np.float32),
            model,
            scale=1.0,
            offset=0.0,
        )
