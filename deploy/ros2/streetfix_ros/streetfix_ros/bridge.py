"""The node of ``ros2 run streetfix_ros bridge``: ROS parameters in, the bridge of ``service.bridge`` started with them."""

import sys
from functools import partial
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor

from service.bridge.bridge import Published, line_of
from service.bridge.opening import opened, until_signalled
from service.bridge.rclpy_node import ros_node, spin
from service.bridge.settings import BridgeSettings, about, parameters, settings_from
from service.errors import StreetfixError


def declared(node: Any) -> BridgeSettings:
    """Declare every setting of the bridge as a parameter of a node, and return what the node was given.

    The node reads its parameters once, so they are read-only.

    Args:
        node: of rclpy.
    """
    values = {
        name: node.declare_parameter(name, default, ParameterDescriptor(description=about(name), read_only=True)).value
        for name, default in parameters().items()
    }
    return settings_from(values)


def tell(log: Any, published: Published) -> None:
    """Log the result of one image pair.

    Args:
        log: of the node.
        published: the result.
    """
    for warning in published.warnings:
        log.warning(warning)
    log.info(line_of(published))


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM, and return the exit status.

    Args:
        args: ROS arguments; None takes those of the process.
    """
    with ros_node(args=args) as node:
        log = node.get_logger()
        try:
            settings = declared(node)
            with until_signalled() as over, opened(settings) as bridge:
                log.info(
                    f"listening to {settings.color_topic} and {settings.depth_topic}, publishing {settings.pose_topic}"
                )
                spin(node, bridge, over, partial(tell, log), reliable=settings.reliable, depth=settings.queue)
        except StreetfixError as error:
            log.fatal(error.message)
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
