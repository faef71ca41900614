"""From messages to answers: frames of a moving robot settle what one frame leaves open."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from service.bridge.bridge import Bridge, Topics
from service.bridge.in_place import InPlace
from service.bridge.known import Known, Motion
from service.bridge.mounting import MountingRule
from service.bridge.notices import Notices
from service.bridge.odometry import Odometry
from service.bridge.pose import CAMERA_AS_BODY
from service.bridge.publish_policy import PublishPolicy
from service.bridge.robot import Robot
from service.maps.content import BundleContent
from service.maps.writer import write_bundle

S = 10**9
Make = Callable[..., Any]


@pytest.fixture(scope="module")
def unsure_map(
    content_of: Callable[..., BundleContent],
    constant_calibration: Callable[..., dict[str, Any]],
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A map whose calibration gives each frame a confidence of 0.8, below the threshold of 0.9."""
    folder: Path = tmp_path_factory.mktemp("tracks") / "tiny"
    write_bundle(folder, content_of(calibration=constant_calibration(right=0.8, known=0.95, threshold=0.9)))
    return folder


@pytest.mark.parametrize(
    ("step_m", "statuses"), [(1.0, ["AMBIGUOUS", "LOCALIZED"]), (0.0, ["AMBIGUOUS"] * 2), (None, ["AMBIGUOUS"] * 2)]
)
def test_a_robot_that_is_ambiguous_becomes_localized_with_more_frames(
    unsure_map: Path,
    pictures: Any,
    image_of: Make,
    info_of: Make,
    odometry_of: Make,
    step_m: float | None,
    statuses: list[str],
) -> None:
    """The robot sends one picture again. So it must say that it moved, or the picture is no new evidence. In the map of one street, 1 m
    lies within the uncertainty of a pose. Without odometry nothing connects the frames."""
    rgb, depth_m, camera = pictures
    odometry = Odometry("/odom", Notices())
    robot = Robot(rule=MountingRule(mount=CAMERA_AS_BODY), odometry=odometry)
    policy = PublishPolicy(rate_hz=0.0, min_confidence=0.0)
    bridge = Bridge(localize=InPlace(unsure_map), topics=Topics(odom="/odom"), policy=policy, robot=robot)
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    told = []
    for second in (1, 2):
        bridge.pairs.info(info_of(second * S, width=camera.width, height=camera.height, k=k))
        bridge.pairs.color(image_of(rgb, "rgb8", second * S))
        bridge.pairs.depth(image_of(depth_m, "32FC1", second * S))
        if step_m is not None:
            bridge.handlers()["odom"](odometry_of(second * S, second * step_m, 0.0))
        published = bridge.step()
        assert published is not None
        assert published.answer is not None
        told.append(published)
    assert [dict(each.diagnosis.values)["status"] for each in told] == statuses
    assert [each.pose is not None for each in told] == [status == "LOCALIZED" for status in statuses]
    assert [dict(each.diagnosis.values)["track"] for each in told] == (
        ["none", "none"] if step_m is None else ["begins", "continues"]
    )
    beliefs = [dict(each.diagnosis.values)["belief"] for each in told]
    if step_m is None:
        assert beliefs == ["none", "none"]
    else:
        assert beliefs[0] == "0.800"
        assert (float(beliefs[1]) > 0.9) == (statuses[1] == "LOCALIZED")


def test_a_query_alone_ends_the_track_in_this_process_too(unsure_map: Path, pictures: Any) -> None:
    localize = InPlace(unsure_map)
    assert localize(*(*pictures, Known(motion=Motion()))).belief is not None
    assert localize(*(*pictures, Known())).belief is None
    assert localize._track.frames == ()
