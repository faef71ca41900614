from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, transform_from
from service.registration.kernel import SURFEL
from service.registration.surfel_map import TILE_M, SurfelMap
from service.registration.visibility import KEPT, NEAR_M, NEAR_RAD, DiscSettings, SurfelRaycaster

CAMERA = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)
ORIGIN = np.array([500.0, -300.0, 40.0])
SETTINGS = DiscSettings(radius_m=0.25)


def wall(x, *, y=(-20, 20), z=(-20, 20), step=0.2, normal=(1, 0, 0)):
    ys, zs = (np.arange(low + step / 2, high, step) for low, high in (y, z))
    grid = np.stack(np.meshgrid([float(x)], ys, zs, indexing="ij"), axis=-1).reshape(-1, 3)
    surfels = np.zeros(len(grid), SURFEL)
    surfels["xyz"], surfels["normal"] = grid, normal
    return surfels


def cloud_of(*parts):
    """By tiles, as a map is."""
    surfels = np.concatenate(parts)
    tile = np.floor(surfels["xyz"][:, :2].astype(float) / TILE_M).astype(int)
    order = np.lexsort((tile[:, 1], tile[:, 0]))
    corners, first, count = np.unique(tile[order], axis=0, return_index=True, return_counts=True)
    return SurfelMap.prepare(ORIGIN, surfels[order], np.c_[(corners + 0.5) * TILE_M, first, count])


def looking_ahead(x=0.0, y=0.0, z=0.0):
    return transform_from(R_BODY_OPTICAL, np.array([x, y, z]))


def meet(cloud, T_map_camera, camera, of=SETTINGS):
    return SurfelRaycaster(cloud, of).meet(T_map_camera, camera)


def test_every_ray_meets_the_surfel_nearest_to_where_it_passes():
    cloud = cloud_of(wall(10))
    met = meet(cloud, looking_ahead(), CAMERA)
    hits = 10 * CAMERA.rays_of_pixels()
    where = np.stack([-hits[..., 0], -hits[..., 1]], axis=-1)  # y is to the left, z up
    assert (met >= 0).all()
    away = np.linalg.norm(cloud.surfels["xyz"][met][..., 1:] - where, axis=-1)
    assert away.max() <= 0.1 * np.sqrt(2) + 1e-5


def test_what_is_nearer_hides_what_is_behind_and_gaps_are_looked_through():
    cloud = cloud_of(wall(10), wall(5, y=(-1, 1)))
    x = cloud.surfels["xyz"][meet(cloud, looking_ahead(), CAMERA)][..., 0]
    # A metre at 5 m is 6.4 pixels, and a disc's radius 1.6.
    np.testing.assert_array_equal(x[:, 26:38], 5)
    np.testing.assert_array_equal(x[:, [*range(23), *range(41, 64)]], 10)


def test_of_surfaces_close_behind_each_other_the_one_passed_nearest_is_met():
    """Discs overlap; the one that happens to lie a little nearer must not win everywhere."""
    one, other = wall(10, y=(-0.1, 0.1), z=(-0.1, 0.1)), wall(9.9, y=(0.1, 0.3), z=(-0.1, 0.1))
    cloud = cloud_of(one, other)
    camera = PinholeCamera(1, 1, 32.0, 32.0, 0.0, 0.0)
    assert cloud.surfels["xyz"][meet(cloud, looking_ahead(), camera)[0, 0], 0] == 10
    alone = meet(cloud, looking_ahead(), camera, replace(SETTINGS, behind_m=0.05))
    assert cloud.surfels["xyz"][alone[0, 0], 0] == pytest.approx(9.9)


@pytest.mark.parametrize(("x", "is_met"), [(0.3, False), (0.7, True), (39.0, True), (41.0, False), (-5.0, False)])
def test_what_is_too_near_too_far_or_behind_is_not_met(x, is_met):
    met = meet(cloud_of(wall(x)), looking_ahead(), CAMERA)
    assert (met[20:28, 28:36] >= 0).all() == is_met


def test_discs_seen_edge_on_are_not_met():
    edge_on = wall(10, normal=(0, 1, 0), y=(-0.1, 0.1), z=(-5, 5))
    assert (meet(cloud_of(edge_on), looking_ahead(y=0.2), CAMERA) < 0).all()
    assert (meet(cloud_of(edge_on), looking_ahead(y=3.0), CAMERA) >= 0).any()


@given(st.integers(0, 10**6), st.floats(-180, 180), st.floats(-80, 80), st.floats(-30, 30))
@settings(max_examples=60)
def test_tiles_out_of_sight_hold_nothing_that_would_have_been_met(seed, heading, pitch, roll):
    rng = np.random.default_rng(seed)
    low = rng.uniform(-60, 60, (40, 3)) * [1, 1, 0.3]
    cloud = cloud_of(*(np.concatenate([wall(x, y=(y, y + 4), z=(z, z + 4))]) for x, y, z in low))
    R = Rotation.from_euler("zyx", [heading, pitch, roll], degrees=True).as_matrix() @ R_BODY_OPTICAL
    T = transform_from(R, rng.uniform(-5, 5, 3))
    everything = SurfelMap(cloud.origin_m, cloud.surfels, np.array([[*T[:2, 3], 0.0, len(cloud.surfels)]]), cloud.grid)
    np.testing.assert_array_equal(meet(cloud, T, CAMERA), meet(everything, T, CAMERA))


@given(st.integers(0, 10**6), st.sampled_from([5.0, 20.0, 80.0]))
@settings(max_examples=40)
def test_the_kernel_meets_what_plain_numpy_meets(seed, focal_px):
    """Discs anywhere and any way round, through lenses of 135 to 17 degrees; every disc asked of every ray."""
    rng, s = np.random.default_rng(seed), replace(SETTINGS, radius_m=0.4)
    camera = PinholeCamera(24, 18, focal_px, focal_px, 11.0, 9.5)
    discs = np.zeros(400, SURFEL)
    discs["xyz"] = rng.uniform([0, -8, -8], [16, 8, 8], (400, 3))
    discs["normal"] = rng.normal(size=(400, 3))
    discs["normal"] /= np.linalg.norm(discs["normal"], axis=1, keepdims=True)
    cloud = cloud_of(discs)
    ray = camera.rays_of_pixels().reshape(-1, 3)
    x, n = (cloud.surfels[name].astype(float) @ R_BODY_OPTICAL for name in ("xyz", "normal"))
    off = (n * x).sum(axis=1)
    z = off / (ray @ n.T)
    apart2 = ((ray[:, None] * z[..., None] - x) ** 2).sum(axis=2)
    flat = np.abs(off) < s.grazing * np.linalg.norm(x, axis=1)
    there = (apart2 <= s.radius_m**2) & ~flat & (x[:, 2] >= s.nearest_m) & (x[:, 2] <= s.reach_m)
    first = np.where(there, z, np.inf).min(axis=1, keepdims=True)
    among = np.where(there & (z <= first + s.behind_m), apart2, np.inf)
    expected = np.where(np.isfinite(among.min(axis=1)), among.argmin(axis=1), -1)
    met = meet(cloud, looking_ahead(), camera, s).ravel()
    # Single precision may decide otherwise what lies on a rim, or as near as another.
    assert (met == expected).mean() > 0.99
    nearest = np.sort(apart2, axis=1)
    clear = (np.abs(apart2 - s.radius_m**2) > 1e-4).all(axis=1) & (nearest[:, 1] - nearest[:, 0] > 1e-4)
    np.testing.assert_array_equal(met[clear], expected[clear])


def a_camera(rng, *, pitch_deg=20.0):
    R = Rotation.from_euler("zyx", rng.uniform(-1, 1, 3) * [180, pitch_deg, pitch_deg], degrees=True).as_matrix()
    return transform_from(R @ R_BODY_OPTICAL, rng.uniform(-5, 5, 3))


@given(st.integers(0, 10**6), st.sampled_from([12.0, 32.0, 120.0]), st.booleans())
@settings(max_examples=60)
def test_from_near_by_the_same_is_met_as_if_it_had_been_gathered_there(seed, focal_px, furthest):
    """Walls and posts anywhere, some at the very rim of what is gathered; lenses of 140 to 30 degrees."""
    rng = np.random.default_rng(seed)
    camera = PinholeCamera(64, 48, focal_px, focal_px, 31.5, 23.5)
    low = rng.uniform(-55, 55, (40, 3)) * [1, 1, 0.3]
    cloud = cloud_of(*(wall(x, y=(y, y + 4), z=(z, z + 4)) for x, y, z in low))
    T = a_camera(rng)
    axis, away = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    size = 0.999 if furthest else rng.random()
    near = transform_from(
        Rotation.from_rotvec(size * NEAR_RAD * axis).as_matrix() @ T[:3, :3], T[:3, 3] + size * NEAR_M * away
    )
    sights = SurfelRaycaster(cloud, SETTINGS)
    sights.meet(T, camera)
    np.testing.assert_array_equal(sights.meet(near, camera), meet(cloud, near, camera))
    assert len(sights._gathered) == 1


@pytest.mark.parametrize(
    ("away_m", "turn_rad", "other", "gathered"),
    [(0.99 * NEAR_M, 0.0, False, 1), (1.01 * NEAR_M, 0.0, False, 2), (0.0, 0.99 * NEAR_RAD, False, 1), (0.0, 1.01 * NEAR_RAD, False, 2),
     (0.0, 0.0, True, 2)],
)  # fmt: skip
def test_from_further_off_and_for_another_camera_it_is_gathered_anew(away_m, turn_rad, other, gathered):
    camera = PinholeCamera(32, 24, 16.0, 16.0, 15.5, 11.5) if other else CAMERA
    sights = SurfelRaycaster(cloud_of(wall(10)), SETTINGS)
    sights.meet(looking_ahead(), CAMERA)
    turned = Rotation.from_rotvec([0, 0, turn_rad]).as_matrix() @ looking_ahead()[:3, :3]
    assert (sights.meet(transform_from(turned, np.array([0.0, away_m, 0.0])), camera) >= 0).any()
    assert len(sights._gathered) == gathered


def test_of_many_places_the_last_ones_are_kept_and_others_gathered_again():
    """As a long sequence asks of several candidates; what is met stays the same."""
    cloud = cloud_of(wall(10, y=(-60, 60)))
    sights, places = SurfelRaycaster(cloud, SETTINGS), [looking_ahead(y=3.0 * k) for k in range(-10, 10)]
    for T in places:
        sights.meet(T, CAMERA)
        assert len(sights._gathered) <= KEPT
        sights._look_up(places[-1], CAMERA)
    assert [each.T_map_camera[1, 3] for each in sights._gathered[-2:]] == [places[-2][1, 3], places[-1][1, 3]]
    sights._met.clear()
    np.testing.assert_array_equal(sights.meet(places[0], CAMERA), meet(cloud, places[0], CAMERA))
    assert len(sights._gathered) == KEPT


def test_each_pose_is_looked_up_once(monkeypatch):
    sights, asked, kept = SurfelRaycaster(cloud_of(wall(10)), SETTINGS), [], SurfelRaycaster._look_up
    monkeypatch.setattr(SurfelRaycaster, "_look_up", lambda *given: (asked.append(given), kept(*given))[1])
    first = sights.meet(looking_ahead(), CAMERA)
    assert sights.meet(looking_ahead().copy(), CAMERA) is first
    sights.meet(looking_ahead(x=0.1), CAMERA)
    assert len(asked) == 2


def test_more_surfels_than_one_chunk_holds_keep_their_numbers():
    """Of three walls one behind the other only the nearest is met, by the numbers that the map gives it."""
    cloud = cloud_of(wall(12), wall(8), wall(10))
    met = meet(cloud, looking_ahead(), CAMERA)
    assert len(cloud.surfels) > 10 * 512
    np.testing.assert_array_equal(cloud.surfels["xyz"][met][..., 0], 8)


def test_where_nothing_is_mapped_nothing_is_met():
    assert (meet(cloud_of(wall(10)), looking_ahead(x=500.0), CAMERA) == -1).all()


def test_the_corner_of_a_tile_beside_the_picture_is_seen_by_who_turns_towards_it():
    cloud = cloud_of(wall(39.9, y=(40, 41), z=(-1, 1)), wall(20, y=(-1, 1)))
    sights = SurfelRaycaster(cloud, SETTINGS)
    turned = Rotation.from_rotvec([0, 0, 0.09]).as_matrix() @ looking_ahead()[:3, :3]
    seen = []
    for T in (looking_ahead(x=4.0), transform_from(turned, np.array([4.0, 1.9, 0.0]))):
        met = sights.meet(T, CAMERA)
        seen.append(cloud.surfels["xyz"][met[met >= 0]][:, 1].max() > 30)
    assert seen == [False, True]
    assert len(sights._gathered) == 1
