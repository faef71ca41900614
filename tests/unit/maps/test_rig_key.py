"""Which rigs are the same. The camera has 640 x 480 pixels and fx = 320, so fx / width = 0.5."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.camera import PinholeCamera
from service.maps.rig_key import RigKey

CAMERA = {"width": 640, "height": 480, "fx": 320.0, "fy": 320.0, "cx": 319.5, "cy": 239.5}


def key(**changed):
    return RigKey.model_validate(CAMERA | changed)


@pytest.mark.parametrize(
    ("changed", "distance"),
    [
        ({}, 0.0),
        ({"fx": 304.5}, 15.5 / 320 / 0.05),  # 4.8 % less
        ({"fx": 303.0}, None),  # 5.3 % less
        ({"fy": 336.0}, 16 / 336 / 0.05),
        ({"fy": 338.0}, None),
        ({"cx": 319.5 + 16}, 0.5),  # 2.5 % of the width
        ({"cx": 319.5 + 33}, None),
        ({"cy": 239.5 - 25}, None),  # 5.2 % of the height
        ({"width": 600, "fx": 300.0, "cx": 299.5}, 40 / 640 / 0.1),  # the same field of view
        ({"width": 320, "height": 240, "fx": 160.0, "fy": 160.0, "cx": 159.5, "cy": 119.5}, None),  # half the size
        ({"baseline_m": 0.12}, None),
        ({"max_range_m": 10.0}, None),
    ],
)
def test_the_distance_is_the_largest_difference_in_units_of_its_tolerance(changed, distance):
    assert key().distance(key(**changed)) == (None if distance is None else pytest.approx(distance))


def test_baseline_and_range_limit_count_where_both_state_them():
    stereo = key(baseline_m=0.12, max_range_m=20.0)
    assert stereo.distance(key(baseline_m=0.126, max_range_m=20.0)) == pytest.approx(0.006 / 0.126 / 0.1)
    assert stereo.distance(key(baseline_m=0.14, max_range_m=20.0)) is None
    assert stereo.distance(key(baseline_m=0.12, max_range_m=10.0)) is None


def test_only_the_other_rig_may_lack_what_this_one_states():
    stereo, silent = key(baseline_m=0.12, max_range_m=20.0), key()
    assert stereo.distance(silent) is None
    assert stereo.distance(silent, other_may_lack=("baseline_m",)) is None
    assert stereo.distance(silent, other_may_lack=("baseline_m", "max_range_m")) == 0
    assert silent.distance(stereo, other_may_lack=("baseline_m", "max_range_m")) is None


def test_one_rig_may_be_described_with_and_without_its_range_limit():
    assert key(max_range_m=20.0).is_same(key())
    assert key().is_same(key(max_range_m=20.0))
    assert not key(baseline_m=0.12).is_same(key())
    assert not key(max_range_m=20.0).is_same(key(max_range_m=5.0))


def test_what_both_state_is_counted():
    assert key(baseline_m=0.1, max_range_m=5.0).stated_by_both(key(baseline_m=0.2)) == 1
    assert key(baseline_m=0.1, max_range_m=5.0).stated_by_both(key(baseline_m=0.1, max_range_m=5.0)) == 2
    assert key().stated_by_both(key(baseline_m=0.2)) == 0


def test_the_text_has_the_field_of_view():
    """640 pixels at fx = 320 are 90 degrees. 480 pixels at fy = 320 are 2 atan(0.75) = 73.7 degrees."""
    assert key().described() == "640 x 480 pixels, 90 x 74 degrees, no baseline, no range limit"
    stereo = key(baseline_m=0.12, max_range_m=20.0)
    assert stereo.described().endswith("baseline 0.12 m, range limit 20 m")


def test_the_key_of_a_camera():
    camera = PinholeCamera(640, 480, 320.0, 320.0, 319.5, 239.5)
    assert RigKey.of(camera, baseline_m=0.12, max_range_m=None) == key(baseline_m=0.12)


_FACTORS = st.floats(0.8, 1.25)


@given(_FACTORS, _FACTORS, st.none() | st.floats(0.05, 1.0), st.none() | st.floats(0.05, 1.0))
def test_the_distance_is_symmetric(across, down, one, other):
    first = key(baseline_m=one)
    second = key(fx=320 * across, fy=320 * down, baseline_m=other)
    assert first.distance(second) == second.distance(first)
    assert first.is_same(second) == second.is_same(first)
