import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import fresnel

from model_training.streets.plan_view import Bend, Geometry, polynomial_shape, reference_line


def test_a_line_runs_along_its_heading():
    points, headings = reference_line((Geometry(0, 10, 20, np.pi / 2, 50, Bend()),), np.array([0.0, 30.0, 50.0]))
    np.testing.assert_allclose(points, [[10, 20], [10, 50], [10, 70]], atol=1e-9)
    np.testing.assert_allclose(headings, np.pi / 2)


@settings(max_examples=50, deadline=None)
@given(st.floats(-0.2, 0.2).filter(lambda k: abs(k) > 1e-3), st.floats(1, 200))
def test_an_arc_lies_on_its_circle(curvature, length):
    s = np.array([length / 3, length])
    points, headings = Bend(curvature).at(s)
    expected = np.stack([np.sin(curvature * s), 1 - np.cos(curvature * s)], axis=1) / curvature
    np.testing.assert_allclose(points, expected, atol=1e-8)
    np.testing.assert_allclose(headings, curvature * s)


@settings(max_examples=50, deadline=None)
@given(st.floats(5, 300), st.floats(10, 200), st.sampled_from([-1, 1]))
def test_a_spiral_is_scipys_clothoid(radius, length, side):
    scale = np.sqrt(np.pi * radius * length)
    s = np.linspace(length / 7, length, 5)
    across, along = fresnel(s / scale)
    points, headings = Bend(0.0, side / (radius * length)).at(s)
    np.testing.assert_allclose(points, scale * np.stack([along, side * across], axis=1), atol=1e-7)
    np.testing.assert_allclose(headings, side * s**2 / (2 * radius * length))


def test_a_spiral_that_opens_backwards_ends_where_it_began():
    there = Bend(0.0, 0.001)
    ((x, y),), (heading,) = there.at(np.array([60.0]))
    back = Geometry(0, x, y, heading + np.pi, 60, Bend(-0.06, 0.001))
    points, _ = reference_line((back,), np.array([60.0]))
    np.testing.assert_allclose(points, [[0, 0]], atol=1e-9)


def test_a_poly3_is_found_by_its_length():
    curve = polynomial_shape((0, 1, 0, 0), (0, 0, 0.01, 0), length_m=60.0, p_range=None)
    u = 50.0
    length = u / 2 * np.sqrt(1 + (0.02 * u) ** 2) + np.arcsinh(0.02 * u) / 0.04  # of a parabola, by the textbook
    points, headings = curve.at(np.array([length]))
    np.testing.assert_allclose(points, [[50, 25]], atol=2e-3)
    np.testing.assert_allclose(headings, [np.arctan(1.0)], atol=1e-4)


@pytest.mark.parametrize(("p_range", "scale"), [("normalized", 1.0), ("arcLength", 40.0)])
def test_a_param_poly3_is_the_same_curve_for_either_range(p_range, scale):
    u, v = (0, 40 / scale, 0, 0), (0, 0, 30 / scale**2, -10 / scale**3)
    p = np.linspace(0, 1, 100_001)
    travelled = np.r_[0.0, np.cumsum(np.hypot(*np.diff([40 * p, 30 * p**2 - 10 * p**3])))]
    length = travelled[-1] if p_range == "normalized" else 40.0
    points, _ = polynomial_shape(u, v, length_m=length, p_range=p_range).at(np.array([length / 2, length]))
    half = np.interp(travelled[-1] / 2, travelled, p)
    expected = [[40 * half, 30 * half**2 - 10 * half**3], [40, 20]]
    np.testing.assert_allclose(points, expected, atol=2e-3)


def test_geometries_follow_one_another():
    pieces = (Geometry(0, 0, 0, 0, 10, Bend()), Geometry(10, 10, 0, 0, 5 * np.pi, Bend(0.1)))
    points, _ = reference_line(pieces, np.array([5.0, 10.0, 10 + 5 * np.pi]))
    np.testing.assert_allclose(points, [[5, 0], [10, 0], [20, 10]], atol=1e-9)
