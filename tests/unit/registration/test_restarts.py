from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.geometry.rigid import R_BODY_OPTICAL, transform_from
from service.registration import restarts
from service.registration.rays import adjust
from service.registration.restarts import RestartSettings, spread_of_restarts
from service.registration.visibility import SurfelRaycaster
from tests.unit.registration.test_rays import CAMERA, R_LEVEL_CAMERA, SETTINGS, city, found_at, picture_of
from tests.unit.registration.test_visibility import cloud_of, wall

__all__ = ["city"]  # a fixture


def spread(city, pictures, found, heading=0.0, of=SETTINGS, settings=RestartSettings()):  # noqa: B008
    return spread_of_restarts(SurfelRaycaster(city, of), pictures, found, heading, of, settings)


def test_where_every_restart_returns_there_is_no_spread(city, street, pose):
    """The corner of a street fixes all directions. Six rounds are enough to return."""
    many = RestartSettings(offsets_m=((0.25, 0.0), (0.0, -0.25)), each=1, rounds=8)
    found = spread(city, [picture_of(street, pose)], found_at(pose), settings=many)
    assert np.sqrt(np.diag(found)[:3]).max() < 0.02
    assert np.sqrt(np.diag(found)[3:]).max() < np.deg2rad(0.15)


def ends_at(monkeypatch, *ends):
    """Let each restart end at a shift (m) and a turn (rad) from its start; None: too few rays intersect the map. Return the starts."""
    starts, coming = [], iter(ends)

    def adjusted(raycaster, pictures, start, settings):
        starts.append((pictures, start, settings))
        end = next(coming)
        if end is None:
            return None
        R = Rotation.from_rotvec(end[3:]).as_matrix() @ start.R_map_level
        return transform_from(R, start.camera_m + end[:3])

    monkeypatch.setattr(restarts, "adjusted_pose", adjusted)
    return starts


def test_the_spread_is_the_mean_outer_product_of_the_differences(city, street, pose, monkeypatch):
    """Two restarts, one metre ahead and one to the left, along +y and -x for a view to the north."""
    starts = ends_at(monkeypatch, (0, -0.6, 0, 0, 0, 0.02), (1.0, 0, 0.3, 0.01, 0, 0))
    settings = RestartSettings(offsets_m=((1.0, 0.0), (0.0, 1.0)))
    found = found_at(pose)
    got = spread(city, [picture_of(street, pose)], found, np.pi / 2, settings=settings)
    first, second = np.array([0, 0.4, 0, 0, 0, 0.02]), np.array([0, 0, 0.3, 0.01, 0, 0])
    np.testing.assert_allclose(got, (np.outer(first, first) + np.outer(second, second)) / 2, atol=1e-9)
    away = [start.camera_m - found.camera_m for _, start, _ in starts]
    np.testing.assert_allclose(away, [[0, 1, 0], [-1, 0, 0]], atol=1e-9)


def test_a_restart_without_an_end_counts_with_its_offset(city, street, pose, monkeypatch):
    ends_at(monkeypatch, None, (0.5, 0, 0, 0, 0, 0), (0, -0.35, 0, 0, 0, 0), (0, 0.35, 0, 0, 0, 0))
    got = spread(city, [picture_of(street, pose)], found_at(pose))
    np.testing.assert_allclose(got, np.diag([0.5**2 / 4, 0, 0, 0, 0, 0]), atol=1e-12)


def test_restarts_take_half_of_the_rows_and_columns_and_hardly_a_prior(city, street, pose, monkeypatch):
    starts = ends_at(monkeypatch, None, None, None, None)
    picture = picture_of(street, pose)
    spread(city, [picture, picture], found_at(pose))
    pictures, _, settings = starts[0]
    assert [each.inverse.shape for each in pictures] == [(24, 32)] * 2
    np.testing.assert_array_equal(pictures[0].inverse, picture.inverse[::2, ::2])
    assert pictures[0].inverse.flags.c_contiguous
    assert (settings.patch, settings.fewest) == (SETTINGS.patch // 2, SETTINGS.fewest // 4)
    assert (settings.rounds, settings.steps, settings.position_m, settings.turn_rad) == (2, 3, 10.0, 0.3)
    assert settings.radius_m == SETTINGS.radius_m


@pytest.mark.parametrize("each", [1, 2, 3, 5])
def test_a_thinned_image_sees_the_same_rays(street, pose, each):
    picture = picture_of(street, pose)
    thinned = picture.thinned(each)
    np.testing.assert_allclose(thinned.camera.rays_of_pixels(), CAMERA.rays_of_pixels()[::each, ::each], atol=1e-12)
    np.testing.assert_array_equal(thinned.inverse, picture.inverse[::each, ::each])
    np.testing.assert_array_equal(thinned.T_level_camera[:3, :3], R_LEVEL_CAMERA)


def test_a_flat_direction_has_a_spread(street, pose):
    """In front of one endless wall nothing fixes the position along it, so a start along the wall stays there."""
    picture = replace(
        picture_of(street, pose, rig=None),
        inverse=np.full((CAMERA.height, CAMERA.width), 0.1, np.float32),
        T_level_camera=transform_from(R_BODY_OPTICAL, np.zeros(3)),
    )
    endless = cloud_of(wall(10, y=(-60, 60), z=(-30, 30)))
    found = spread(endless, [picture], found_at((np.eye(3), np.zeros(3))))
    along_view, along_wall = np.sqrt(np.diag(found)[:2])
    assert along_view < 0.05
    assert along_wall > 0.15
    assert np.isfinite(found).all()


def test_a_restart_is_an_adjustment_of_the_thinned_images(city, street, pose):
    picture, found, settings = picture_of(street, pose), found_at(pose), RestartSettings(offsets_m=((0.3, 0.0),))
    start = replace(found, camera_m=found.camera_m + [0.3, 0, 0])
    adjusted = adjust(SurfelRaycaster(city, SETTINGS), [picture.thinned(2)], start, settings.of(SETTINGS))
    assert adjusted is not None
    own = adjusted[0]
    difference = np.r_[
        own.camera_m - found.camera_m, Rotation.from_matrix(own.R_map_level @ found.R_map_level.T).as_rotvec()
    ]
    np.testing.assert_allclose(
        spread(city, [picture], found, settings=settings), np.outer(difference, difference), atol=1e-12
    )
