from dataclasses import replace

import numpy as np
import pytest

from model_training.simulation.conditions import CONDITIONS, Condition
from model_training.simulation.depth_noise import DEPTHS, measured_depth

CLEAR = CONDITIONS["clear"]
FOCAL_BASELINE = 80.0
#: Disparity noise alone.
NOISE = replace(DEPTHS["precise"], step_px=0.0, scale_error=0.0, bleeding=0.0, hole_level=99.0)
SHAPE = (240, 320)


def measured(z_m, model, *, seed=0, condition=CLEAR, blank=None, shape=SHAPE):
    clean = np.broadcast_to(np.asarray(z_m, np.float32), shape).copy()
    return measured_depth(
        clean, np.zeros(shape, np.bool_) if blank is None else blank, model, condition, np.random.default_rng(seed)
    )


def disparities(depth_m):
    return FOCAL_BASELINE / depth_m[depth_m > 0]


def test_the_ideal_camera_is_exact_within_its_range():
    clean = np.random.default_rng(0).uniform(0.5, 39, SHAPE).astype(np.float32)
    np.testing.assert_allclose(measured(clean, DEPTHS["ideal"]), clean, rtol=1e-5)


@pytest.mark.parametrize("z_m", [0.0, 0.3, 120.0])
@pytest.mark.parametrize("name", ["ideal", "precise"])
def test_beyond_the_limits_and_in_the_sky_nothing_is_measured(name, z_m):
    assert not measured(z_m, DEPTHS[name]).any()


def test_the_ideal_camera_ends_at_its_range():
    assert not measured(40.5, DEPTHS["ideal"]).any()


def test_errors_grow_with_the_square_of_the_distance():
    distances = np.array([3.0, 6.0, 12.0, 24.0])
    spread = [measured(z, NOISE, seed=k).std() for k, z in enumerate(distances)]
    assert np.polyfit(np.log(distances), np.log(spread), 1)[0] == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize(("name", "sigma_px"), [("precise", 0.1), ("stereo", 0.5)])
@pytest.mark.parametrize("z_m", [4.0, 10.0])
def test_disparity_noise_has_the_stated_size(name, sigma_px, z_m):
    model = replace(NOISE, noise_px=DEPTHS[name].noise_px, correlated=DEPTHS[name].correlated)
    errors = disparities(measured(z_m, model)) - FOCAL_BASELINE / z_m
    assert errors.std() == pytest.approx(sigma_px, rel=0.1)


def correlation_at(depth_m, lag_px):
    noise = FOCAL_BASELINE / depth_m - np.mean(FOCAL_BASELINE / depth_m)
    return float(np.mean(noise[:, lag_px:] * noise[:, :-lag_px]) / np.mean(noise**2))


def test_a_half_of_the_stereo_noise_is_common_to_neighbours():
    depth_m = measured(8.0, replace(NOISE, noise_px=0.5, correlated=0.5), shape=(480, 640))
    assert correlation_at(depth_m, 1) == pytest.approx(0.5, abs=0.1)


def test_noise_of_far_pixels_is_hardly_common():
    depth_m = measured(8.0, replace(NOISE, noise_px=0.5, correlated=0.5), shape=(480, 640))
    assert abs(correlation_at(depth_m, 150)) < 0.15


def test_noise_without_a_common_part_is_independent():
    depth_m = measured(8.0, replace(NOISE, noise_px=0.5, correlated=0.0))
    assert abs(correlation_at(depth_m, 1)) < 0.03


def test_disparities_come_in_steps():
    found = disparities(measured(8.0, replace(NOISE, noise_px=0.5, step_px=1 / 16))) * 16
    np.testing.assert_allclose(found, np.rint(found), atol=2e-3)
    assert len(np.unique(np.rint(found))) > 10


@pytest.mark.parametrize(("name", "sigma"), [("precise", 0.003), ("stereo", 0.01)])
def test_the_scale_of_a_frame_is_off_by_the_stated_error(name, sigma):
    model = replace(NOISE, noise_px=0.0, scale_error=DEPTHS[name].scale_error)
    scales = [float(measured(10.0, model, seed=seed, shape=(12, 16)).mean()) / 10 for seed in range(400)]
    assert np.std(scales) == pytest.approx(sigma, rel=0.12)


def test_a_frame_has_one_scale():
    depth_m = measured(10.0, replace(NOISE, noise_px=0.0, scale_error=0.01))
    assert np.ptp(depth_m) < 1e-4


def test_stereo_invents_depth_in_the_sky_of_three_frames_in_ten():
    frames = [measured(0.0, DEPTHS["stereo"], seed=seed, shape=(36, 48)).any() for seed in range(400)]
    assert np.mean(frames) == pytest.approx(0.3, abs=0.07)


def test_stereo_invents_depth_on_blank_walls_too():
    blank = np.ones(SHAPE, np.bool_)
    model = replace(NOISE, noise_px=0.0, invented_frames=1.0)
    off = [np.mean(np.abs(measured(9.0, model, seed=seed, blank=blank) - 9.0) > 1.0) for seed in range(5)]
    assert 0.001 < np.mean(off) < 0.3


def test_stereo_invents_nothing_where_there_is_texture():
    model = replace(NOISE, noise_px=0.0, invented_frames=1.0)
    np.testing.assert_allclose(measured(9.0, model), 9.0, rtol=1e-5)


def step_edge():
    clean = np.full(SHAPE, 20.0, np.float32)
    clean[:, 160:] = 5.0
    return clean


def test_edges_bleed_from_the_foreground_into_the_background():
    depth_m = measured(step_edge(), replace(NOISE, noise_px=0.0, bleeding=0.4))
    beside = depth_m[:, 156:160]
    assert np.mean((beside > 0) & (beside < 12)) > 0.1
    np.testing.assert_allclose(depth_m[:, 162:], 5.0, rtol=1e-4)


def test_a_camera_that_does_not_bleed_has_sharp_edges():
    np.testing.assert_allclose(measured(step_edge(), replace(NOISE, noise_px=0.0)), step_edge(), rtol=1e-5)


def test_holes_are_patches():
    missing = measured(8.0, replace(NOISE, hole_level=1.5)) == 0
    assert 0.01 < missing.mean() < 0.2
    beside = missing[:, 1:][missing[:, :-1]]
    assert beside.mean() > 0.8


@pytest.mark.parametrize("name", ["rain", "snow", "fog", "night", "low_sun"])
def test_bad_weather_and_light_make_depth_noisier_and_sparser(name):
    clear, bad = (measured(6.0, DEPTHS["precise"], condition=CONDITIONS[c]) for c in ("clear", name))
    assert disparities(bad).std() > 1.1 * disparities(clear).std()
    assert np.mean(bad > 0) < np.mean(clear > 0)


def test_fog_ends_stereo_where_contrast_ends():
    fog = Condition("fog", extinction_per_m=3.912 / 20)  # 20 m of visibility: 5 % of contrast at 15.3 m
    assert measured(14.0, NOISE, condition=fog).all()
    assert not measured(17.0, NOISE, condition=fog).any()


@pytest.mark.parametrize("name", list(DEPTHS))
def test_one_seed_gives_one_depth(name):
    np.testing.assert_array_equal(
        measured(step_edge(), DEPTHS[name], seed=7), measured(step_edge(), DEPTHS[name], seed=7)
    )
