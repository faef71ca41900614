import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model_training.evaluation.pose_errors import pose_errors
from service.geometry.rigid import transform_from

vectors = st.tuples(*[st.floats(-1.5, 1.5)] * 3).map(np.array)


@given(vectors, vectors, vectors)
def test_errors_are_metres_and_the_rotation_vector_about_the_axes_of_the_map(moved_m, turned_rad, true_rad):
    T_true = transform_from(Rotation.from_rotvec(true_rad).as_matrix(), np.array([4.0, 5.0, 6.0]))
    T_answer = transform_from(Rotation.from_rotvec(turned_rad).as_matrix() @ T_true[:3, :3], T_true[:3, 3] + moved_m)
    found = pose_errors(np.array([T_answer, T_true]), np.array([T_true, T_true]))
    np.testing.assert_allclose(found, [[*moved_m, *turned_rad], [0] * 6], atol=1e-7)
