import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from research.baselines.paper.ihs import (
    hue_saturation_linear,
    ihs_geometric,
    planes_from_hue_saturation,
    rgb_from_geometric,
)
from service.imaging.fusion import ihs_linear

UNIT = st.floats(0.0, 1.0, allow_subnormal=False)
COLOURS = arrays(np.float64, (5, 3), elements=UNIT)
RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def angle_between(a, b):
    return np.abs((np.asarray(a) - b + np.pi) % (2 * np.pi) - np.pi)


def hue_of_equation_10_and_11(r, g, b):
    theta = math.acos(0.5 * ((r - g) + (r - b)) / math.sqrt((r - g) ** 2 + (r - b) * (g - b)))
    return theta if b <= g else 2 * math.pi - theta


# The corners of the plane V1, V2 lie 120 degrees apart: blue on the axis V1, red in the third quadrant.
@pytest.mark.parametrize(("rgb", "hue_deg"), [(BLUE, 0), (GREEN, 120), (RED, 240), ((0.0, 1.0, 1.0), 60)])
def test_linear_hue_keeps_its_quadrant(rgb, hue_deg):
    _, v1, v2 = ihs_linear(np.array([rgb]))
    hue, _ = hue_saturation_linear(v1, v2)
    assert angle_between(hue, np.deg2rad(hue_deg)) < 1e-12


# By hand from eq. 10-13. (0.2, 0.4, 0.6): I = 1.2/3, S = 1 - 3/1.2*0.2, and B > G, so H = 360 - acos(-0.3/sqrt(0.12)).
@pytest.mark.parametrize(
    ("rgb", "expected"),
    [
        (RED, (1 / 3, 0.0, 1.0)),
        (GREEN, (1 / 3, 120.0, 1.0)),
        (BLUE, (1 / 3, 240.0, 1.0)),
        ((1.0, 1.0, 0.0), (2 / 3, 60.0, 1.0)),
        ((1.0, 0.0, 1.0), (2 / 3, 300.0, 1.0)),
        ((1.0, 1.0, 1.0), (1.0, 0.0, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((0.5, 0.5, 0.5), (0.5, 0.0, 0.0)),
        ((0.2, 0.4, 0.6), (0.4, 210.0, 0.5)),
    ],
)
def test_geometric_transform_gives_the_values_worked_out_by_hand(rgb, expected):
    i, h, s = ihs_geometric(np.array([rgb]))
    np.testing.assert_allclose((i[0], s[0]), (expected[0], expected[2]), atol=1e-12)
    assert angle_between(h, np.deg2rad(expected[1])) < 1e-12


def test_scales_of_the_two_intensities_differ_by_the_square_root_of_3():
    white = np.ones((1, 3))
    np.testing.assert_allclose(ihs_linear(white)[0], math.sqrt(3))
    np.testing.assert_allclose(ihs_geometric(white)[0], 1.0)


@given(COLOURS)
def test_linear_hue_and_saturation_come_back(rgb):
    _, v1, v2 = ihs_linear(rgb)
    back = planes_from_hue_saturation(*hue_saturation_linear(v1, v2))
    np.testing.assert_allclose(np.array(back), np.array([v1, v2]), atol=1e-14)


@given(COLOURS)
def test_geometric_transform_comes_back(rgb):
    np.testing.assert_allclose(rgb_from_geometric(*ihs_geometric(rgb)), rgb, atol=3e-6)


@given(COLOURS)
def test_geometric_values_lie_in_their_ranges(rgb):
    i, h, s = ihs_geometric(rgb)
    assert np.all((i >= 0) & (i <= 1 + 1e-12))
    assert np.all((h >= 0) & (h < 2 * np.pi))
    assert np.all((s >= 0) & (s <= 1))


@given(COLOURS)
def test_linear_hue_lies_in_one_turn_and_saturation_under_its_bound(rgb):
    _, v1, v2 = ihs_linear(rgb)
    h, s = hue_saturation_linear(v1, v2)
    assert np.all((h >= 0) & (h < 2 * np.pi))
    assert np.all(s <= math.sqrt(2 / 3) + 1e-12)


@given(st.tuples(*3 * [st.integers(0, 255)]).filter(lambda c: max(c) > min(c)))
def test_hue_by_atan2_is_the_hue_of_equations_10_and_11(rgb):
    _, h, _ = ihs_geometric(np.array([rgb], float))
    try:
        expected = hue_of_equation_10_and_11(*rgb)
    except ValueError:  # rounding put the argument of arccos beyond 1: pure red or cyan
        return
    assert angle_between(h, expected) < 1e-6


@given(st.tuples(*3 * [st.integers(0, 255)]).filter(lambda c: max(c) > min(c)))
def test_turning_the_channels_turns_the_hue_by_a_third(rgb):
    _, h, s = ihs_geometric(np.array([rgb], float))
    _, h_turned, s_turned = ihs_geometric(np.roll(np.array([rgb], float), 1, axis=1))
    assert angle_between(h_turned, h + 2 * np.pi / 3) < 1e-9
    np.testing.assert_allclose(s_turned, s)


@given(st.tuples(*3 * [st.integers(0, 255)]).filter(lambda c: max(c) > min(c)))
def test_linear_hue_runs_against_the_geometric_from_blue(rgb):
    colour = np.array([rgb], float)
    _, v1, v2 = ihs_linear(colour)
    linear, _ = hue_saturation_linear(v1, v2)
    _, geometric, _ = ihs_geometric(colour)
    assert angle_between(linear, 4 * np.pi / 3 - geometric[0]) < 1e-9


@given(st.integers(0, 255))
def test_grey_has_no_hue_and_no_saturation(level):
    _, h, s = ihs_geometric(np.full((1, 3), level, np.float32))
    assert h[0] == 0
    assert s[0] == 0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_precision_is_kept(dtype):
    rgb = np.full((2, 2, 3), 0.25, dtype)
    assert {plane.dtype for plane in ihs_geometric(rgb)} == {np.dtype(dtype)}
    assert rgb_from_geometric(*ihs_geometric(rgb)).dtype == dtype
