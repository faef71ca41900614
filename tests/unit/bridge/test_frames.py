"""Fixed transforms: the tree of frames, and what is no rigid transform."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.bridge.frames import StaticFrames, rigid_from

Make = Callable[..., Any]
NONE = (0.0, 0.0, 0.0, 1.0)
#: A quarter turn to the left, about z.
LEFT = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))


def test_transforms_are_composed_up_and_down_the_tree(fixed_of: Make) -> None:
    """base is 0.1 m above foot. The mast stands 1 m ahead, turned left. The camera is 0.2 m ahead of the mast, so 0.2 m left of it."""
    frames = StaticFrames()
    frames.add(fixed_of(("base", "mast", (1.0, 0.0, 0.5, *LEFT)), ("mast", "camera", (0.2, 0.0, 0.0, *NONE))))
    frames.add(fixed_of(("foot", "base", (0.0, 0.0, 0.1, *NONE)), ("base", "laser", (0.0, -0.3, 0.0, *NONE))))
    T = frames.transform("foot", "camera")
    assert T is not None
    np.testing.assert_allclose(T[:3, 3], [1.0, 0.2, 0.6])
    np.testing.assert_allclose(T[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)
    across = frames.transform("laser", "camera")
    assert across is not None
    np.testing.assert_allclose(across[:3, 3], [1.0, 0.5, 0.5])
    back = frames.transform("camera", "foot")
    assert back is not None
    np.testing.assert_allclose(back @ T, np.eye(4), atol=1e-12)


def test_frames_that_are_not_connected_have_no_transform(fixed_of: Make) -> None:
    frames = StaticFrames()
    frames.add(fixed_of(("base", "camera", (1.0, 0.0, 0.0, *NONE)), ("other", "imu", (0.0, 0.0, 0.0, *NONE))))
    assert frames.transform("base", "imu") is None
    assert frames.transform("base", "nowhere") is None


def test_names_may_have_the_slash_of_ros_1(fixed_of: Make) -> None:
    frames = StaticFrames()
    frames.add(fixed_of(("/base", "/camera", (1.0, 0.0, 0.0, *NONE))))
    assert frames.transform("base", "camera") is not None
    assert frames.transform("/base", "/camera") is not None


def test_a_later_transform_replaces_the_earlier_one(fixed_of: Make) -> None:
    frames = StaticFrames()
    for x in (1.0, 2.0):
        frames.add(fixed_of(("base", "camera", (x, 0.0, 0.0, *NONE))))
    T = frames.transform("base", "camera")
    assert T is not None
    assert T[0, 3] == 2.0


def test_a_loop_of_frames_ends(fixed_of: Make) -> None:
    frames = StaticFrames()
    frames.add(fixed_of(("a", "b", (1.0, 0.0, 0.0, *NONE)), ("b", "a", (1.0, 0.0, 0.0, *NONE))))
    assert frames.transform("a", "elsewhere") is None


@pytest.mark.parametrize(
    "numbers",
    [
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (float("nan"), 0.0, 0.0, *NONE),
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, float("inf")),
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.4),
    ],
)
def test_what_is_no_rigid_transform_is_left_out(fixed_of: Make, numbers: tuple[float, ...]) -> None:
    frames = StaticFrames()
    frames.add(fixed_of(("base", "camera", numbers)))
    assert frames.transform("base", "camera") is None


def test_a_quaternion_is_normalised() -> None:
    at, turned = SimpleNamespace(x=1.0, y=2.0, z=3.0), SimpleNamespace(x=0.0, y=0.0, z=0.9, w=0.9)
    T = rigid_from(at, turned)
    assert T is not None
    np.testing.assert_allclose(T[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], [1.0, 2.0, 3.0])
