"""Build the bridge from its settings, and end it by a signal."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

from service.bridge.bridge import Bridge, Localize, Topics
from service.bridge.gravity import Imu
from service.bridge.initial_pose import InitialPoses
from service.bridge.mounting import MountingRule
from service.bridge.notices import Notices
from service.bridge.odometry import Odometry
from service.bridge.pairs import Pairs
from service.bridge.pose import height_on_mount, measured_height, mount_from
from service.bridge.publish_policy import PublishPolicy
from service.bridge.rig import StereoRig
from service.bridge.robot import Robot
from service.bridge.settings import BridgeSettings
from service.errors import RequestError
from service.option_limits import LEAST_FALSE_ACCEPT_RATE, LEAST_HEIGHT_STD_M, MOST_HEIGHT_STD_M, VEHICLE_HEIGHT_STD_M
from service.runtime.wakeup import Wakeup

#: Limits of a query. After a longer time the robot has left the place of the images.
_ATTEMPTS, _PATIENCE_S, _TIMEOUT_S = 3, 3.0, 10.0


@contextmanager
def opened(settings: BridgeSettings) -> Iterator[Bridge]:
    """Provide a bridge that asks a service, or answers from the map in this process.

    Args:
        settings: of the bridge. They are checked before anything is opened.

    Raises:
        RequestError: a setting makes no sense, or contradicts another one.
        BundleError: the map bundle is missing or damaged.
        KeysError: a file of ``ca``, ``cert`` or ``key`` cannot be used.
    """
    rig = StereoRig(settings.baseline_m, settings.right_info_topic or "")
    topics = Topics(
        settings.color_topic,
        settings.depth_topic,
        settings.info_topic,
        settings.pose_topic,
        settings.diagnostics_topic,
        right_info=rig.topic,
        tf_static=settings.tf_static_topic,
        odom=settings.odom_topic,
        imu=settings.imu_topic if settings.gravity == "imu" else "",
        prior=settings.prior_topic,
    )
    policy, pairs = PublishPolicy(settings.rate, settings.min_confidence), Pairs(tolerance_s=settings.tolerance)
    robot = _robot(settings, rig)
    if settings.queue < 0:
        raise RequestError(
            f"--queue: {settings.queue} is not a valid number of images; give 1 or more, or 0 to keep all",
            field="queue",
        )
    with _asking(settings) as localize:
        yield Bridge(
            localize=localize,
            topics=topics,
            policy=policy,
            pairs=pairs,
            robot=robot,
            frame_id=settings.frame,
            rectified=settings.rectified,
        )


def _robot(settings: BridgeSettings, rig: StereoRig) -> Robot:
    """Return the robot of the settings.

    Raises:
        RequestError: a setting makes no sense, or contradicts another one.
    """
    notices = Notices()
    if settings.gravity not in ("mounting", "imu", "none"):
        raise RequestError(
            f"--gravity: {settings.gravity!r} is not a source of gravity; give mounting, imu or none", field="gravity"
        )
    if settings.gravity == "imu" and not (settings.imu_topic and settings.tf_static_topic):
        raise RequestError(
            "--gravity: imu needs the IMU and its mounting, but --imu-topic or --tf-static-topic is empty; give both, or pass "
            "--gravity mounting",
            field="gravity",
        )
    noise = settings.odometry_noise
    if not 0 <= noise <= 1:
        raise RequestError(
            f"--odometry-noise: {noise:g} is no share of the distance; give 0 to 1, for example 0.1, or 0 for the usual one",
            field="odometry_noise",
        )
    return Robot(
        rig=rig,
        rule=_rule(settings),
        gravity=settings.gravity,
        odometry=Odometry(settings.odom_topic, notices) if settings.odom_topic else None,
        odometry_noise=noise or None,
        imu=Imu(settings.imu_topic, notices) if settings.gravity == "imu" else None,
        initial_poses=InitialPoses(settings.prior_topic, settings.frame, settings.prior_age, notices)
        if settings.prior_topic
        else None,
        notices=notices,
    )


def _rule(settings: BridgeSettings) -> MountingRule:
    """Return how to find the mounting of the camera.

    Raises:
        RequestError: a setting makes no sense, or contradicts another one.
    """
    std_m = settings.camera_height_std_m
    if std_m and not LEAST_HEIGHT_STD_M <= std_m <= MOST_HEIGHT_STD_M:
        raise RequestError(
            f"--camera-height-std-m: {std_m:g} m is not a valid standard deviation; give {LEAST_HEIGHT_STD_M:g} to "
            f"{MOST_HEIGHT_STD_M:g} m, or 0 for the usual one",
            field="camera_height_std_m",
        )
    mount = None if settings.mount is None else mount_from(settings.mount)
    height, over_ground_std_m = measured_height(settings.camera_height_m, std_m), std_m or VEHICLE_HEIGHT_STD_M
    base_frame, ground_frame = settings.base_frame, settings.ground_frame
    if not settings.tf_static_topic:
        base_frame = ground_frame = ""
    if settings.base_on_ground:
        ground_frame = base_frame
        if mount is not None:
            ground_frame, height = "", height or height_on_mount(mount, over_ground_std_m)
        elif not base_frame and height is None:
            raise RequestError(
                "--base-on-ground: there is no vehicle frame, because --mount is missing and --base-frame or --tf-static-topic is empty; "
                "give --mount or both of them, or --camera-height-m",
                field="base_on_ground",
            )
    return MountingRule(
        mount=mount,
        base_frame=base_frame,
        ground_frame=ground_frame,
        camera_height=height,
        height_std_m=over_ground_std_m,
    )


@contextmanager
def _asking(settings: BridgeSettings) -> Iterator[Localize]:
    """Provide the function that localizes: by a service, or by the map in this process."""
    rate = settings.false_accept_rate
    if rate and not LEAST_FALSE_ACCEPT_RATE <= rate < 1:
        raise RequestError(
            f"--false-accept-rate: {rate:g} is no share; give {LEAST_FALSE_ACCEPT_RATE:g} or more and less than 1, or 0 for that of the "
            "service",
            field="false_accept_rate",
        )
    if settings.map is not None:
        if given := next((name for name in ("ca", "cert", "key") if getattr(settings, name) is not None), None):
            raise RequestError(
                f"--{given}: it is only for a service, but --map uses none; omit --{given} or --map", field=given
            )
        if settings.map_name is not None:
            raise RequestError(
                "--map-name: it is only for a service, but --map gives one map; omit --map-name or --map",
                field="map_name",
            )
        from service.runtime.threads import limit_pools_before_import

        limit_pools_before_import()
        from service.bridge.in_place import InPlace

        yield InPlace(settings.map, rate or None)
        return
    from service.bridge.asking import AskService
    from service.client import Client, RetryPolicy

    with Client(
        settings.url,
        api_key=settings.api_key,
        timeout_s=_TIMEOUT_S,
        retry=RetryPolicy(attempts=_ATTEMPTS, total_s=_PATIENCE_S),
        ca=settings.ca,
        cert=settings.cert,
        key=settings.key,
    ) as client:
        yield AskService(client, settings.map_name, rate or None)


@contextmanager
def until_signalled() -> Iterator[Wakeup]:
    """Provide an event that the first SIGINT or SIGTERM sets. A second signal has its original effect."""
    over = Wakeup()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def end(number: int, _frame: object) -> None:
        signal.signal(number, before[signal.Signals(number)])
        over.set()

    for number in before:
        signal.signal(number, end)
    try:
        yield over
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
