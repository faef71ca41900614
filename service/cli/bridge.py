"""``streetfix bridge ros2``: subscribe to the topics of a robot, and publish its pose in the map."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from service.cli.tls_options import Ca, Cert, Key
from service.errors import RequestError

if TYPE_CHECKING:
    from service.bridge.bridge import Localize, Published
    from service.runtime.wakeup import Wakeup

app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Answer a robot's messages with its pose in the map."
)
#: Limits of a query. After a longer time the robot has left the place of the images.
_ATTEMPTS, _PATIENCE_S, _TIMEOUT_S = 3, 3.0, 10.0


@app.callback()
def _of_several() -> None:
    """Keep the name of the one command that there is."""


@app.command("ros2")
def ros2(
    url: Annotated[str, typer.Option(help="URL of the service.")] = "http://127.0.0.1:8000",
    map_bundle: Annotated[
        Path | None,
        typer.Option(
            "--map",
            help="Answer from this map bundle in this process. The bridge then asks no service.",
            show_default=False,
        ),
    ] = None,
    map_name: Annotated[
        str | None,
        typer.Option("--map-name", help="Map to ask. Required if the service has several.", show_default=False),
    ] = None,
    api_key: Annotated[
        str | None,
        typer.Option(
            "--api-key", envvar="STREETFIX_API_KEY", help="API key, if the service requires one.", show_default=False
        ),
    ] = None,
    ca: Ca = None,
    cert: Cert = None,
    key: Key = None,
    color_topic: Annotated[str, typer.Option(help="sensor_msgs/Image: rgb8, bgr8, rgba8, bgra8, mono8.")] = (
        "/camera/color/image_raw"
    ),
    depth_topic: Annotated[
        str, typer.Option(help="sensor_msgs/Image, registered to colour: 16UC1 (mm) or 32FC1 (m).")
    ] = "/camera/aligned_depth_to_color/image_raw",
    info_topic: Annotated[str, typer.Option(help="sensor_msgs/CameraInfo of the colour image.")] = (
        "/camera/color/camera_info"
    ),
    pose_topic: Annotated[str, typer.Option(help="geometry_msgs/PoseWithCovarianceStamped.")] = "/initialpose",
    diagnostics_topic: Annotated[str, typer.Option(help="diagnostic_msgs/DiagnosticArray.")] = "/diagnostics",
    frame: Annotated[str, typer.Option(help="frame_id of the poses.")] = "map",
    mount: Annotated[
        str | None,
        typer.Option(
            help="Camera pose on the vehicle, X,Y,Z,QX,QY,QZ,QW as tf2_echo base_link OPTICAL_FRAME prints it. The "
            "bridge then publishes the vehicle's pose. Otherwise it publishes the camera's pose as a body (x forward, "
            "z up).",
            show_default=False,
        ),
    ] = None,
    rectified: Annotated[
        bool, typer.Option("--rectified", help="The images are rectified, whatever lens the CameraInfo describes.")
    ] = False,
    rate: Annotated[
        float, typer.Option(help="Largest number of queries per second. 0 sends one for every pair.")
    ] = 1.0,
    min_confidence: Annotated[
        float, typer.Option(help="Smallest confidence of a published pose. 0 passes every LOCALIZED answer.")
    ] = 0.9,
    tolerance: Annotated[
        float, typer.Option(help="Largest difference between the stamps of colour and depth, seconds.")
    ] = 0.02,
    domain: Annotated[int, typer.Option(envvar="ROS_DOMAIN_ID", help="ROS domain of the robot.")] = 0,
    reliable: Annotated[
        bool,
        typer.Option("--reliable", help="Request lost images again. The bridge then hears no best-effort publishers."),
    ] = False,
    queue: Annotated[int, typer.Option(min=0, help="Images that wait during a query. 0 keeps all.")] = 5,
    node: Annotated[
        Literal["dds", "rclpy"], typer.Option(help="dds needs no ROS. rclpy uses the middleware of its ROS.")
    ] = "dds",
) -> None:
    """Publish the pose of a robot from its camera's ROS 2 topics.

    The bridge subscribes to the topics and localises image pairs. It publishes the pose for Nav2.
    Ctrl-C ends the bridge.

    \b
    Example:
      streetfix bridge ros2 --url http://127.0.0.1:8000 --mount 0.2,0,0.5,-0.5,0.5,-0.5,0.5 --rate 0.5
    """
    from service.bridge.bridge import Bridge, Topics
    from service.bridge.gate import Gate
    from service.bridge.pairs import Pairs
    from service.bridge.pose import CAMERA_AS_BODY, mount_from

    topics = Topics(color_topic, depth_topic, info_topic, pose_topic, diagnostics_topic)
    gate, pairs = Gate(rate, min_confidence), Pairs(tolerance_s=tolerance)
    T_vehicle_camera = CAMERA_AS_BODY if mount is None else mount_from(mount)
    run = _node_of(node, domain=domain, reliable=reliable, depth=queue)
    with (
        _asking(url, map_bundle, map_name=map_name, api_key=api_key, ca=ca, cert=cert, key=key) as localize,
        _until_told() as over,
    ):
        bridge = Bridge(
            localize=localize, topics=topics, gate=gate, pairs=pairs, T_vehicle_camera=T_vehicle_camera, frame_id=frame,
            rectified=rectified,
        )  # fmt: skip
        typer.echo(
            f"listening to {color_topic} and {depth_topic} on domain {domain}, publishing {pose_topic} (stop: Ctrl-C)"
        )
        run(bridge, over)
    typer.echo("stopped")


def _node_of(node: str, *, domain: int, reliable: bool, depth: int) -> "Callable[..., None]":
    """Import the middleware before anything is opened, so that a missing package is reported at once."""
    if node == "rclpy":
        from service.bridge import rclpy_node

        return lambda bridge, over: rclpy_node.run(bridge, over, _tell, domain=domain, reliable=reliable, depth=depth)
    from service.bridge.ros2 import DdsNode

    return lambda bridge, over: DdsNode(bridge, domain=domain, reliable=reliable, depth=depth).run(over, _tell)


@contextmanager
def _asking(
    url: str, bundle: Path | None, *, map_name: str | None, api_key: str | None, ca: Path | None, cert: Path | None, key: Path | None
) -> "Iterator[Localize]":  # fmt: skip
    """Provide the function that localizes: by a service, or by the map in this process."""
    if bundle is not None:
        if given := next((name for name, file in (("ca", ca), ("cert", cert), ("key", key)) if file is not None), None):
            raise RequestError(f"--{given} is for a service; --map asks none", field=given)
        if map_name is not None:
            raise RequestError("--map-name is for a service; --map has one map alone", field="map_name")
        from service.runtime.threads import limit_pools_before_import

        limit_pools_before_import()
        from service.bridge.in_place import InPlace

        yield InPlace(bundle)
        return
    from service.client import Client, RetryPolicy

    patience = RetryPolicy(attempts=_ATTEMPTS, total_s=_PATIENCE_S)
    with Client(url, api_key=api_key, timeout_s=_TIMEOUT_S, retry=patience, ca=ca, cert=cert, key=key) as client:
        yield lambda rgb, depth_m, camera: client.localize(rgb, depth_m, camera, map=map_name)


@contextmanager
def _until_told() -> Iterator["Wakeup"]:
    """Provide an event that the first SIGINT or SIGTERM sets. A second signal has its original effect."""
    from service.runtime.wakeup import Wakeup

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


def _tell(published: "Published") -> None:
    from service.bridge.bridge import line_of

    typer.echo(line_of(published))
