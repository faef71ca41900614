from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from service.bridge.notices import Notices
from service.bridge.odometry import Odometry

S, MS = 10**9, 10**6
Make = Callable[..., Any]


@pytest.fixture
def odometry() -> Odometry:
    return Odometry("/odom", Notices())


def test_the_pose_at_the_stamp_of_an_image_is_interpolated(odometry: Odometry, odometry_of: Make) -> None:
    odometry.add(odometry_of(1 * S, 2.0, 0.0, child="/base_footprint"))
    odometry.add(odometry_of(1 * S + 20 * MS, 2.0, 0.5, child="/base_footprint"))
    pose = odometry.at(1 * S + 5 * MS)
    assert pose is not None
    np.testing.assert_allclose(pose.T_odom[:3, 3], [2.0, 0.125, 0.0])
    assert odometry.body_frame == "base_footprint"
    newest = odometry.newest()
    assert newest is not None
    assert newest.T_odom[1, 3] == 0.5


def test_without_messages_nothing_is_known_and_nothing_is_waited_for(odometry: Odometry) -> None:
    assert odometry.is_ready(7 * S)
    assert (odometry.at(7 * S), odometry.newest()) == (None, None)


def test_an_image_waits_for_a_message_that_is_not_older(odometry: Odometry, odometry_of: Make) -> None:
    odometry.add(odometry_of(1 * S, 0.0, 0.0))
    assert odometry.is_ready(1 * S)
    assert not odometry.is_ready(1 * S + 1)
    odometry.stop_waiting()
    assert odometry.is_ready(1 * S + 1)
    odometry.add(odometry_of(1 * S + 10 * MS, 0.0, 0.0))
    assert odometry.is_ready(1 * S + 10 * MS)
    assert not odometry.is_ready(1 * S + 11 * MS)


@pytest.mark.parametrize("changed", [{"frame": "other"}, {"child": "other"}])
def test_other_frames_begin_again(odometry: Odometry, odometry_of: Make, changed: dict[str, str]) -> None:
    odometry.add(odometry_of(1 * S, 0.0, 0.0))
    before = odometry.newest()
    odometry.add(odometry_of(2 * S, 0.0, 0.0, **changed))
    after = odometry.newest()
    assert before is not None
    assert after is not None
    assert after.session == before.session + 1
    assert odometry.at(1 * S) is None


def test_a_pose_that_is_none_is_reported(odometry_of: Make) -> None:
    notices = Notices()
    odometry = Odometry("/odom", notices)
    odometry.add(odometry_of(1 * S, float("nan"), 0.0))
    assert odometry.newest() is None
    (told,) = notices.take()
    assert told.startswith("/odom: a pose is not finite, or its quaternion is no rotation, so the bridge skips")
    assert told.endswith("correct the publisher, or name another --odom-topic")
