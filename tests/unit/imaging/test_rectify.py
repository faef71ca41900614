"""Rectification against values worked out by hand, and against the projection of single rays."""

import math
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from service.errors import RequestError, TooLargeError
from service.geometry.camera import PinholeCamera
from service.geometry.distortion import COEFFICIENTS, distorted_pixels, rays_of
from service.imaging import rectify as module
from service.imaging.rectify import Rectification, _Tables, rectification_of, rectified_pair
from service.registration.points import inverse_depth_noise

BARREL = PinholeCamera(160, 120, 80.0, 82.0, 80.5, 58.0, (-0.3, 0.1, 0.001, -0.002))
PINCUSHION = PinholeCamera(160, 120, 110.0, 112.0, 80.5, 58.0, (0.2, 0.05, 0.0, 0.0))
FISHEYE = PinholeCamera(160, 120, 76.0, 77.0, 80.5, 58.0, (-0.0055, 0.042, -0.0405, 0.0076), "kannala_brandt")
OVER_180 = PinholeCamera(160, 120, 48.0, 48.0, 79.5, 59.5, (0.0,) * 4, "kannala_brandt")
CAMERAS = {"barrel": BARREL, "pincushion": PINCUSHION, "fisheye": FISHEYE, "over 180 degrees": OVER_180}


def images_of(
    camera: PinholeCamera, *, seed: int = 0, by: float = 1.0
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Colour and depth images of noise, whose pixels all differ."""
    rng, height, width = np.random.default_rng(seed), round(by * camera.height), round(by * camera.width)
    rgb = rng.integers(1, 256, (height, width, 3), np.uint8)
    return rgb, (1 + rng.permutation(height * width).reshape(height, width)).astype(np.float32)


def places_of(camera, height, width):
    """Place in the sent image of each pixel of the rectified image, ray by ray: u and v; NaN outside of the image or the lens."""
    rectification = rectification_of(camera)
    sent, pinhole = camera.scaled_to(width, height), rectification.camera
    rows, columns = rectification.size_of(height, width)
    rays = pinhole.scaled_to(columns, rows).rays_of_pixels()
    places = distorted_pixels(sent, rays[..., :2])
    angle = np.arctan(np.hypot(rays[..., 0], rays[..., 1]))
    inside = (angle <= rectification.reach_rad) & (np.abs(places[..., 0] - (width - 1) / 2) <= width / 2)
    inside &= np.abs(places[..., 1] - (height - 1) / 2) <= height / 2
    return np.where(inside[..., None], places, np.nan)


def test_images_without_distortion_stay_as_they_are():
    for camera in (
        PinholeCamera(160, 120, 80.0, 82.0, 80.5, 58.0),
        PinholeCamera(160, 120, 80.0, 82.0, 80.5, 58.0, (0.0,) * 5),
    ):
        rgb, depth_m = images_of(camera)
        pair = rectified_pair(rgb, depth_m, camera)
        assert pair.rgb is rgb
        assert pair.depth_m is depth_m
        assert pair.camera is camera
        assert pair.observed is None


# By hand: the border is 60 degrees or tan = 1.732 aside, and 45 degrees or tan = 1 above. At the focal length of 305.58 px the image would
# have 1058.5 x 611.2 px, 2.106 times as many as sent. So the focal length shrinks by the root of that.
def test_a_fisheye_lens_keeps_its_field_and_its_number_of_pixels():
    focal = 320 / math.radians(60)
    camera = PinholeCamera(640, 480, focal, focal, 319.5, 239.5, (0.0,) * 4, "kannala_brandt")
    found = rectification_of(camera).camera
    scale = math.sqrt(640 * 480 / (2 * math.sqrt(3) * focal * 2 * focal))
    assert scale == pytest.approx(1 / math.sqrt(2.106), abs=1e-3)
    assert (found.fx, found.fy) == pytest.approx((scale * focal, scale * focal), rel=1e-4)
    assert (found.width, found.height) == (729, 421)
    assert (found.cx, found.cy) == pytest.approx((364.2, 210.1), abs=0.1)
    assert not found.is_distorted


# By hand: at 48 px for a radian the image shows 95 degrees aside and 72 degrees above. The rectified one ends at 60 and 45 degrees,
# 2 tan(60) 48 = 166 px and 96 px, and has fewer pixels than the image, so that the focal length stays.
def test_a_lens_of_190_degrees_is_cut_to_what_a_pinhole_can_show():
    found = rectification_of(OVER_180).camera
    assert (found.fx, found.width, found.height) == (48.0, 166, 96)


def test_a_pincushion_lens_keeps_its_focal_length():
    """Its image shows less than a pinhole of the same focal length."""
    found = rectification_of(PINCUSHION).camera
    assert (found.fx, found.fy) == (110.0, 112.0)
    assert found.width < 160
    assert found.height < 120


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("by", [1.0, 0.5, 1.7])
def test_colour_is_interpolated_where_the_ray_of_the_pixel_meets_the_image(name, by):
    """Smooth grey levels: u and v of the pixel. So the rectified image shows the place of each of its pixels."""
    camera = CAMERAS[name]
    height, width = round(by * camera.height), round(by * camera.width)
    v, u = np.mgrid[0:height, 0:width]
    rgb = np.stack([u * 255 / width, v * 255 / height, np.full(u.shape, 200)], axis=-1).astype(np.uint8)
    found = rectified_pair(rgb, np.ones((height, width), np.float32), camera).rgb
    places = places_of(camera, height, width)
    seen = np.isfinite(places[..., 0])
    expected = np.clip(places, 0, [width - 1, height - 1]) * 255 / [width, height]
    assert np.abs(found[..., :2].astype(float) - expected)[seen].max() < 2.5  # whole grey levels of both
    assert (found[seen][:, 2] == 200).all()  # nothing is mixed with the outside
    assert not found[~seen].any()


@pytest.mark.parametrize("name", CAMERAS)
def test_depth_is_that_of_the_nearest_pixel(name):
    camera = CAMERAS[name]
    rgb, depth_m = images_of(camera)
    found = rectified_pair(rgb, depth_m, camera)
    places = places_of(camera, *depth_m.shape)
    seen = np.isfinite(places[..., 0])
    nearest = np.clip(np.rint(places[seen]), 0, [camera.width - 1, camera.height - 1]).astype(int)
    equal = found.depth_m[seen] == depth_m[nearest[:, 1], nearest[:, 0]]
    assert equal.mean() > 0.999  # a place between two pixels may go either way
    assert not found.depth_m[~seen].any()
    observed = np.ones(seen.shape, bool) if found.observed is None else found.observed
    assert np.mean(observed == seen) > 0.999


def test_depth_is_never_mixed_between_two_surfaces_and_holes_stay():
    depth_m = np.where(np.arange(160) < 80, 2.0, 9.0).astype(np.float32)[None].repeat(120, 0)
    depth_m[50:60, 70:90] = 0
    found = rectified_pair(np.zeros((120, 160, 3), np.uint8), depth_m, BARREL).depth_m
    assert set(np.unique(found)) == {0, 2, 9}
    rows, columns = found.shape
    assert not found[rows * 55 // 120, columns * 79 // 160 : columns * 81 // 160].any()


def test_a_barrel_lens_shows_nothing_in_some_corners():
    """The corners of the sent image lie further out than its edges, so the rectified image bulges beyond the corners."""
    pair = rectified_pair(*images_of(BARREL), BARREL)
    assert pair.observed is not None
    assert 0.9 < pair.observed.mean() < 1
    assert not pair.rgb[~pair.observed].any()
    assert not pair.depth_m[~pair.observed].any()


def test_depth_of_another_size_covers_the_same_field():
    rgb, _ = images_of(BARREL)
    _, depth_m = images_of(BARREL, by=0.5)
    pair = rectified_pair(rgb, depth_m, BARREL)
    assert pair.depth_m.shape == tuple(round(side / 2) for side in pair.rgb.shape[:2])
    assert pair.camera == rectification_of(BARREL).camera


def test_a_scene_that_is_distorted_and_rectified_is_the_scene_again():
    """A wall 5 m ahead with vertical stripes 0.5 m wide, seen by both cameras."""
    pinhole = rectification_of(BARREL).camera

    def seen_by(rays: NDArray[np.float64]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        z_m = np.where(rays[..., 2] > 0, 5.0, 0).astype(np.float32)
        stripe = np.floor(5.0 * rays[..., 0] / rays[..., 2] / 0.5) % 2
        return np.repeat((50 + 150 * stripe).astype(np.uint8)[..., None], 3, axis=-1), z_m

    pixels = np.stack(np.meshgrid(np.arange(160.0), np.arange(120.0)), axis=-1)
    pair = rectified_pair(*seen_by(rays_of(BARREL, pixels)), BARREL)
    assert pair.observed is not None
    rgb, z_m = seen_by(pinhole.rays_of_pixels())
    assert (pair.depth_m[pair.observed] == 5.0).all()
    same = np.abs(pair.rgb.astype(int) - rgb)[pair.observed] < 40
    assert same.mean() > 0.85  # the rest lies on the edges of the stripes
    assert z_m.shape == pair.depth_m.shape


@pytest.mark.parametrize("camera", [FISHEYE, OVER_180])
def test_the_noise_of_the_depth_stays_what_it_is(camera):
    """Copies of a pixel would look like less noise. On a wall the inverse depth is 0.1 / m."""
    large = camera.scaled_to(640, 480)
    rng = np.random.default_rng(0)
    depth_m = (1 / (0.1 + rng.normal(0, 2e-3, (480, 640)))).astype(np.float32)
    pair = rectified_pair(np.zeros((480, 640, 3), np.uint8), depth_m, large)
    assert inverse_depth_noise(pair.depth_m).total == pytest.approx(2e-3, rel=0.05)


def test_a_table_follows_from_its_key_alone():
    """Two processes have two caches."""
    rectification = rectification_of(FISHEYE)
    one, other = (_Tables(2**20).get(rectification, 120, 160) for _ in range(2))
    assert one is not None
    assert other is not None
    for name in ("u", "v", "observed"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        with pytest.raises(ValueError, match="read-only"):
            getattr(one, name)[0, 0] = 1


def test_the_tables_are_bounded_and_the_last_ones_stay():
    rectifications = [rectification_of(BARREL.scaled_to(160 + 4 * k, 120 + 3 * k)) for k in range(4)]
    sizes = [9 * each.camera.width * each.camera.height for each in rectifications]
    tables = _Tables(sum(sizes[1:]))

    def get(number: int) -> object:
        sent = rectifications[number].sent
        return tables.get(rectifications[number], sent.height, sent.width)

    first, second = get(0), get(1)
    assert get(1) is second
    assert get(0) is first  # now the second is the oldest
    get(2), get(3)
    assert tables._bytes <= sum(sizes[1:])
    assert get(1) is not second


@pytest.mark.parametrize("name", CAMERAS)
def test_an_image_whose_table_is_too_large_is_rectified_in_bands(name, monkeypatch):
    camera = CAMERAS[name]
    kept = rectified_pair(*images_of(camera), camera)
    monkeypatch.setattr(module, "_TABLES", _Tables(1000))
    monkeypatch.setattr(module, "_BAND_PIXELS", 700)  # a few rows
    bands = rectified_pair(*images_of(camera), camera)
    np.testing.assert_array_equal(bands.depth_m, kept.depth_m)
    assert np.abs(bands.rgb.astype(int) - kept.rgb).max() <= 1
    assert (bands.observed is None) == (kept.observed is None)
    assert module._TABLES._bytes == 0


def test_threads_share_the_tables():
    tables, found = _Tables(2**22), list[object]()
    rectification = rectification_of(FISHEYE)

    def get() -> None:
        found.extend(tables.get(rectification, 120, 160) for _ in range(20))

    threads = [threading.Thread(target=get) for _ in range(4)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert len(found) == 80
    assert tables._bytes == 9 * rectification.camera.width * rectification.camera.height


def test_an_image_beside_the_axis_shows_nothing_that_a_pinhole_can_show():
    """The left border is 130 px and 2.7 rad from the axis."""
    camera = PinholeCamera(160, 120, 48.0, 48.0, -130.0, 60.0, (0.0,) * 4, "kannala_brandt")
    with pytest.raises(
        RequestError, match=r"^camera: the rectified image would be empty, .*60 degrees beside .*; check cx"
    ) as told:
        rectification_of(camera)
    assert told.value.field == "camera"


def test_an_image_that_shows_a_sliver_of_the_field_is_refused():
    """The left border is 50 px or 59.7 degrees from the axis, so the image shows a tip of the field."""
    camera = PinholeCamera(160, 120, 48.0, 48.0, -50.5, 60.0, (0.0,) * 4, "kannala_brandt")
    with pytest.raises(
        RequestError, match=r"^camera: the rectified image would be a strip of 1x22 pixels, .* hardly anything"
    ) as told:
        rectification_of(camera)
    assert told.value.field == "camera"


def test_a_side_that_opencv_cannot_remap_is_refused():
    camera = PinholeCamera(32768, 2048, 20000.0, 20000.0, 16384.0, 1024.0, (0.01, 0.0, 0.0, 0.0))
    depth_m = np.ones((4, 64), np.float32)
    with pytest.raises(TooLargeError, match=r"`depth` has 4x32767 pixels, .*at most 32766 .*smaller") as told:
        rectified_pair(np.zeros((4, 64, 3), np.uint8), np.broadcast_to(np.float32(1), (32767, 4)), camera)
    assert told.value.field == "depth"
    assert rectified_pair(np.zeros((4, 64, 3), np.uint8), depth_m, camera).depth_m.shape == (4, 64)


def test_a_rectification_scales_with_the_image():
    rectification = Rectification(BARREL, PinholeCamera(150, 110, 70.0, 70.0, 75.0, 55.0), 1.0)
    assert rectification.size_of(120, 160) == (110, 150)
    assert rectification.size_of(60, 80) == (55, 75)
    assert rectification.size_of(1, 1) == (1, 1)


@given(
    width=st.integers(8, 400),
    height=st.integers(8, 400),
    focal=st.floats(0.1, 5),
    centre=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    model=st.sampled_from(list(COEFFICIENTS)),
    coefficients=st.tuples(*(st.floats(-0.5, 0.5) for _ in range(4))),
)
def test_a_rectified_camera_is_finite_and_no_larger_than_the_sent_one(
    width, height, focal, centre, model, coefficients
):
    small = (*coefficients[:2], *(0.01 * each for each in coefficients[2:]))
    camera = PinholeCamera(
        width, height, focal * width, focal * width, centre[0] * width, centre[1] * height, small, model
    )
    if not camera.is_distorted:
        return
    try:
        found = rectification_of(camera).camera
    except RequestError:
        return
    assert all(map(math.isfinite, (found.fx, found.fy, found.cx, found.cy)))
    assert min(found.width, found.height) >= 2
    assert max(found.width, found.height) <= 16 * min(found.width, found.height)
    assert found.width * found.height <= width * height + found.width + found.height
    aside = [abs(u - found.cx) / found.fx for u in (-0.5, found.width - 0.5)]
    above = [abs(v - found.cy) / found.fy for v in (-0.5, found.height - 0.5)]
    assert max(aside) <= math.tan(math.radians(60)) + 1 / found.fx
    assert max(above) <= math.tan(math.radians(45)) + 1 / found.fy
    pair = rectified_pair(*images_of(camera), camera)
    assert np.isfinite(pair.depth_m).all()
    assert pair.depth_m.any()
