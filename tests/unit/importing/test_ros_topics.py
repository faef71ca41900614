import pytest

from model_training.importing.ros_topics import ROLES, Topic, topics_of
from service.errors import DatasetError

SCAN = Topic("/points", "sensor_msgs/msg/PointCloud2", 10)


def image(name, count=10, kind="Image"):
    return Topic(name, f"sensor_msgs/msg/{kind}", count)


def info(name):
    return Topic(name, "sensor_msgs/msg/CameraInfo", 10)


def chosen(available, told=None):
    topics = topics_of([SCAN, *available], told or {}, source="drive.mcap")
    return {role: getattr(topics, role) and getattr(topics, role).name for role in ("color", "depth", "info", "poses")}


def test_colour_depth_and_camera_of_one_namespace_go_together():
    available = [
        info("/rear/color/camera_info"),
        info("/front/color/camera_info"),
        image("/front/color/image_raw", 20),
        image("/rear/depth/image"),
        image("/front/depth/image"),
        image("/front/aligned_depth_to_color/image_raw"),
        image("/front/infra1/image", 99),
    ]
    expected = {
        "color": "/front/color/image_raw",
        "depth": "/front/aligned_depth_to_color/image_raw",
        "info": "/front/color/camera_info",
    }
    assert chosen(available) == expected | {"poses": None}


@pytest.mark.parametrize(
    ("types", "best"),
    [
        (["geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"], 1),
        (["tf2_msgs/msg/TFMessage", "geometry_msgs/msg/PoseStamped"], 1),
    ],
)
def test_odometry_is_taken_before_poses_and_those_before_tf(types, best):
    available = [Topic(f"/t{k}/tf", msgtype, 5) for k, msgtype in enumerate(types)]
    assert chosen(available)["poses"] == f"/t{best}/tf"


def test_mountings_alone_are_no_poses_and_empty_topics_are_none():
    available = [Topic("/tf_static", "tf2_msgs/msg/TFMessage", 1), Topic("/odom", "nav_msgs/msg/Odometry", 0)]
    assert chosen(available)["poses"] is None


def test_given_values_are_not_guessed_and_lines_list_them():
    available = [image("/a"), image("/b", 99)]
    topics = topics_of([SCAN, *available], {"color": "/a"}, source="x")
    assert topics.lines()[:2] == ("scan: /points, 10 x PointCloud2 (guessed)", "color: /a, 10 x Image")
    assert topics.lines()[-1] == "poses: none"


def test_the_right_topics_of_a_stereo_rig_have_the_names_of_the_left_ones_and_no_depth_is_chosen():
    available = [
        image("/mono/image_rect", 99),
        image("/stereo/left/image_raw"),
        image("/stereo/left/image_rect/compressed", kind="CompressedImage"),
        image("/stereo/right/image_raw"),
        image("/stereo/right/image_rect/compressed", kind="CompressedImage"),
        image("/stereo/depth"),
        info("/stereo/right/camera_info"),
        info("/stereo/left/camera_info"),
    ]
    topics = topics_of([SCAN, *available], {}, source="x", stereo=True)
    found = [getattr(topics, role) and getattr(topics, role).name for role in ROLES]
    sides = [f"/stereo/{side}/image_rect/compressed" for side in ("left", "right")]
    assert found == ["/points", sides[0], None, sides[1], "/stereo/left/camera_info", "/stereo/right/camera_info", None]
    assert f"right: {sides[1]}, 10 x CompressedImage (guessed)" in topics.lines()
    without = topics_of([SCAN, *available], {}, source="x")
    assert (without.right, without.right_info) == (None, None)
    assert not [line for line in without.lines() if line.startswith("right:")]


def test_the_right_camera_is_never_guessed_and_is_not_the_left_one_once_given():
    available = [image("/left/image"), info("/right/camera_info"), info("/left/camera_info")]
    assert topics_of([SCAN, *available], {}, source="x").right_info is None
    given = topics_of([SCAN, *available], {"right_info": "/right/camera_info"}, source="x")
    names = [topic and topic.name for topic in (given.right_info, given.info)]
    assert names == ["/right/camera_info", "/left/camera_info"]
    assert "right_info: /right/camera_info, 10 x CameraInfo" in given.lines()


@pytest.mark.parametrize(
    ("told", "why"),
    [
        ({"colour": "/a"}, "'colour' is not a valid role; choose one of: scan, color"),
        ({"scan": "/velodyne"}, "drive.mcap has no topic '/velodyne'; it has: /a, /points"),
        (
            {"scan": "/a"},
            "topic '/a' is sensor_msgs/msg/Image; for scan the type must be one of: sensor_msgs/msg/PointCloud2",
        ),
    ],
)
def test_a_topic_that_does_not_fit_is_refused_with_those_there_are(told, why):
    with pytest.raises(DatasetError, match=why):
        topics_of([SCAN, image("/a")], told, source="drive.mcap")


def test_a_bag_without_a_point_cloud_says_what_it_has():
    with pytest.raises(DatasetError, match=r"no sensor_msgs/PointCloud2.*it has: /a \(sensor_msgs/msg/Image\)"):
        topics_of([image("/a")], {}, source="drive.mcap")


@pytest.mark.parametrize(
    ("told", "roles"),
    [
        ({"color": "/left/image", "right": "/left/image"}, "color and for right"),
        ({"info": "/left/info", "right_info": "/left/info"}, "info and for right_info"),
    ],
)
def test_a_topic_has_one_role(told, roles):
    available = [SCAN, image("/left/image"), image("/right/image"), info("/left/info")]
    with pytest.raises(DatasetError, match=f"is given for {roles}; give each role a topic of its own") as caught:
        topics_of(available, told, source="drive.mcap", stereo=True)
    assert caught.value.field == "topic"
