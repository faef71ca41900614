"""Settings of the bridge: options of ``streetfix bridge ros2``, and parameters of the ROS node in ``deploy/ros2``."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

#: Types of ROS parameters that the bridge has.
Parameter = str | float | int | bool
#: Where the direction of gravity in the camera frame comes from.
GravitySource = Literal["mounting", "imu", "none"]
#: Settings that are files or folders.
_PATHS = frozenset({"map", "ca", "cert", "key"})


@dataclass(frozen=True, slots=True, kw_only=True)
class BridgeSettings:
    """Settings that do not depend on the middleware. ``about`` returns the meaning of each.

    Attributes:
        url: of the service.
        map: folder of a map bundle that answers in this process; None sends queries to the service.
        map_name: name of the map that the service uses.
        api_key: of the service.
        ca: PEM file of the authorities of the service's certificate.
        cert: PEM file of the client's certificate.
        key: PEM file of the private key of ``cert``.
        color_topic: see ``Topics``.
        depth_topic: see ``Topics``.
        info_topic: see ``Topics``.
        pose_topic: see ``Topics``.
        diagnostics_topic: see ``Topics``.
        frame: of the poses.
        mount: see ``mount_from``.
        tf_static_topic: see ``Topics``.
        base_frame: see ``MountingRule``.
        ground_frame: see ``MountingRule``.
        base_on_ground: ``base_frame`` or the frame of ``mount`` is a ``ground_frame``.
        camera_height_m: see ``measured_height``.
        camera_height_std_m: standard deviation of the height, metres; 0 for the usual one.
        gravity: see ``Robot``.
        imu_topic: see ``Topics``.
        odom_topic: see ``Topics``.
        odometry_noise: standard deviation of the odometry as a share of the distance and of the angle; 0 for the usual one.
        prior_topic: see ``Topics``.
        prior_age: see ``InitialPoses``, seconds.
        rectified: see ``camera_from``.
        baseline_m: see ``StereoRig``, metres.
        right_info_topic: see ``StereoRig``.
        rate: see ``PublishPolicy``, Hz.
        min_confidence: see ``PublishPolicy``.
        false_accept_rate: tolerated share of out-of-map queries that become LOCALIZED; 0 for that of the service.
        tolerance: see ``Pairs``, seconds.
        reliable: request lost images again.
        queue: images that wait during a query.
    """

    url: Annotated[str, "URL of the service."] = "http://127.0.0.1:8000"
    map: Annotated[Path | None, "Answer from this map bundle in this process. The bridge then uses no service."] = None
    map_name: Annotated[
        str | None, "Name of the map that the service uses. Required if the service has several maps."
    ] = None
    api_key: Annotated[str | None, "API key, if the service requires one."] = None
    ca: Annotated[Path | None, "PEM file of the authorities that may sign the service's certificate."] = None
    cert: Annotated[Path | None, "PEM file of this client's certificate, if the service requires one."] = None
    key: Annotated[Path | None, "PEM file of the private key of the client's certificate."] = None
    color_topic: Annotated[str, "sensor_msgs/Image: rgb8, bgr8, rgba8, bgra8, mono8."] = "/camera/color/image_raw"
    depth_topic: Annotated[str, "sensor_msgs/Image, registered to colour: 16UC1 (mm) or 32FC1 (m)."] = (
        "/camera/aligned_depth_to_color/image_raw"
    )
    info_topic: Annotated[str, "sensor_msgs/CameraInfo of the colour image."] = "/camera/color/camera_info"
    pose_topic: Annotated[str, "geometry_msgs/PoseWithCovarianceStamped."] = "/initialpose"
    diagnostics_topic: Annotated[str, "diagnostic_msgs/DiagnosticArray."] = "/diagnostics"
    frame: Annotated[str, "frame_id of the poses."] = "map"
    mount: Annotated[
        str | None,
        "Camera pose on the vehicle, X,Y,Z,QX,QY,QZ,QW as tf2_echo base_link OPTICAL_FRAME prints it. It replaces the transform from "
        "TF to --base-frame.",
    ] = None
    tf_static_topic: Annotated[
        str, "tf2_msgs/TFMessage, the fixed transforms of the robot. Empty: the bridge reads no TF."
    ] = "/tf_static"
    base_frame: Annotated[
        str,
        "Vehicle frame in TF. The bridge publishes the pose of this frame. If TF does not have it after 5 seconds, or if it is empty, "
        "the bridge publishes the camera's pose as a body (x forward, z up).",
    ] = "base_link"
    ground_frame: Annotated[
        str,
        "Frame in TF that lies on the ground under the vehicle, with its z axis up. The z of the camera in this frame is the camera's "
        "height. Empty, or not in TF: the depth image gives the height.",
    ] = "base_footprint"
    base_on_ground: Annotated[
        bool, "The frame of --mount, or else --base-frame, lies on the ground. It replaces --ground-frame."
    ] = False
    camera_height_m: Annotated[
        float,
        "Height of the camera above the ground, metres. It goes before --ground-frame and --base-on-ground. 0: they give the height, or "
        "else the depth image does.",
    ] = 0.0
    camera_height_std_m: Annotated[
        float,
        "Standard deviation of the camera's height, metres. 0: 0.05 with --camera-height-m, 0.1 with a height from TF or --mount.",
    ] = 0.0
    gravity: Annotated[
        GravitySource,
        "Where the downward direction in the camera frame comes from. mounting: TF or --mount, if the camera is tilted by more than 2 "
        "degrees. imu: the orientation on --imu-topic. none: the service finds the tilt in the depth image.",
    ] = "mounting"
    imu_topic: Annotated[str, "sensor_msgs/Imu with an orientation. The bridge reads it with --gravity imu only."] = (
        "/imu/data"
    )
    odom_topic: Annotated[
        str,
        "nav_msgs/Odometry, in a frame that never jumps. The queries then form a track: more frames make an ambiguous answer certain. "
        "Empty, or no messages: each query stands alone.",
    ] = "/odom"
    odometry_noise: Annotated[
        float,
        "Standard deviation of the odometry, as a share of the distance and of the angle. 0: 0.03. A robot whose feet slip needs more.",
    ] = 0.0
    prior_topic: Annotated[
        str,
        "geometry_msgs/PoseWithCovarianceStamped of the vehicle in the frame of --frame. It is the prior of the next queries, until a "
        "pose is published. Empty: there is no prior.",
    ] = "/initialpose"
    prior_age: Annotated[float, "Age after which the bridge drops a pose of --prior-topic, seconds."] = 30.0
    rectified: Annotated[
        bool,
        "The images are rectified, whatever lens the CameraInfo describes. A colour topic whose name says rect counts as rectified too. "
        "The service rectifies other images.",
    ] = False
    baseline_m: Annotated[
        float,
        "Baseline of the stereo rig that measures the depth, metres. 0: from --right-info-topic, otherwise no rig is known.",
    ] = 0.0
    right_info_topic: Annotated[
        str | None,
        "sensor_msgs/CameraInfo of the rig's rectified right camera. Its P[0, 3] gives the baseline, unless --baseline-m does.",
    ] = None
    rate: Annotated[float, "Largest number of queries per second. 0 sends one for every pair."] = 1.0
    min_confidence: Annotated[float, "Smallest confidence of a published pose. 0 passes every LOCALIZED answer."] = 0.9
    false_accept_rate: Annotated[
        float,
        "Share of out-of-map queries that may be LOCALIZED. 0: that of the service, or 0.01 with --map.",
    ] = 0.0
    tolerance: Annotated[float, "Largest difference between the stamps of colour and depth, seconds."] = 0.02
    reliable: Annotated[
        bool, "Request lost images again. The bridge then receives nothing from best-effort publishers."
    ] = False
    queue: Annotated[int, "Images that wait during a query. 0 keeps all."] = 5


_ABOUT: dict[str, str] = {
    name: hint.__metadata__[0] for name, hint in get_type_hints(BridgeSettings, include_extras=True).items()
}
_DEFAULTS: dict[str, Any] = {each.name: each.default for each in fields(BridgeSettings)}


def about(name: str) -> str:
    """Return the meaning of a setting.

    Args:
        name: of the attribute of ``BridgeSettings``.
    """
    return _ABOUT[name]


def parameters() -> dict[str, Parameter]:
    """Return every setting as a ROS parameter with its default. ROS has no None; an empty text stands for it."""
    return {name: "" if default is None else default for name, default in _DEFAULTS.items()}


def settings_from(values: Mapping[str, Parameter], environ: Mapping[str, str] | None = None) -> BridgeSettings:
    """Convert ROS parameters to settings.

    Args:
        values: a value for each name of ``parameters``. An empty text leaves an optional setting unset. ``~`` in a path is the
            home folder.
        environ: environment variables; None reads those of the process. ``STREETFIX_API_KEY`` stands in for an unset ``api_key``.
    """
    known = os.environ if environ is None else environ
    given: dict[str, Any] = {
        name: value for name, value in values.items() if value != "" or _DEFAULTS[name] is not None
    }
    given |= {name: Path(given[name]).expanduser() for name in _PATHS & given.keys()}
    if "api_key" not in given and (key := known.get("STREETFIX_API_KEY")):
        given["api_key"] = key
    return BridgeSettings(**given)
