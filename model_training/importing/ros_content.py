"""Find out what a ROS bag contains: topics, poses, and mountings of LiDAR and camera. Scans and images are read later."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from model_training.importing.extrinsics import Extrinsics
from model_training.importing.ros_frames import FrameTree, stamp_of, transform_of
from model_training.importing.ros_picture import baseline_of, camera_of
from model_training.importing.ros_reader import BagReader, Damage
from model_training.importing.ros_stereo import StereoRig, lookups_of, offset_m, require_same_projection
from model_training.importing.ros_topics import POSE_TYPES, SIDES, Topics, topics_of
from model_training.importing.trajectory import Trajectory
from service.bridge.pictures import is_rectified_by_name
from service.errors import DatasetError, RequestError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Transform
from service.option_limits import LEAST_BASELINE_M, MOST_BASELINE_M

_TF = POSE_TYPES[-1]


@dataclass(frozen=True, slots=True)
class BagSettings:
    """Settings of the reader of a bag.

    Attributes:
        topics: by role: scan, color, depth, right, info, right_info, poses.
        extrinsics: mountings that the bag does not contain.
        camera: intrinsics, if the bag has no CameraInfo.
        rectified: whether the images are rectified already; None decides by the topic's name.
        want_pictures: False needs neither intrinsics nor the camera's mounting.
        want_depth: False pairs no depth with colour.
        stereo: match left and right images. The topic of depth is not used then.
        baseline_m: of the stereo rig that measured the depth or whose pairs are matched, metres. It goes before the topic
            ``right_info``. None if it is not known or in this topic.
        max_points: a larger scan is refused.
    """

    topics: Mapping[str, str] = field(default_factory=dict)
    extrinsics: Extrinsics = field(default_factory=Extrinsics)
    camera: PinholeCamera | None = None
    rectified: bool | None = None
    want_pictures: bool = True
    want_depth: bool = True
    stereo: bool = False
    baseline_m: float | None = None
    max_points: int = 5_000_000


@dataclass(frozen=True, slots=True)
class BagCamera:
    """The camera of the colour topic.

    Attributes:
        pinhole: intrinsics and distortion.
        T_vehicle_camera: mounting of the optical frame (4, 4).
    """

    pinhole: PinholeCamera
    T_vehicle_camera: Transform


@dataclass(frozen=True, slots=True)
class BagContent:
    """Content of a bag.

    Attributes:
        topics: of each role.
        scan_frame: frame of the LiDAR.
        vehicle: frame that the poses belong to, for people.
        poses: T_map_vehicle; None if the bag has none.
        T_vehicle_lidar: maps points from the scan's frame to the vehicle frame (4, 4).
        camera: None if there are no images, or none are wanted.
        baseline_m: of the stereo rig that measured the depth, metres; None if it is not known.
        rig: whose pairs are matched; None if none are.
        remarks: what was assumed and left out, one line each.
    """

    topics: Topics
    scan_frame: str
    vehicle: str
    poses: Trajectory | None
    T_vehicle_lidar: Transform
    camera: BagCamera | None
    baseline_m: float | None
    rig: StereoRig | None
    remarks: tuple[str, ...]


def content_of(bag: BagReader, settings: BagSettings) -> BagContent:
    """Look through a bag.

    Args:
        bag: opened.
        settings: of the reader.

    Raises:
        DatasetError: the bag has no scan, a given topic does not fit, intrinsics or a mounting are missing, or the calibration of the
            right camera gives no baseline.
    """
    topics = topics_of(bag.topics(), settings.topics, source=bag.name, stereo=settings.stereo)
    scan_frame = bag.first(topics.scan.name).header.frame_id.lstrip("/")
    remarks: list[str] = []
    tree, poses, vehicle = _poses(bag, topics, remarks)
    T_given = settings.extrinsics.T_vehicle_lidar
    if topics.poses is not None and topics.poses.msgtype == _TF:
        poses, vehicle = _poses_by_tf(bag.name, tree, scan_frame, T_given)
    if T_given is not None:
        T_vehicle_lidar = T_given
    elif vehicle:
        T_vehicle_lidar = _mounting(bag.name, tree, vehicle, scan_frame, "T_vehicle_lidar")
    else:
        T_vehicle_lidar = np.eye(4)
    if settings.stereo and settings.want_pictures and topics.color is None:
        raise DatasetError(
            f"{bag.name}: --depth sgbm matches left and right images, and no image topic has a word for the left camera in its name "
            f"({', '.join(left for left, _ in SIDES)}); give --topic color=LEFT --topic right=RIGHT, or another --depth",
            field="color",
        )
    camera = (
        _camera(bag, topics, settings, tree, vehicle, scan_frame, T_vehicle_lidar) if settings.want_pictures else None
    )
    of = vehicle or ("the vehicle of --extrinsics" if T_given is not None else "the LiDAR")
    assumed = "" if vehicle or poses is None else " (assumed: the topic does not say)"
    remarks.insert(0, f"poses are of: {of}{assumed}")
    baseline_m = _baseline(bag, topics, settings)
    rig = _rig(bag, topics, settings, camera, baseline_m) if settings.stereo and camera is not None else None
    return BagContent(topics, scan_frame, of, poses, T_vehicle_lidar, camera, baseline_m, rig, tuple(remarks))


def _rig(
    bag: BagReader, topics: Topics, settings: BagSettings, camera: BagCamera, baseline_m: float | None
) -> StereoRig:
    """The stereo rig of the left and right images."""
    assert topics.color is not None  # noqa: S101  # there is a camera only with colour images
    if topics.right is None:
        raise DatasetError(
            f"{bag.name}: --depth sgbm matches left and right images, and no topic of right images fits {topics.color.name}; give "
            "--topic color=LEFT --topic right=RIGHT, or another --depth",
            field="right",
        )
    if baseline_m is None:
        raise DatasetError(
            f"{bag.name}: --depth sgbm needs the distance of the cameras, and no calibration of the right camera was found; give its "
            "CameraInfo with --topic right_info=NAME, or --baseline-m METRES",
            field="right_info",
        )
    infos = [None if topic is None else bag.first(topic.name) for topic in (topics.info, topics.right_info)]
    if settings.baseline_m is None and infos[0] is not None:
        # The right camera's P counts from the origin of the rig, which need not be the left camera.
        baseline_m = _from_left(baseline_m + offset_m(infos[0]), source=bag.name)
    left, right = infos if settings.camera is None else (None, None)
    if is_rectified(topics, settings):
        if left is not None and right is not None:
            require_same_projection(left, right, source=bag.name)
        if camera.pinhole.distortion:
            raise DatasetError(
                f"{bag.name}: the camera of --camera has a lens, and matching needs rectified images; give the camera of the rectified "
                "images, or record the CameraInfo of both cameras",
                field="camera",
            )
        return StereoRig(camera.pinhole, baseline_m)
    if left is None or right is None:
        raise DatasetError(
            f"{bag.name}: the images of {topics.color.name} are raw, and only the CameraInfo of both cameras says how to rectify them; "
            "give --topic info=LEFT --topic right_info=RIGHT, or --rectified if they are rectified",
            field="info",
        )
    return StereoRig(camera.pinhole, baseline_m, lookups_of(left, right, source=bag.name))


def is_rectified(topics: Topics, settings: BagSettings) -> bool:
    """Return whether the images of a bag are rectified: as given, or by the name of their topic.

    Args:
        topics: of the bag, with colour images.
        settings: of the reader.
    """
    assert topics.color is not None  # noqa: S101
    return is_rectified_by_name(topics.color.name) if settings.rectified is None else settings.rectified


def _baseline(bag: BagReader, topics: Topics, settings: BagSettings) -> float | None:
    """Baseline as given, or from the calibration of the right camera, metres; None if there is neither. A given one counts first."""
    if settings.baseline_m is not None or topics.right_info is None:
        return settings.baseline_m
    try:
        return baseline_of(bag.first(topics.right_info.name), topics.right_info.name)
    except RequestError as error:
        raise DatasetError(f"{bag.name}, topic {error.message}", field="right_info") from error


def _from_left(baseline_m: float, *, source: str) -> float:
    """Refuse a baseline that no pair of a left and a right camera has."""
    if not LEAST_BASELINE_M <= baseline_m <= MOST_BASELINE_M:
        raise DatasetError(
            f"{source}: P[0, 3] of both CameraInfos means a baseline of {baseline_m:g} m from the left to the right camera, outside "
            f"{LEAST_BASELINE_M:g} to {MOST_BASELINE_M:g} m; if the cameras are swapped, give --topic color=LEFT --topic right=RIGHT "
            "--topic info=LEFT_INFO --topic right_info=RIGHT_INFO, otherwise give --baseline-m METRES",
            field="right_info",
        )
    return baseline_m


def _poses(bag: BagReader, topics: Topics, remarks: list[str]) -> tuple[FrameTree, Trajectory | None, str]:
    """Read all of ``/tf``, and the poses of a topic with their frame; '' if the topic does not name the frame."""
    tree, topic = FrameTree(), topics.poses
    stamps: list[float] = []
    poses: list[Transform] = []
    vehicle, left_out = "", 0
    wanted = {t.name for t in bag.topics() if t.msgtype == _TF} | ({topic.name} if topic else set())
    for found in bag.messages(wanted):
        if isinstance(found, Damage):
            left_out += not found.is_end
            remarks += [f"poses: {found.why}"] if found.is_end else []
        elif found.msgtype == _TF:
            is_static = found.topic.rstrip("/").endswith("tf_static")
            left_out += sum(not tree.add(edge, static=is_static) for edge in found.content.transforms)
        else:
            vehicle = getattr(found.content, "child_frame_id", "").lstrip("/") or vehicle
            stamp_s, T = stamp_of(found.content.header), _pose(found.content)
            if T is None or (stamps and stamp_s <= stamps[-1]):
                left_out += 1
            else:
                stamps.append(stamp_s)
                poses.append(T)
    if left_out:
        remarks.append(f"poses: {left_out} left out: not finite, or not later than the pose before")
    if topic is None or topic.msgtype == _TF:
        return tree, None, ""
    return (
        tree,
        Trajectory(np.array(stamps), np.array(poses).reshape(-1, 4, 4), f"{bag.name}, topic {topic.name}"),
        vehicle,
    )


def _pose(message: Any) -> Transform | None:
    """Pose of an Odometry, PoseStamped or PoseWithCovarianceStamped message; None if it is invalid."""
    return transform_of(message.pose.pose if hasattr(message.pose, "pose") else message.pose)


def _poses_by_tf(
    name: str, tree: FrameTree, scan_frame: str, T_vehicle_lidar: Transform | None
) -> tuple[Trajectory | None, str]:
    """Poses from ``/tf``, and their frame.

    The frame is the LiDAR's. If ``/tf`` lacks the LiDAR and its mounting is given, it is the frame that moves.
    """
    found = tree.moving(scan_frame, name=f"{name}, /tf")
    if found is not None and T_vehicle_lidar is None:
        return found[1], scan_frame
    if found is not None and T_vehicle_lidar is not None:
        return found[1].moved_by(T_vehicle_lidar), ""
    vehicle = tree.lowest_that_moves() if T_vehicle_lidar is not None else None
    found = None if vehicle is None else tree.moving(vehicle, name=f"{name}, /tf")
    return (None, "") if vehicle is None or found is None else (found[1], vehicle)


def _camera(
    bag: BagReader,
    topics: Topics,
    settings: BagSettings,
    tree: FrameTree,
    vehicle: str,
    scan_frame: str,
    T_vehicle_lidar: Transform,
) -> BagCamera | None:
    """The camera of the colour topic, if there is one."""
    if topics.color is None:
        return None
    if topics.info is None and settings.camera is None:
        raise DatasetError(
            f"{bag.name}: {topics.color.name} has no sensor_msgs/CameraInfo, so its images cannot be used; give the "
            "camera with --camera FILE, give its topic with --topic info=..., or pass --no-pictures",
            field="info",
        )
    if settings.camera is not None:
        pinhole, frame = settings.camera, bag.first(topics.color.name).header.frame_id
    else:
        assert topics.info is not None  # noqa: S101  # otherwise the error above was raised
        message = bag.first(topics.info.name)
        # pairs are rectified before they are matched
        found = camera_of(message, is_rectified=settings.stereo or is_rectified(topics, settings))
        if isinstance(found, str):
            raise DatasetError(
                f"{bag.name}, topic {topics.info.name}: {found}; give the camera with --camera FILE", field="info"
            )
        pinhole, frame = found, message.header.frame_id
    T = settings.extrinsics.T_vehicle_camera
    if T is None and vehicle and (known := tree.fixed(vehicle, frame)) is not None:
        T = known
    if T is None:  # use the LiDAR as an intermediate frame: --extrinsics may give its mounting
        T = T_vehicle_lidar @ _mounting(bag.name, tree, scan_frame, frame, "T_vehicle_camera")
    return BagCamera(pinhole, T)


def _mounting(name: str, tree: FrameTree, target: str, source: str, key: str) -> Transform:
    found = tree.fixed(target, source)
    if found is None:
        raise DatasetError(
            f"{name}: /tf_static has no transform from {target!r} to {source!r}; give {key} in a JSON file with "
            "--extrinsics FILE",
            field=key,
        )
    return found
