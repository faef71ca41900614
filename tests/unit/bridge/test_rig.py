from collections.abc import Callable
from typing import Any

import pytest

from service.bridge.rig import StereoRig, baseline_from
from service.errors import RequestError


def projection(fx: float, shift: float) -> list[float]:
    return [fx, 0.0, 300.0, shift, 0.0, fx, 200.0, 0.0, 0.0, 0.0, 1.0, 0.0]


def test_the_baseline_is_the_shift_over_the_focal_length(info_of: Callable[..., Any]) -> None:
    """KITTI's right camera: P[0, 3] = -386.1448 px m and fx = 718.856 px, so 0.53717 m."""
    assert baseline_from(info_of(p=projection(718.856, -386.1448)), "/right") == pytest.approx(0.53717, abs=1e-5)


@pytest.mark.parametrize(
    ("fx", "shift", "means"),
    [
        (400.0, 0.0, "P[0, 3] of 0 and fx of 400 px mean a baseline of 0 m"),  # the left camera
        (400.0, 20.0, "P[0, 3] of 20 and fx of 400 px mean a baseline of -0.05 m"),  # to the left of the left one
        (400.0, -80000.0, "mean a baseline of 200 m, outside 0.001 to 100 m"),
        (0.0, -20.0, "fx of 0 px mean a baseline of 0 m"),  # not calibrated
        (float("nan"), -20.0, "mean a baseline of 0 m"),
        (400.0, float("nan"), "mean a baseline of nan m"),
    ],
)
def test_another_calibration_is_refused_with_the_remedy(
    info_of: Callable[..., Any], fx: float, shift: float, means: str
) -> None:
    with pytest.raises(RequestError) as caught:
        baseline_from(info_of(p=projection(fx, shift)), "/right")
    assert means in caught.value.message
    assert caught.value.message.endswith("name the CameraInfo of the rectified right camera, or give --baseline-m")
    assert caught.value.field == "/right"


def test_a_baseline_that_is_given_needs_no_calibration() -> None:
    given = StereoRig(0.12, "/right")
    assert (given.topic, given.is_missing, given.baseline_m()) == ("", False, 0.12)
    none = StereoRig()
    assert (none.topic, none.is_missing, none.baseline_m()) == ("", False, None)


def test_the_newest_calibration_counts(info_of: Callable[..., Any]) -> None:
    rig = StereoRig(topic="/right")
    assert (rig.is_missing, rig.baseline_m()) == (True, None)
    for shift in (-20.0, -40.0):
        rig.info(info_of(p=projection(400.0, shift)))
    assert (rig.is_missing, rig.baseline_m()) == (False, 0.1)
