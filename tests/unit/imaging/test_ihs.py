import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from service.imaging.fusion import IHS_FROM_RGB, ihs_linear, rgb_from_linear

COLOURS = arrays(np.float64, (5, 3), elements=st.floats(0.0, 1.0, allow_subnormal=False))
RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def test_the_rows_of_equation_9_are_orthonormal():
    np.testing.assert_allclose(IHS_FROM_RGB @ IHS_FROM_RGB.T, np.eye(3), atol=1e-15)


# By hand from eq. 9: I = (R+G+B)/sqrt3, V1 = (2B-R-G)/sqrt6, V2 = (G-R)/sqrt2.
@pytest.mark.parametrize(
    ("rgb", "expected"),
    [
        (RED, (0.5773502692, -0.4082482905, -0.7071067812)),
        (GREEN, (0.5773502692, -0.4082482905, 0.7071067812)),
        (BLUE, (0.5773502692, 0.8164965809, 0.0)),
        ((1.0, 1.0, 1.0), (1.7320508076, 0.0, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((0.2, 0.4, 0.6), (0.6928203230, 0.2449489743, 0.1414213562)),
    ],
)
def test_linear_transform_gives_the_values_worked_out_by_hand(rgb, expected):
    np.testing.assert_allclose(np.array(ihs_linear(np.array([rgb])))[:, 0], expected, atol=1e-9)


def test_white_has_the_intensity_of_the_square_root_of_3():
    np.testing.assert_allclose(ihs_linear(np.ones((1, 3)))[0], math.sqrt(3))


@given(COLOURS)
def test_linear_transform_comes_back(rgb):
    np.testing.assert_allclose(rgb_from_linear(*ihs_linear(rgb)), rgb, atol=1e-14)


@given(st.integers(0, 255))
def test_grey_has_no_colour(level):
    _, v1, v2 = ihs_linear(np.full((1, 3), level, np.float32))
    assert abs(v1[0]) < 1e-4
    assert abs(v2[0]) < 1e-4


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_precision_is_kept(dtype):
    rgb = np.full((2, 2, 3), 0.25, dtype)
    assert {plane.dtype for plane in ihs_linear(rgb)} == {np.dtype(dtype)}
    assert rgb_from_linear(*ihs_linear(rgb)).dtype == dtype
