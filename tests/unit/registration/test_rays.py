from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_y, rotation_z, transform_from
from service.registration import rays
from service.registration.kernel import SURFEL
from service.registration.rays import RayPicture, RaySettings
from service.registration.register import Registered
from service.registration.surfel_map import SurfelMap
from service.registration.visibility import SurfelRaycaster

CAMERA = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)
SETTINGS = RaySettings(radius_m=0.25, fewest=100)
R_LEVEL_CAMERA = rotation_y(np.deg2rad(4.0)) @ R_BODY_OPTICAL
NOISE = 1e-3
ORIGIN = np.array([500.0, -300.0, 40.0])


def adjust(cloud, pictures, found, of):
    return rays.adjust(SurfelRaycaster(cloud, of), pictures, found, of)


@pytest.fixture(scope="module")
def city(street):
    """Return the street as a map with another origin."""
    surfels = street.surfels()
    return SurfelMap.prepare(ORIGIN, surfels)


def picture_of(
    street, pose, *, noise=0.0, scale=1.0, offset=0.0, rig=80.0, seed=1, R_level_camera=R_LEVEL_CAMERA, aside_m=0.0
):
    """Return inverse depths of a camera with a scale, an offset and noise, ``aside_m`` to the left of the reference."""
    R, t = pose
    T_level_camera = transform_from(R_level_camera, np.array([0.0, aside_m, 0.0]))
    z = street.depth(CAMERA, transform_from(R, t) @ T_level_camera).astype(float)
    inverse = np.where(z > 0, scale / np.where(z > 0, z, 1) - (offset / rig if rig else 0.0), 0)
    inverse += noise * np.random.default_rng(seed).normal(size=z.shape) * (inverse > 0)
    still = np.zeros(z.shape, bool)
    return RayPicture(inverse.astype(np.float32), CAMERA, T_level_camera, max(noise, NOISE), rig, still)


def found_at(pose, *, away=(0.0, 0.0, 0.0), turned=(0.0, 0.0, 0.0)):
    R, t = pose
    return Registered(Rotation.from_rotvec(turned).as_matrix() @ R, ORIGIN + t + away, 1.0, 0.0, 0.9, np.eye(8), 3)


@given(
    st.tuples(*[st.floats(-0.25, 0.25)] * 2, st.floats(-0.1, 0.1)),
    st.tuples(*[st.floats(-0.01, 0.01)] * 2, st.floats(-0.03, 0.03)),
)
@settings(max_examples=25)
def test_an_exact_image_is_registered_at_its_true_pose(city, street, pose, away, turned):
    many = replace(SETTINGS, rounds=6, steps=3)
    got, _ = adjust(city, [picture_of(street, pose)], found_at(pose, away=away, turned=turned), many)
    assert np.linalg.norm(got.camera_m - ORIGIN - pose[1]) < 0.02
    assert Rotation.from_matrix(got.R_map_level @ pose[0].T).magnitude() < np.deg2rad(0.15)
    assert (got.hypothesis, got.inliers) == (3, 0.9)
    assert 3 <= got.iterations <= 18
    assert got.iterations % 3 == 0
    assert got.converged


def test_rays_that_a_scorer_has_cast_are_not_cast_again(city, street, pose, monkeypatch):
    pictures, start = [picture_of(street, pose)], found_at(pose, away=(0.1, 0.05, 0))
    raycaster, asked, kept = SurfelRaycaster(city, SETTINGS), [], SurfelRaycaster._cast
    rays.cast_rays(raycaster, pictures, start)
    monkeypatch.setattr(SurfelRaycaster, "_cast", lambda *given: (asked.append(given), kept(*given))[1])
    rays.adjust(raycaster, pictures, start, replace(SETTINGS, rounds=1))
    assert asked == []


@pytest.mark.parametrize(
    ("away", "converged_m", "rounds", "looked_up"),
    [
        (0.0, 0.02, 5, (1, 1)),
        (0.1, 0.02, 9, (2, 8)),
        (0.3, 1e-12, 5, (5, 5)),
        (0.3, 1e-12, 3, (3, 3)),
        (0.3, 9.0, 5, (1, 1)),
    ],
)
def test_rays_are_looked_up_until_the_pose_stands_still(
    city, street, pose, monkeypatch, away, converged_m, rounds, looked_up
):
    asked, kept = [], SurfelRaycaster._cast
    monkeypatch.setattr(SurfelRaycaster, "_cast", lambda *given: (asked.append(given), kept(*given))[1])
    s = replace(SETTINGS, rounds=rounds, converged_m=converged_m, converged_rad=1e9)
    adjust(city, [picture_of(street, pose)], found_at(pose, away=(away, 0, 0)), s)
    assert looked_up[0] <= len(asked) <= looked_up[1]


def test_the_given_pose_stays_unchanged(city, street, pose):
    start = found_at(pose, away=(0.2, 0.1, 0))
    before = start.camera_m.copy(), start.R_map_level.copy()
    adjust(city, [picture_of(street, pose)], start, SETTINGS)
    np.testing.assert_array_equal(start.camera_m, before[0])
    np.testing.assert_array_equal(start.R_map_level, before[1])


@pytest.mark.parametrize(("scale", "offset"), [(1.01, 0.0), (1.0, 0.5), (0.99, -0.4)])
def test_scale_and_offset_of_a_rig_are_found(city, street, pose, scale, offset):
    many = replace(SETTINGS, rounds=6, steps=3, scale=0.1, offset_px=5.0)
    got, _ = adjust(city, [picture_of(street, pose, scale=scale, offset=offset)], found_at(pose), many)
    assert got.scale == pytest.approx(scale, abs=0.004)
    assert got.offset == pytest.approx(offset, abs=0.1)


def test_a_camera_that_is_no_rig_has_no_offset(city, street, pose):
    start = replace(found_at(pose), offset=0.0)
    got, _ = adjust(city, [picture_of(street, pose, rig=None)], start, SETTINGS)
    assert got.offset == 0.0
    assert not got.information[7].any()


def test_a_common_error_of_patches_is_not_the_pose_s(city, street, pose):
    """Every second patch on the left has the same error of several sigmas. Without shared errors, its effect is larger."""
    picture = picture_of(street, pose, rig=None)
    wrong = picture.inverse.copy()
    for row in range(0, 48, 12):
        for column in range(0, 30, 12):
            wrong[row : row + 6, column : column + 6] += 5 * NOISE
    picture = replace(picture, inverse=np.where(picture.inverse > 0, wrong, 0).astype(np.float32))
    known = replace(SETTINGS, robust=10.0, rounds=4, scale=1e-4)
    off = {}
    for shared in (0.0, 5.0):
        got, _ = adjust(city, [picture], found_at(pose), replace(known, shared=shared))
        off[shared] = np.linalg.norm(got.camera_m - ORIGIN - pose[1])
    assert off[5.0] < 0.6 * off[0.0], off


def test_two_cameras_of_one_rig_are_one_picture(city, street, pose):
    """One camera looks back and constrains the position along the street. Both are in the frame of the reference."""
    back = rotation_z(np.pi) @ R_LEVEL_CAMERA
    pictures = [picture_of(street, pose), picture_of(street, pose, R_level_camera=back, aside_m=0.3, rig=80.0)]
    many = replace(SETTINGS, rounds=6, steps=3)
    got, _ = adjust(city, pictures, found_at(pose, away=(0.1, -0.1, 0.05), turned=(0, 0, 0.02)), many)
    assert np.linalg.norm(got.camera_m - ORIGIN - pose[1]) < 0.02


def test_moved_cars_have_less_effect_where_points_are_marked_movable():
    """Half of the pixels are 0.3 m nearer than mapped, too little for the robust kernel."""
    inverse = np.full((CAMERA.height, CAMERA.width), 0.1, np.float32)
    inverse[:, :32] = 1 / 9.7
    movable = np.zeros(inverse.shape, bool)
    movable[:, :30] = True  # patches of 6 pixels
    inverse[:, 30:32] = 0
    y, z = (side.ravel() for side in np.meshgrid(*[np.arange(-20, 20, 0.2)] * 2))
    wall = np.zeros(len(y), SURFEL)
    wall["xyz"], wall["normal"] = np.stack([np.full(len(y), 10.0), y, z], axis=1), (1, 0, 0)
    mapped = SurfelMap.prepare(ORIGIN, wall)
    pose = np.eye(3), np.zeros(3)
    picture = RayPicture(inverse, CAMERA, transform_from(R_BODY_OPTICAL, np.zeros(3)), NOISE, None, movable)
    known = replace(SETTINGS, robust=50.0, rounds=4, scale=1e-4, turn_rad=1e-4)
    off = {}
    for name, where in (("unknown", np.zeros_like(movable)), ("known", movable)):
        got, _ = adjust(mapped, [replace(picture, movable=where)], found_at(pose), known)
        off[name] = got.camera_m[0] - ORIGIN[0]
    assert off["unknown"] == pytest.approx(0.15, abs=0.03)
    assert off["known"] == pytest.approx(0.0, abs=0.03)


def test_an_image_with_too_few_intersections_is_not_adjusted(city, street, pose):
    picture = picture_of(street, pose)
    few = np.zeros_like(picture.inverse)
    few[20:29, 20:30] = picture.inverse[20:29, 20:30]
    assert adjust(city, [replace(picture, inverse=few)], found_at(pose), SETTINGS) is None
    assert adjust(city, [picture], found_at(pose, away=(500.0, 0, 0)), SETTINGS) is None


def plain(city, picture, hits, R, t, *, scale, offset, s):
    """Compute residual, gradient by finite differences, weight and patch of every valid pixel."""
    v, u = np.nonzero((hits >= 0) & (picture.inverse > 0))
    ray = CAMERA.rays_of_pixels()[v, u]
    surfels = city.unpacked(hits[v, u])
    n, x = surfels["normal"].astype(float), surfels["xyz"].astype(float)

    def predicted(change):
        T = transform_from(Rotation.from_rotvec(change[3:6]).as_matrix() @ R, t + change[:3]) @ picture.T_level_camera
        inverse_z = np.einsum("ij,ij->i", n, ray @ T[:3, :3].T) / np.einsum("ij,ij->i", n, x - T[:3, 3])
        return scale * np.exp(change[6]) * inverse_z - (offset + change[7]) / picture.focal_baseline_px_m

    J = np.stack([(predicted(step) - predicted(-step)) / 2e-6 for step in 1e-6 * np.eye(8)], axis=1)
    r = picture.inverse[v, u].astype(float) - predicted(np.zeros(8))
    z = scale / (predicted(np.zeros(8)) + offset / picture.focal_baseline_px_m)
    T = transform_from(R, t) @ picture.T_level_camera
    flat = np.abs(np.einsum("ij,ij->i", n, ray @ T[:3, :3].T)) >= s.grazing
    counts = flat & (z >= s.nearest_m) & (z <= s.reach_m)
    variance = picture.noise**2 + (s.surface_m / z**2) ** 2
    w = np.where(counts, (1 + r**2 / (s.robust**2 * variance)) ** -2.0 / variance, 0)
    return J, r, w, v // s.patch * 100 + u // s.patch


@given(
    st.integers(0, 10**6),
    st.sampled_from([0.0, 0.5, 2.0]),
    st.sampled_from([0.0, 0.3]),
    st.integers(1, 16),
    st.booleans(),
)
@settings(max_examples=40)
def test_the_normal_equations_are_those_with_one_more_unknown_for_every_patch(
    city, street, pose, seed, shared, moved, patch, again
):
    """The reference solves a dense system that includes the shared errors of the patches. Sums of earlier images are kept."""
    rng = np.random.default_rng(seed)
    s = replace(SETTINGS, shared=shared, moved_m=moved, patch=patch, radius_m=0.3)
    R, t = Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix() @ pose[0], pose[1] + rng.normal(0, 0.1, 3)
    scale, offset = np.exp(rng.normal(0, 0.01)), rng.normal(0, 0.2)
    movable = rng.random((CAMERA.height, CAMERA.width)) < rng.choice([0.0, 0.2, 1.0])
    picture = replace(picture_of(street, pose, noise=2e-3, seed=seed), movable=movable)
    pictures = [picture] * (2 if again else 1)
    state = rays._State(R, t, float(np.log(scale)), float(offset))
    hits = rays._Hits.of(SurfelRaycaster(city, s), state, picture)
    got = rays._normal_equations(pictures, [hits] * len(pictures), state, s, with_scatter=True)
    J, r, w, patches = plain(city, picture, hits.indices, R, t, scale=scale, offset=offset, s=s)
    H, b, error = J.T @ (J * w[:, None]), J.T @ (w * r), 0.5 * (w @ r**2)
    shift = np.where(movable, moved * picture.inverse.astype(float) ** 2, 0)[
        (hits.indices >= 0) & (picture.inverse > 0)
    ]
    for own in np.unique(patches[w > 0]):
        of = (patches == own) & (w > 0)
        common = (shared * picture.noise) ** 2 + (shift[of] ** 2).mean()
        if common > 0:
            h, own_w, own_r = J[of].T @ w[of], w[of].sum(), w[of] @ r[of]
            share = 1 / (own_w + 1 / common)
            H, b, error = H - share * np.outer(h, h), b - share * h * own_r, error - 0.5 * share * own_r**2
    np.testing.assert_allclose(got.H, len(pictures) * H, rtol=1e-4, atol=1e-5 * np.abs(H).max())
    np.testing.assert_allclose(got.b, len(pictures) * b, rtol=1e-4, atol=1e-5 * np.abs(J.T * w * r).sum(axis=1).max())
    assert got.pixels == len(pictures) * (w > 0).sum()
    assert got.error == pytest.approx(len(pictures) * error, rel=1e-4)
    assert np.linalg.eigvalsh(got.scatter).min() > -1e-6 * np.abs(got.scatter).max()


def test_neighbouring_patches_scatter_as_one():
    """Patches are joined two by two. Opposite gradients of neighbours cancel, and odd sizes lose no patch."""
    gradients = np.zeros((3, 5, 8))
    gradients[0, 0, 0], gradients[0, 1, 0] = 2.0, -2.0
    assert not rays._score_outer_product(gradients).any()
    gradients[2, 4, 1] = 3.0
    np.testing.assert_allclose(rays._score_outer_product(gradients), np.diag([0, 9.0, 0, 0, 0, 0, 0, 0]))


@given(st.tuples(*[st.floats(-3, 3)] * 3), st.sampled_from([1.0, 1e-3, 1e-6, 0.0]))
def test_a_turn_is_that_of_its_vector(vector, size):
    turn = size * np.array(vector)
    np.testing.assert_allclose(rays._rotation_of(turn), Rotation.from_rotvec(turn).as_matrix(), atol=1e-12)


@pytest.mark.parametrize("patch", [0, -1, 17])
def test_patches_that_the_kernel_has_no_room_for_are_refused(patch):
    with pytest.raises(ValueError, match=f"patch: {patch} must be 1 to 16"):
        RaySettings(patch=patch)
