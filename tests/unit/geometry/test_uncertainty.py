import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.uncertainty import covariance_at

vectors = st.tuples(*[st.floats(-1e4, 1e4)] * 3).map(np.array)


@given(lever=vectors, spread=st.integers(0, 1000))
def test_covariance_is_carried_along_a_body_as_small_motions_are(lever, spread):
    """Six small motions move the body. The other point moves by each translation, and by its rotation times the lever arm."""
    motions = np.random.default_rng(spread).normal(size=(6, 6))
    moved = np.c_[motions[:, :3] + np.cross(motions[:, 3:], lever), motions[:, 3:]]
    at = np.array([3.0, -2.0, 1.0])
    scale = 1 + np.linalg.norm(lever) ** 2
    np.testing.assert_allclose(
        covariance_at(motions.T @ motions, at, at + lever) / scale, moved.T @ moved / scale, atol=1e-9
    )


def test_covariance_at_the_same_point_stays():
    covariance = np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(covariance_at(covariance, np.ones(3), np.ones(3)), covariance)
