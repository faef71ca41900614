"""Build the bridge from its settings, and end it by a signal."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

from service.bridge.bridge import Bridge, Localize, Topics
from service.bridge.pairs import Pairs
from service.bridge.pose import CAMERA_AS_BODY, height_from, mount_from
from service.bridge.publish_policy import PublishPolicy
from service.bridge.rig import StereoRig
from service.bridge.robot import Robot
from service.bridge.settings import BridgeSettings
from service.errors import RequestError
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
    )
    policy, pairs = PublishPolicy(settings.rate, settings.min_confidence), Pairs(tolerance_s=settings.tolerance)
    mount = None if settings.mount is None else mount_from(settings.mount)
    height = height_from(settings.camera_height_m, mount, base_on_ground=settings.base_on_ground)
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
            robot=Robot(rig=rig, camera_height=height),
            T_vehicle_camera=CAMERA_AS_BODY if mount is None else mount,
            frame_id=settings.frame,
            rectified=settings.rectified,
        )


@contextmanager
def _asking(settings: BridgeSettings) -> Iterator[Localize]:
    """Provide the function that localizes: by a service, or by the map in this process."""
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

        yield InPlace(settings.map)
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
        yield AskService(client, settings.map_name)


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
