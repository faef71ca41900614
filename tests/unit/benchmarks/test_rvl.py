import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.serving.rvl import write_rvl
from service.imaging.picture_headers import DEFAULT_LIMITS
from service.imaging.ros_depth import read_ros_depth


def read(data):
    return read_ros_depth(bytes(12) + data, DEFAULT_LIMITS, field="depth")


@given(st.integers(0, 10**6), st.integers(1, 9), st.integers(1, 40), st.sampled_from([0.0, 0.3, 1.0]))
def test_the_service_reads_what_is_written(seed, height, width, holes):
    rng = np.random.default_rng(seed)
    values = rng.integers(1, 65536, (height, width)).astype(np.uint16)
    values[rng.random(values.shape) < holes] = 0
    np.testing.assert_array_equal(read(write_rvl(values)), values)


@pytest.mark.parametrize("flat", [[0, 0, 0], [5, 5, 5], [0, 7, 0], [7, 0, 65535], [1, 65535, 1]])
def test_runs_at_either_end_are_kept(flat):
    values = np.array([flat], np.uint16)
    np.testing.assert_array_equal(read(write_rvl(values)), values)


def test_smooth_depth_takes_two_nibbles_a_pixel_at_most():
    values = (1000 + np.add.outer(np.arange(48), np.arange(64))).astype(np.uint16)
    assert len(write_rvl(values)) < values.size + 40
