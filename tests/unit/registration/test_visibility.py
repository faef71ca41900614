from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, transform_from
from service.registration.kernel import SURFEL
from service.registration.surfel_map import SurfelMap
from service.registration.visibility import MOST_COLLECTIONS, NEAR_M, NEAR_RAD, DiscSettings, SurfelRaycaster

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
    return SurfelMap.prepare(ORIGIN, np.concatenate(parts))


def surfels_of(cloud, rows=np.s_[:]):
    """Return surfels of a map as numbers, in the shape of their rows."""
    if isinstance(rows, slice):
        return cloud.unpacked(rows)
    return cloud.unpacked(rows.ravel()).reshape(rows.shape)


def looking_ahead(x=0.0, y=0.0, z=0.0):
    return transform_from(R_BODY_OPTICAL, np.array([x, y, z]))


def intersect(cloud, T_map_camera, camera, of=SETTINGS):
    return SurfelRaycaster(cloud, of).intersect(T_map_camera, camera)


def test_every_ray_hits_the_surfel_nearest_to_its_intersection():
    cloud = cloud_of(wall(10))
    hits = intersect(cloud, looking_ahead(), CAMERA)
    expected = 10 * CAMERA.rays_of_pixels()
    where = np.stack([-expected[..., 0], -expected[..., 1]], axis=-1)  # y is to the left, z up
    assert (hits >= 0).all()
    away = np.linalg.norm(surfels_of(cloud, hits)["xyz"][..., 1:] - where, axis=-1)
    assert away.max() <= 0.1 * np.sqrt(2) + 1e-5


def test_depth_is_that_of_the_plane_of_the_surfel():
    """A wall at 10 m, and one at 5 m that leans: its normal has a slope of 3 to 4, so its depth is 5 + 0.75 times the height."""
    far, near = wall(10), wall(5, y=(-1, 1), z=(-0.3, 0.3), step=0.1, normal=(0.8, 0.0, -0.6))
    near["xyz"][:, 0] += 0.75 * near["xyz"][:, 2]
    cloud, camera = cloud_of(far, near), CAMERA
    depth_m = SurfelRaycaster(cloud, SETTINGS).depth(looking_ahead(), camera)
    np.testing.assert_allclose(depth_m[:, :10], 10.0, atol=1e-3)
    rows = np.arange(22, 26)  # of a ray with a height of t z: z = 5 + 0.75 t z
    slope = -(rows - camera.cy) / camera.fy
    np.testing.assert_allclose(depth_m[rows, 31], 5.0 / (1 - 0.75 * slope), atol=5e-3)
    np.testing.assert_array_equal(SurfelRaycaster(cloud, SETTINGS).depth(looking_ahead(x=100.0), camera), 0.0)


def test_near_surfaces_hide_far_ones_and_gaps_do_not():
    cloud = cloud_of(wall(10), wall(5, y=(-1, 1)))
    x = np.round(surfels_of(cloud, intersect(cloud, looking_ahead(), CAMERA))["xyz"][..., 0], 2)
    # A metre at 5 m is 6.4 pixels, and a disc's radius 1.6.
    np.testing.assert_array_equal(x[:, 26:38], 5)
    np.testing.assert_array_equal(x[:, [*range(23), *range(41, 64)]], 10)


def test_of_surfaces_close_behind_each_other_the_disc_with_the_nearest_centre_is_hit():
    """Discs overlap. A disc that is slightly nearer must not win everywhere."""
    one, other = wall(10, y=(-0.1, 0.1), z=(-0.1, 0.1)), wall(9.9, y=(0.1, 0.3), z=(-0.1, 0.1))
    cloud = cloud_of(one, other)
    camera = PinholeCamera(1, 1, 32.0, 32.0, 0.0, 0.0)
    assert surfels_of(cloud, intersect(cloud, looking_ahead(), camera)[:1, 0])["xyz"][0, 0] == pytest.approx(
        10, abs=3e-4
    )
    alone = intersect(cloud, looking_ahead(), camera, replace(SETTINGS, same_surface_m=0.05))
    assert surfels_of(cloud, alone[:1, 0])["xyz"][0, 0] == pytest.approx(9.9, abs=3e-4)


@pytest.mark.parametrize(("x", "is_met"), [(0.3, False), (0.7, True), (39.0, True), (41.0, False), (-5.0, False)])
def test_surfels_too_near_too_far_or_behind_are_not_hit(x, is_met):
    hits = intersect(cloud_of(wall(x)), looking_ahead(), CAMERA)
    assert (hits[20:28, 28:36] >= 0).all() == is_met


def test_discs_seen_edge_on_are_not_hit():
    edge_on = wall(10, normal=(0, 1, 0), y=(-0.1, 0.1), z=(-5, 5))
    assert (intersect(cloud_of(edge_on), looking_ahead(y=0.2), CAMERA) < 0).all()
    assert (intersect(cloud_of(edge_on), looking_ahead(y=3.0), CAMERA) >= 0).any()


@given(st.integers(0, 10**6), st.floats(-180, 180), st.floats(-80, 80), st.floats(-30, 30))
@settings(max_examples=60)
def test_regions_outside_the_field_of_view_contain_no_intersections(seed, heading, pitch, roll):
    rng = np.random.default_rng(seed)
    low = rng.uniform(-60, 60, (40, 3)) * [1, 1, 0.3]
    cloud = cloud_of(*(np.concatenate([wall(x, y=(y, y + 4), z=(z, z + 4))]) for x, y, z in low))
    R = Rotation.from_euler("zyx", [heading, pitch, roll], degrees=True).as_matrix() @ R_BODY_OPTICAL
    T = transform_from(R, rng.uniform(-5, 5, 3))
    found = intersect(cloud, T, CAMERA)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SurfelRaycaster, "_cubes_in_view", lambda self, *_: self.cloud.grid.cubes)
        np.testing.assert_array_equal(found, intersect(cloud, T, CAMERA))


@given(st.integers(0, 10**6), st.sampled_from([5.0, 20.0, 80.0]))
@settings(max_examples=40)
def test_the_kernel_hits_the_same_surfels_as_numpy(seed, focal_px):
    """Random discs and lenses of 135 to 17 degrees. The reference intersects every ray with every disc."""
    rng, s = np.random.default_rng(seed), replace(SETTINGS, radius_m=0.4)
    camera = PinholeCamera(24, 18, focal_px, focal_px, 11.0, 9.5)
    discs = np.zeros(400, SURFEL)
    discs["xyz"] = rng.uniform([0, -8, -8], [16, 8, 8], (400, 3))
    discs["normal"] = rng.normal(size=(400, 3))
    discs["normal"] /= np.linalg.norm(discs["normal"], axis=1, keepdims=True)
    cloud = cloud_of(discs)
    ray = camera.rays_of_pixels().reshape(-1, 3)
    x, n = (surfels_of(cloud)[name].astype(float) @ R_BODY_OPTICAL for name in ("xyz", "normal"))
    off = (n * x).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):  # a packed normal may be exactly perpendicular to a ray
        z = off / (ray @ n.T)
        apart2 = ((ray[:, None] * z[..., None] - x) ** 2).sum(axis=2)
    flat = np.abs(off) < s.grazing * np.linalg.norm(x, axis=1)
    there = (apart2 <= s.radius_m**2) & ~flat & (x[:, 2] >= s.nearest_m) & (x[:, 2] <= s.reach_m)
    first = np.where(there, z, np.inf).min(axis=1, keepdims=True)
    among = np.where(there & (z <= first + s.same_surface_m), apart2, np.inf)
    expected = np.where(np.isfinite(among.min(axis=1)), among.argmin(axis=1), -1)
    hits = intersect(cloud, looking_ahead(), camera, s).ravel()
    # Single precision may decide otherwise what lies on a rim, or as near as another.
    assert (hits == expected).mean() > 0.99
    nearest = np.sort(apart2, axis=1)
    clear = (np.abs(apart2 - s.radius_m**2) > 1e-4).all(axis=1) & (nearest[:, 1] - nearest[:, 0] > 1e-4)
    np.testing.assert_array_equal(hits[clear], expected[clear])


def a_camera(rng, *, pitch_deg=20.0):
    R = Rotation.from_euler("zyx", rng.uniform(-1, 1, 3) * [180, pitch_deg, pitch_deg], degrees=True).as_matrix()
    return transform_from(R @ R_BODY_OPTICAL, rng.uniform(-5, 5, 3))


@given(st.integers(0, 10**6), st.sampled_from([12.0, 32.0, 120.0]), st.booleans())
@settings(max_examples=60)
def test_a_nearby_pose_hits_the_same_surfels_as_its_own_collection(seed, focal_px, furthest):
    """Random walls and posts, some at the border of the collection, and lenses of 140 to 30 degrees."""
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
    raycaster = SurfelRaycaster(cloud, SETTINGS)
    raycaster.intersect(T, camera)
    np.testing.assert_array_equal(raycaster.intersect(near, camera), intersect(cloud, near, camera))
    thinned = thinned_by(2, camera)
    np.testing.assert_array_equal(raycaster.intersect(near, thinned), intersect(cloud, near, thinned))
    assert len(raycaster._collections) == 1


def thinned_by(each, camera):
    """Return the camera of every n-th row and column of another camera's image."""
    fx, fy, cx, cy = (value / each for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    return PinholeCamera(camera.width // each, camera.height // each, fx, fy, cx, cy)


@pytest.mark.parametrize(
    ("away_m", "turn_rad", "camera", "gathered"),
    [
        (0.99 * NEAR_M, 0.0, CAMERA, 1),
        (1.01 * NEAR_M, 0.0, CAMERA, 2),
        (0.0, 0.99 * NEAR_RAD, CAMERA, 1),
        (0.0, 1.01 * NEAR_RAD, CAMERA, 2),
        (0.0, 0.0, thinned_by(2, CAMERA), 1),
        (0.0, 0.0, replace(CAMERA, width=65), 2),
        (0.0, 0.0, replace(CAMERA, height=49), 2),
        (0.0, 0.0, replace(CAMERA, cx=32.1), 2),
        (0.0, 0.0, replace(CAMERA, cy=24.1), 2),
        (0.0, 0.0, replace(CAMERA, fx=33.0, cx=31.5), 1),
    ],
)
def test_a_distant_pose_or_a_wider_view_collects_surfels_again(away_m, turn_rad, camera, gathered):
    raycaster = SurfelRaycaster(cloud_of(wall(10)), SETTINGS)
    raycaster.intersect(looking_ahead(), CAMERA)
    turned = Rotation.from_rotvec([0, 0, turn_rad]).as_matrix() @ looking_ahead()[:3, :3]
    assert (raycaster.intersect(transform_from(turned, np.array([0.0, away_m, 0.0])), camera) >= 0).any()
    assert len(raycaster._collections) == gathered


def test_the_last_collections_are_kept_and_others_collected_again():
    """A long sequence does this for several candidates. The intersections stay equal."""
    cloud = cloud_of(wall(10, y=(-60, 60)))
    raycaster, places = SurfelRaycaster(cloud, SETTINGS), [looking_ahead(y=3.0 * k) for k in range(-10, 10)]
    for T in places:
        raycaster.intersect(T, CAMERA)
        assert len(raycaster._collections) <= MOST_COLLECTIONS
        raycaster._cast(places[-1], CAMERA)
    assert [each.T_map_camera[1, 3] for each in raycaster._collections[-2:]] == [places[-2][1, 3], places[-1][1, 3]]
    raycaster._results.clear()
    np.testing.assert_array_equal(raycaster.intersect(places[0], CAMERA), intersect(cloud, places[0], CAMERA))
    assert len(raycaster._collections) == MOST_COLLECTIONS


def test_each_pose_is_looked_up_once(monkeypatch):
    raycaster, asked, kept = SurfelRaycaster(cloud_of(wall(10)), SETTINGS), [], SurfelRaycaster._cast
    monkeypatch.setattr(SurfelRaycaster, "_cast", lambda *given: (asked.append(given), kept(*given))[1])
    first = raycaster.intersect(looking_ahead(), CAMERA)
    assert raycaster.intersect(looking_ahead().copy(), CAMERA) is first
    raycaster.intersect(looking_ahead(x=0.1), CAMERA)
    assert len(asked) == 2


def test_more_surfels_than_one_chunk_holds_keep_their_numbers():
    """Of three walls behind each other, the rays hit only the nearest. Indices are those of the map."""
    cloud = cloud_of(wall(12), wall(8), wall(10))
    hits = intersect(cloud, looking_ahead(), CAMERA)
    assert len(cloud.surfels) > 10 * 512
    np.testing.assert_allclose(surfels_of(cloud, hits)["xyz"][..., 0], 8, atol=3e-4)


def test_without_map_surfaces_no_ray_hits():
    assert (intersect(cloud_of(wall(10)), looking_ahead(x=500.0), CAMERA) == -1).all()


def test_a_camera_that_turns_sees_the_corner_of_a_region_beside_its_image():
    cloud = cloud_of(wall(39.9, y=(40, 41), z=(-1, 1)), wall(20, y=(-1, 1)))
    raycaster = SurfelRaycaster(cloud, SETTINGS)
    turned = Rotation.from_rotvec([0, 0, 0.09]).as_matrix() @ looking_ahead()[:3, :3]
    seen = []
    for T in (looking_ahead(x=4.0), transform_from(turned, np.array([4.0, 1.9, 0.0]))):
        hits = raycaster.intersect(T, CAMERA)
        seen.append(surfels_of(cloud, hits[hits >= 0])["xyz"][:, 1].max() > 30)
    assert seen == [False, True]
    assert len(raycaster._collections) == 1
