import numpy as np
import pytest

from service.imaging.depth_unit_hint import unit_factor, unit_hint


@pytest.mark.parametrize(
    ("values", "factor"),
    [
        ([5000.0, 5000.0, 5000.0], 0.001),
        ([300.0], 0.001),
        ([60_000.0], 0.001),
        ([299.0], None),  # 0.299 m
        ([60_001.0], None),  # 60.001 m
        ([0.005], 1000.0),
        ([0.0003], 1000.0),
        ([0.06], 1000.0),
        ([0.0002], None),
        ([0.061], None),
        ([0.3], None),
        ([60.0], None),
        ([0.0, np.nan, np.inf, -1.0], None),
        ([0.0, np.nan, np.inf, -1.0, 4000.0], 0.001),
        ([5000.0] * 99 + [5.0], None),  # one in a hundred is plausible in metres
        ([5000.0] * 100 + [5.0], 0.001),
        ([1000.0] * 60 + [8.0] * 40, None),  # a simulator's sky at its far plane
    ],
)
def test_a_factor_is_found_only_where_the_depth_makes_no_sense_as_metres(values, factor):
    assert unit_factor(np.array([values], np.float32)) == factor


def test_the_hint_names_the_median_and_the_scale():
    assert unit_hint(np.array([[4000.0, 5000.0, 9000.0, 0.0]], np.float32)) == (
        "the median depth is 5000 m, which looks like millimetres; send depth.scale_m = 0.001, or multiply the scale that you sent by "
        "0.001 (for disparity, divide it by 0.001)"
    )
    assert unit_hint(np.array([[0.004, 0.005, 0.009]], np.float32)) == (
        "the median depth is 0.005 m, which looks like metres that were read as millimetres; send depth.scale_m = 1, or multiply the "
        "scale that you sent by 1000 (for disparity, divide it by 1000)"
    )
    assert unit_hint(np.array([[4.0]], np.float32)) is None
