"""Both models of a lens against values worked out by hand, and against OpenCV."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from service.errors import RequestError
from service.geometry.camera import PinholeCamera
from service.geometry.distortion import (
    COEFFICIENTS,
    LIMITS,
    coefficient_problem,
    distorted_pixels,
    rays_of,
    reach_of,
)


def brown(*distortion, width=640, height=480, focal=400.0):
    return PinholeCamera(width, height, focal, 1.02 * focal, 325.0, 236.0, tuple(map(float, distortion)))


def fisheye(*distortion, focal=300.0):
    return PinholeCamera(640, 480, focal, 1.02 * focal, 325.0, 236.0, distortion or (0.0,) * 4, "kannala_brandt")


BENT = {
    "four": brown(-0.3, 0.1, 0.001, -0.002),
    "five": brown(-0.28, 0.07, 0.001, -0.002, 0.01),
    "rational": brown(0.5, -2.6, 0.0005, 0.0001, 1.5, 0.38, -2.4, 1.4),
    "prism": brown(-0.2, 0.05, 0.001, 0.002, 0, 0, 0, 0, 0.01, -0.002, 0.005, 0.001),
    "tilted": brown(-0.2, 0.05, 0.001, 0.002, 0, 0, 0, 0, 0.01, -0.002, 0.005, 0.001, 0.1, -0.05),
    "pincushion": brown(0.2, 0.05, 0.0, 0.0),
    "equidistant": fisheye(),
    "fisheye": fisheye(-0.0055, 0.042, -0.0405, 0.0076),
    "over 180 degrees": fisheye(0.0035, 0.0007, -0.0021, 0.0002, focal=190.0),
}


# By hand: at x = 0.5, y = 0 the squared radius is 0.25. With a focal length of 100 px a term of 0.01 is one pixel.
@pytest.mark.parametrize(
    ("distortion", "pixel"),
    [
        ((0, 0, 0, 0), (50.0, 0.0)),
        ((-0.2, 0, 0, 0), (47.5, 0.0)),  # 0.5 (1 - 0.2 * 0.25)
        ((0, -0.2, 0, 0), (49.375, 0.0)),  # 0.5 (1 - 0.2 * 0.0625)
        ((0, 0, 0.01, 0), (50.0, 0.25)),  # p1 r^2
        ((0, 0, 0, 0.02), (51.5, 0.0)),  # p2 (r^2 + 2 x^2)
        ((0, 0, 0, 0, -0.64), (49.5, 0.0)),  # 0.5 (1 - 0.64 / 64)
        ((0, 0, 0, 0, 0, 1, 0, 0), (40.0, 0.0)),  # 0.5 / (1 + 0.25)
        ((0, 0, 0, 0, 0, 0, 0, 0, 0.04, 0, 0.08, 0), (51.0, 2.0)),  # s1 r^2, s3 r^2
    ],
)
def test_a_point_goes_where_the_formula_says(distortion, pixel):
    camera = PinholeCamera(200, 200, 100.0, 100.0, 0.0, 0.0, tuple(map(float, distortion)))
    np.testing.assert_allclose(distorted_pixels(camera, np.array([[0.5, 0.0]]))[0], pixel, atol=1e-12)


def test_a_sensor_that_is_tilted_sees_a_homography():
    """A sensor tilted by tau about its x axis sees the point (0, y) at y / (cos(tau) - y sin(tau)), of length 1 on the axis."""
    tau, y = 0.1, 0.3
    camera = PinholeCamera(200, 200, 100.0, 100.0, 0.0, 0.0, (*(0.0,) * 12, tau, 0.0))
    _, v = distorted_pixels(camera, np.array([[0.0, y]]))[0]
    assert v == pytest.approx(100 * y / (math.cos(tau) - y * math.sin(tau)))


# By hand: 45 degrees are 0.7854 rad; with k1 = 0.1 this is 0.7854 (1 + 0.1 * 0.61685) = 0.83385.
@pytest.mark.parametrize(("k1", "u"), [(0.0, 78.5398), (0.1, 83.3846)])
def test_a_fisheye_point_goes_where_the_formula_says(k1, u):
    camera = PinholeCamera(200, 200, 100.0, 100.0, 0.0, 0.0, (k1, 0.0, 0.0, 0.0), "kannala_brandt")
    np.testing.assert_allclose(distorted_pixels(camera, np.array([[1.0, 0.0]]))[0], (u, 0), atol=1e-4)


@pytest.mark.parametrize("name", BENT)
def test_opencv_projects_the_same_points(name):
    camera = BENT[name]
    xy = np.random.default_rng(0).uniform(-0.7, 0.7, (500, 2))
    if camera.distortion_model == "kannala_brandt":
        expected = cv2.fisheye.distortPoints(xy[:, None], camera.matrix, np.array(camera.distortion))
    else:
        points = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))
    np.testing.assert_allclose(distorted_pixels(camera, xy), np.reshape(expected, (-1, 2)), atol=1e-9)


@pytest.mark.parametrize("name", BENT)
def test_the_ray_of_a_pixel_leads_back_to_it(name):
    camera = BENT[name]
    u, v = np.linspace(-0.5, camera.width - 0.5, 41), np.linspace(-0.5, camera.height - 0.5, 31)
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    rays = rays_of(camera, pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-12)
    assert np.degrees(np.arccos(rays[..., 2])).max() <= np.degrees(reach_of(camera)) + 0.2
    front = rays[..., 2] > 0.02
    back = distorted_pixels(camera, rays[front][:, :2] / rays[front][:, 2:])
    np.testing.assert_allclose(back, pixels[front], atol=1e-6)


# By hand: the corner is hypot(2.5, 2.5) = 3.5355 rad away, beyond pi. Without coefficients a pixel of radius r is at r rad.
def test_an_equidistant_lens_sees_its_radius_as_an_angle():
    camera = PinholeCamera(500, 500, 100.0, 100.0, 249.5, 249.5, (0.0,) * 4, "kannala_brandt")
    assert reach_of(camera) == pytest.approx(math.pi)
    pixels = np.array([[249.5 + 100, 249.5], [249.5, 249.5 - 200], [249.5, 249.5], [-0.5, -0.5]])
    none = [math.nan] * 3
    expected = np.array([[math.sin(1), 0, math.cos(1)], [0, -math.sin(2), math.cos(2)], [0, 0, 1], none])
    np.testing.assert_allclose(rays_of(camera, pixels), expected, atol=1e-12)


# By hand: r (1 - 0.3 r^2) stops growing at r = 1 / sqrt(0.9) = 1.054, or 46.5 degrees, where it is 0.703.
@pytest.mark.parametrize(("focal", "is_fine"), [(600.0, True), (560.0, False), (400.0, False)])
def test_the_radius_must_grow_up_to_the_corners(focal, is_fine):
    """The farthest corner is 401 px away: 0.668 focal lengths of 600 px, and 0.716 of 560 px."""
    camera = PinholeCamera(640, 480, focal, focal, 319.0, 239.0, (-0.3, 0.0, 0.0, 0.0))
    if is_fine:
        assert np.degrees(reach_of(camera)) < 46.5
        return
    with pytest.raises(
        RequestError, match=r"not invertible .* stops growing 4[56]\.\d degrees .*; .*kannala_brandt.* crop"
    ) as told:
        reach_of(camera)
    assert told.value.field == "camera.distortion"


def test_a_fisheye_radius_must_grow_too():
    """The derivative 1 - 3 * 0.5 t^2 is 0 at t = 0.8165, or 46.8 degrees. The limit of 0.02 comes 0.5 degrees earlier."""
    with pytest.raises(RequestError, match=r"kannala_brandt is not invertible .* stops growing 46\.\d degrees"):
        reach_of(fisheye(-0.5, 0.0, 0.0, 0.0))


def test_a_lens_whose_rays_do_not_reach_the_corners_is_refused():
    """By hand: the right border is 1280 px or 100 focal lengths from the principal point. The tangent of 89 degrees is 57."""
    camera = PinholeCamera(640, 480, 12.8, 12.8, -640.0, 240.0, (1e-9, 0.0, 0.0, 0.0))
    with pytest.raises(RequestError, match=r"no ray within 89 degrees .* reaches the corners"):
        reach_of(camera)


@pytest.mark.parametrize(
    ("model", "distortion", "problem"),
    [
        ("brown_conrady", (), None),
        ("brown_conrady", (0.0,) * 3, None),
        ("brown_conrady", (0.1, 0.0, 0.0), "does not have 3 coefficients; send 4, 5, 8, 12 or 14 of k1, k2, p1"),
        ("brown_conrady", (-0.3, 0.1, 0.0, 0.0), None),
        ("brown_conrady", (-0.3, 0.1, 1.5, 0.0), "p1 = 1.5 is no lens, because it exceeds 1; check the order"),
        ("brown_conrady", (0.0,) * 13 + (0.6,), "tau_y = 0.6 is no lens, because it exceeds 0.5"),
        ("brown_conrady", (math.nan, 0.0, 0.0, 0.0), "k1 = nan is no lens"),
        ("kannala_brandt", (), "does not have 0 coefficients; send 4 of k1, k2, k3, k4"),
        ("kannala_brandt", (0.0,) * 4, None),
        ("kannala_brandt", (0.0,) * 5, "does not have 5 coefficients"),
        ("kannala_brandt", (0.0, 0.0, -11.0, 0.0), "k3 = -11 is no lens, because it exceeds 10"),
    ],
)
def test_coefficients_are_counted_and_bounded(model, distortion, problem):
    found = coefficient_problem(model, distortion)
    assert (found is None) == (problem is None)
    assert problem is None or problem in str(found)


@st.composite
def lenses(draw):
    """Draw any lens that the contract lets through."""
    model = draw(st.sampled_from(list(COEFFICIENTS)))
    count = draw(st.sampled_from(COEFFICIENTS[model]))
    share = draw(st.sampled_from((1e-4, 1e-2, 1.0)))
    coefficients = tuple(share * draw(st.floats(-limit, limit)) for _, limit in LIMITS[model][:count])
    width, height = draw(st.integers(2, 2000)), draw(st.integers(2, 2000))
    fx, fy = (side * draw(st.floats(0.02, 100)) for side in (width, height))
    cx, cy = (side * draw(st.floats(-1, 2)) for side in (width, height))
    return width, height, fx, fy, cx, cy, coefficients, model


@given(lenses())
def test_a_lens_is_refused_or_every_pixel_has_one_ray(lens):
    camera = PinholeCamera(*lens)
    assume(camera.is_distorted)
    try:
        reach = reach_of(camera)
    except RequestError:
        return
    assert 0 <= reach <= math.pi
    u, v = np.linspace(-0.5, camera.width - 0.5, 9), np.linspace(-0.5, camera.height - 0.5, 9)
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    rays = rays_of(camera, pixels)
    known = np.isfinite(rays).all(axis=-1)
    if camera.distortion_model == "brown_conrady":
        assert known.all()
    front = known & (rays[..., 2] > 0.02)
    back = distorted_pixels(camera, rays[front][:, :2] / rays[front][:, 2:])
    np.testing.assert_allclose(back, pixels[front], atol=1e-4 * max(camera.fx, camera.fy, 1.0))
