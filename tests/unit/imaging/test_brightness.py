import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from service.imaging.view_grid import BRIGHTNESS_FLOOR, BRIGHTNESS_LIMIT, LEAST_BRIGHTNESS_SPREAD, brightness

ALL = np.ones((1, 4), np.bool_)
VALUES = arrays(np.float32, (4, 6), elements=st.floats(0.0, 255.0, width=32))


def of(values, measured=None, seen=None):
    values = np.atleast_2d(np.asarray(values, np.float32))
    every = np.ones(values.shape, np.bool_)
    return brightness(values, measured=every if measured is None else measured, seen=every if seen is None else seen)


def test_two_levels_stand_one_spread_to_either_side():
    np.testing.assert_allclose(of([1.0, 1.0, 3.0, 3.0]), [[-1, -1, 1, 1]], atol=1e-5)


def test_mean_and_spread_are_worked_out_over_measured_cells():
    measured = np.array([[True, True, True, False]])
    logarithms = np.log(np.array([1.0, 2.0, 6.0]) / 3.0 + BRIGHTNESS_FLOOR)
    expected = (np.log(10.0 / 3.0 + BRIGHTNESS_FLOOR) - logarithms.mean()) / logarithms.std()
    assert of([1.0, 2.0, 6.0, 10.0], measured)[0, 3] == pytest.approx(expected, abs=1e-4)


@given(VALUES, st.floats(1e-3, 1e3))
def test_the_scale_does_not_matter(values, scale):
    np.testing.assert_allclose(of(values), of(values * np.float32(scale)), atol=2e-3)


@given(VALUES)
def test_it_stays_within_its_limit(values):
    found = of(values)
    assert np.isfinite(found).all()
    assert np.abs(found).max() <= BRIGHTNESS_LIMIT


def test_cells_outside_the_view_are_zero():
    seen = np.array([[True, True, False, False]])
    assert (of([1.0, 4.0, 9.0, 16.0], seen=seen)[0, 2:] == 0).all()


@pytest.mark.parametrize("values", [[0, 0, 0, 0], [7, 7, 7, 7], [100, 101, 100, 101]])
def test_a_view_without_contrast_carries_no_information(values):
    assert not of(values).any()


def test_a_view_without_a_measured_cell_carries_no_information():
    assert not of([1.0, 2.0, 3.0, 4.0], measured=~ALL).any()


def plain_brightness(values, measured, seen):
    """Compute the brightness with logarithms of all cells."""
    mean = float(values[measured].mean()) if measured.any() else 0.0
    if not mean > 0:
        return np.zeros_like(values)
    logarithm = np.log(values / np.float32(mean) + np.float32(BRIGHTNESS_FLOOR))
    middle, spread = float(logarithm[measured].mean()), float(logarithm[measured].std())
    if spread < LEAST_BRIGHTNESS_SPREAD:
        return np.zeros_like(values)
    scaled = np.clip((logarithm - np.float32(middle)) / np.float32(spread), -BRIGHTNESS_LIMIT, BRIGHTNESS_LIMIT)
    return np.where(seen, scaled, np.float32(0))


@given(seed=st.integers(0, 10**6), share=st.sampled_from([0.0, 0.1, 0.7, 1.0]), same=st.booleans())
def test_brightness_is_that_of_all_cells_to_the_bit(seed, share, same):
    rng = np.random.default_rng(seed)
    values = (rng.random((9, 37)) ** 3 * 255).astype(np.float32)
    measured = rng.random(values.shape) < share
    seen = measured if same else rng.random(values.shape) < 0.8
    found = brightness(values, measured=measured, seen=seen)
    assert found.tobytes() == plain_brightness(values, measured, seen).tobytes()
