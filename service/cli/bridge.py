"""``streetfix bridge ros2``: a robot's topics in, its pose in the map out."""

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
    no_args_is_help=True, rich_markup_mode=None, help="Answer a robot's own messages with its pose in the map."
)
#: A picture that is asked about for longer is of a place that the robot has left.
_ATTEMPTS, _PATIENCE_S, _TIMEOUT_S = 3, 3.0, 10.0


@app.callback()
def _of_several() -> None:
    """Keep the name of the one command that there is."""


@app.command("ros2")
def ros2(
    url: Annotated[str, typer.Option(help="The service.")] = "http://127.0.0.1:8000",
    map_bundle: Annotated[
        Path | None,
        typer.Option("--map", help="Answer from this bundle, in this process, and ask no service.", show_default=False),
    ] = None,
    map_name: Annotated[
        str | None, typer.Option("--map-name", help="Needed where the service has several.", show_default=False)
    ] = None,
    api_key: Annotated[
        str | None,
        typer.Option(
            "--api-key", envvar="STREETFIX_API_KEY", help="Where the service asks for one.", show_default=False
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
    info_topic: Annotated[str, typer.Option(help="sensor_msgs/CameraInfo of the colour picture.")] = (
        "/camera/color/camera_info"
    ),
    pose_topic: Annotated[str, typer.Option(help="geometry_msgs/PoseWithCovarianceStamped.")] = "/initialpose",
    diagnostics_topic: Annotated[str, typer.Option(help="diagnostic_msgs/DiagnosticArray.")] = "/diagnostics",
    frame: Annotated[str, typer.Option(help="frame_id of the poses.")] = "map",
    mount: Annotated[
        str | None,
        typer.Option(
            help="Where the camera sits on the vehicle, X,Y,Z,QX,QY,QZ,QW as tf2_echo base_link OPTICAL_FRAME prints it: the "
            "vehicle's pose is published then, else that of the camera as a body (x forward, z up).",
            show_default=False,
        ),
    ] = None,
    rectified: Annotated[
        bool, typer.Option("--rectified", help="The pictures are rectified, whatever lens the info tells of.")
    ] = False,
    rate: Annotated[float, typer.Option(help="Questions a second at most; 0: one for every pair.")] = 1.0,
    min_confidence: Annotated[
        float, typer.Option(help="Of a pose that is published; 0 lets every LOCALIZED answer pass.")
    ] = 0.9,
    tolerance: Annotated[float, typer.Option(help="Seconds that stamps of colour and depth may differ.")] = 0.02,
    domain: Annotated[int, typer.Option(envvar="ROS_DOMAIN_ID", help="Of the robot.")] = 0,
    reliable: Annotated[
        bool,
        typer.Option("--reliable", help="Ask for lost pictures again; best-effort publishers are not heard then."),
    ] = False,
    queue: Annotated[int, typer.Option(min=0, help="Pictures that wait during a question; 0: all.")] = 5,
    node: Annotated[
        Literal["dds", "rclpy"], typer.Option(help="dds needs no ROS; rclpy takes its ROS' middleware.")
    ] = "dds",
) -> None:
    """Subscribe to a camera's topics, localize, and publish the pose for Nav2; Ctrl-C ends it.

    Example: streetfix bridge ros2 --url http://127.0.0.1:8000 --mount 0.2,0,0.5,-0.5,0.5,-0.5,0.5 --rate 0.5
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
    """What carries the messages, imported before anything is opened: what it lacks is told at once."""
    if node == "rclpy":
        from service.bridge import rclpy_node

        return lambda bridge, over: rclpy_node.run(bridge, over, _tell, domain=domain, reliable=reliable, depth=depth)
    from service.bridge.ros2 import DdsNode

    return lambda bridge, over: DdsNode(bridge, domain=domain, reliable=reliable, depth=depth).run(over, _tell)


@contextmanager
def _asking(
    url: str, bundle: Path | None, *, map_name: str | None, api_key: str | None, ca: Path | None, cert: Path | None, key: Path | None
) -> "Iterator[Localize]":  # fmt: skip
    """Whom to ask: a service, or the map itself."""
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
    """Set by the first SIGINT or SIGTERM; the second does what it did before."""
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
