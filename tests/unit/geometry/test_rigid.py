import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.geometry.rigid import (
    R_BODY_OPTICAL,
    heading_of_body,
    heading_of_camera,
    inverse,
    quaternion_xyzw_from,
    rotation_from_quaternion_xyzw,
    rotation_taking,
    rotation_x,
    rotation_y,
    rotation_z,
    transform_from,
    transform_points,
    wrap_angle,
)

coordinate = st.floats(-1e4, 1e4)
vectors = st.tuples(coordinate, coordinate, coordinate).map(np.array)
quaternions = (
    st.tuples(*[st.floats(-1, 1)] * 4)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)
units = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)
units = units.map(lambda v: v / np.linalg.norm(v))


@pytest.mark.parametrize(
    ("rotation", "point", "expected"),
    [
        (rotation_x(np.pi / 2), [0, 1, 0], [0, 0, 1]),
        (rotation_y(np.pi / 2), [0, 0, 1], [1, 0, 0]),
        (rotation_z(np.pi / 2), [1, 0, 0], [0, 1, 0]),
        (rotation_z(np.pi / 6), [2, 0, 5], [np.sqrt(3), 1, 5]),
    ],
)
def test_positive_angles_turn_counter_clockwise_about_their_axis(rotation, point, expected):
    np.testing.assert_allclose(rotation @ np.array(point, float), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("optical", "body"), [([0, 0, 1], [1, 0, 0]), ([1, 0, 0], [0, -1, 0]), ([0, 1, 0], [0, 0, -1])]
)
def test_the_optical_axes_lie_in_the_body_as_rep_103_says(optical, body):
    np.testing.assert_array_equal(R_BODY_OPTICAL @ np.array(optical, float), body)


def test_a_transform_turns_first_and_moves_then():
    T_map_body = transform_from(rotation_z(np.pi / 2), np.array([10.0, 20.0, 3.0]))
    moved = transform_points(T_map_body, np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 1.0]]))
    np.testing.assert_allclose(moved, [[10, 21, 3], [8, 20, 4]], atol=1e-12)


@given(quaternions, vectors, vectors)
def test_the_inverse_brings_points_back(q, translation, point):
    T_a_b = transform_from(rotation_from_quaternion_xyzw(q), translation)
    back = transform_points(inverse(T_a_b), transform_points(T_a_b, point[None]))
    np.testing.assert_allclose(back[0], point, atol=1e-9)


@given(quaternions, vectors, vectors)
def test_a_transform_keeps_distances(q, a, b):
    T = transform_from(rotation_from_quaternion_xyzw(q), a + b)
    moved = transform_points(T, np.stack([a, b]))
    assert abs(np.linalg.norm(moved[1] - moved[0]) - np.linalg.norm(b - a)) < 1e-8


@given(quaternions)
def test_rotation_of_a_quaternion_is_scipys(q):
    np.testing.assert_allclose(rotation_from_quaternion_xyzw(q), Rotation.from_quat(q).as_matrix(), atol=1e-12)


@given(quaternions)
def test_quaternion_of_a_rotation_is_scipys_with_positive_w(q):
    found = quaternion_xyzw_from(Rotation.from_quat(q).as_matrix())
    expected = Rotation.from_quat(q).as_quat()
    assert found[3] >= 0
    np.testing.assert_allclose(np.abs(found @ expected), 1.0, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_half_turn_has_the_quaternion_of_its_axis(axis):
    R = -np.eye(3)
    R[axis, axis] = 1.0
    np.testing.assert_allclose(np.abs(quaternion_xyzw_from(R)), np.eye(4)[axis], atol=1e-12)


@given(units, units)
def test_rotation_taking_turns_one_vector_into_the_other(a, b):
    R = rotation_taking(a, b)
    np.testing.assert_allclose(R @ a, b, atol=1e-6)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)


@given(units, units)
def test_rotation_taking_turns_no_further_than_it_must(a, b):
    between = np.arccos(np.clip(a @ b, -1, 1))
    assert abs(Rotation.from_matrix(rotation_taking(a, b)).magnitude() - between) < 1e-5


@given(units)
def test_rotation_taking_a_vector_into_its_opposite_is_a_half_turn(a):
    R = rotation_taking(a, -a)
    np.testing.assert_allclose(R @ a, -a, atol=1e-9)
    assert abs(np.linalg.det(R) - 1.0) < 1e-9


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [(0.0, 0.0), (np.pi, -np.pi), (-np.pi, -np.pi), (1.5 * np.pi, -0.5 * np.pi), (-7.0, 2 * np.pi - 7.0)],
)
def test_angles_are_wrapped_from_minus_pi_on(angle, wrapped):
    assert wrap_angle(angle) == pytest.approx(wrapped, abs=1e-12)


@given(st.floats(-3.1, 3.1), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_headings_of_camera_and_body_agree_on_one_vehicle(heading, pitch, roll):
    R_map_body = rotation_z(heading) @ rotation_y(pitch) @ rotation_x(roll)
    T_map_body = transform_from(R_map_body, np.zeros(3))
    T_map_camera = transform_from(R_map_body @ R_BODY_OPTICAL, np.zeros(3))
    assert heading_of_body(T_map_body) == pytest.approx(heading, abs=1e-9)
    assert heading_of_camera(T_map_camera) == pytest.approx(heading, abs=1e-9)


@given(st.integers(0, 10**6), st.sampled_from([0, 1, 7, 300]))
def test_transformed_points_are_the_product_and_the_sum_to_the_bit(seed, count):
    rng = np.random.default_rng(seed)
    points, T = (
        rng.uniform(-1e3, 1e3, (count, 3)),
        transform_from(Rotation.random(rng=rng).as_matrix(), rng.uniform(-1e6, 1e6, 3)),
    )
    given_points = points.copy()
    assert transform_points(T, points).tobytes() == (points @ T[:3, :3].T + T[:3, 3]).tobytes()
    np.testing.assert_array_equal(points, given_points)
