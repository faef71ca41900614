"""``streetfix bridge ros2``: subscribe to the topics of a robot, and publish its pose in the map."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from service.bridge.settings import BridgeSettings, GravitySource, about
from service.cli.map_folders import folder_of_map
from service.cli.tls_options import Ca, Cert, Key

if TYPE_CHECKING:
    from service.bridge.bridge import Published

app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Answer a robot's messages with its pose in the map."
)
_DEFAULTS = BridgeSettings()


@app.callback()
def _of_several() -> None:
    """Keep the name of the one command that there is."""


@app.command("ros2")
def ros2(
    url: Annotated[str, typer.Option(help=about("url"))] = _DEFAULTS.url,
    map_bundle: Annotated[
        Path | None, typer.Option("--map", help=about("map"), show_default=False, callback=folder_of_map)
    ] = None,
    map_name: Annotated[str | None, typer.Option("--map-name", help=about("map_name"), show_default=False)] = None,
    api_key: Annotated[
        str | None,
        typer.Option("--api-key", envvar="STREETFIX_API_KEY", help=about("api_key"), show_default=False),
    ] = None,
    ca: Ca = None,
    cert: Cert = None,
    key: Key = None,
    color_topic: Annotated[str, typer.Option(help=about("color_topic"))] = _DEFAULTS.color_topic,
    depth_topic: Annotated[str, typer.Option(help=about("depth_topic"))] = _DEFAULTS.depth_topic,
    info_topic: Annotated[str, typer.Option(help=about("info_topic"))] = _DEFAULTS.info_topic,
    pose_topic: Annotated[str, typer.Option(help=about("pose_topic"))] = _DEFAULTS.pose_topic,
    diagnostics_topic: Annotated[str, typer.Option(help=about("diagnostics_topic"))] = _DEFAULTS.diagnostics_topic,
    frame: Annotated[str, typer.Option(help=about("frame"))] = _DEFAULTS.frame,
    mount: Annotated[str | None, typer.Option(help=about("mount"), show_default=False)] = None,
    tf_static_topic: Annotated[str, typer.Option(help=about("tf_static_topic"))] = _DEFAULTS.tf_static_topic,
    base_frame: Annotated[str, typer.Option(help=about("base_frame"))] = _DEFAULTS.base_frame,
    ground_frame: Annotated[str, typer.Option(help=about("ground_frame"))] = _DEFAULTS.ground_frame,
    base_on_ground: Annotated[
        bool, typer.Option("--base-on-ground", help=about("base_on_ground"))
    ] = _DEFAULTS.base_on_ground,
    camera_height_m: Annotated[float, typer.Option(help=about("camera_height_m"))] = _DEFAULTS.camera_height_m,
    camera_height_std_m: Annotated[
        float, typer.Option(help=about("camera_height_std_m"))
    ] = _DEFAULTS.camera_height_std_m,
    gravity: Annotated[GravitySource, typer.Option(help=about("gravity"))] = _DEFAULTS.gravity,
    imu_topic: Annotated[str, typer.Option(help=about("imu_topic"))] = _DEFAULTS.imu_topic,
    odom_topic: Annotated[str, typer.Option(help=about("odom_topic"))] = _DEFAULTS.odom_topic,
    odometry_noise: Annotated[float, typer.Option(help=about("odometry_noise"))] = _DEFAULTS.odometry_noise,
    prior_topic: Annotated[str, typer.Option(help=about("prior_topic"))] = _DEFAULTS.prior_topic,
    prior_age: Annotated[float, typer.Option(help=about("prior_age"))] = _DEFAULTS.prior_age,
    rectified: Annotated[bool, typer.Option("--rectified", help=about("rectified"))] = _DEFAULTS.rectified,
    baseline_m: Annotated[float, typer.Option(help=about("baseline_m"))] = _DEFAULTS.baseline_m,
    right_info_topic: Annotated[str | None, typer.Option(help=about("right_info_topic"), show_default=False)] = None,
    rate: Annotated[float, typer.Option(help=about("rate"))] = _DEFAULTS.rate,
    min_confidence: Annotated[float, typer.Option(help=about("min_confidence"))] = _DEFAULTS.min_confidence,
    false_accept_rate: Annotated[float, typer.Option(help=about("false_accept_rate"))] = _DEFAULTS.false_accept_rate,
    tolerance: Annotated[float, typer.Option(help=about("tolerance"))] = _DEFAULTS.tolerance,
    domain: Annotated[int, typer.Option(envvar="ROS_DOMAIN_ID", help="ROS domain of the robot.")] = 0,
    reliable: Annotated[bool, typer.Option("--reliable", help=about("reliable"))] = _DEFAULTS.reliable,
    queue: Annotated[int, typer.Option(min=0, help=about("queue"))] = _DEFAULTS.queue,
    node: Annotated[
        Literal["dds", "rclpy"], typer.Option(help="dds needs no ROS. rclpy uses the middleware of its ROS.")
    ] = "dds",
) -> None:
    """Publish the pose of a robot from its camera's ROS 2 topics.

    The bridge subscribes to the topics and localises image pairs. It publishes the pose for Nav2.
    Ctrl-C ends the bridge.

    \b
    Example:
      streetfix bridge ros2 --url http://127.0.0.1:8000 --base-frame base_footprint --rate 0.5
    """
    settings = BridgeSettings(
        url=url,
        map=map_bundle,
        map_name=map_name,
        api_key=api_key,
        ca=ca,
        cert=cert,
        key=key,
        color_topic=color_topic,
        depth_topic=depth_topic,
        info_topic=info_topic,
        pose_topic=pose_topic,
        diagnostics_topic=diagnostics_topic,
        frame=frame,
        mount=mount,
        tf_static_topic=tf_static_topic,
        base_frame=base_frame,
        ground_frame=ground_frame,
        base_on_ground=base_on_ground,
        camera_height_m=camera_height_m,
        camera_height_std_m=camera_height_std_m,
        gravity=gravity,
        imu_topic=imu_topic,
        odom_topic=odom_topic,
        odometry_noise=odometry_noise,
        prior_topic=prior_topic,
        prior_age=prior_age,
        rectified=rectified,
        baseline_m=baseline_m,
        right_info_topic=right_info_topic,
        rate=rate,
        min_confidence=min_confidence,
        false_accept_rate=false_accept_rate,
        tolerance=tolerance,
        reliable=reliable,
        queue=queue,
    )
    run = _node_of(node, domain=domain, reliable=reliable, depth=queue)
    from service.bridge.opening import opened, until_signalled

    with opened(settings) as bridge, until_signalled() as over:
        typer.echo(
            f"listening to {color_topic} and {depth_topic} on domain {domain}, publishing {pose_topic}. Stop with "
            "Ctrl-C."
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


def _tell(published: "Published") -> None:
    from service.bridge.bridge import line_of

    for warning in published.warnings:
        typer.echo(f"streetfix: warning: {warning}", err=True)
    typer.echo(line_of(published))
