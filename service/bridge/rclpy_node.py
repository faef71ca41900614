"""The bridge as an rclpy node, for users with ROS 2. Its parameters, remappings and executors then apply."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from threading import Event
from typing import Any

from service.bridge.bridge import DELIVERIES, Bridge, Delivery, Published
from service.bridge.diagnostics import NAME, Diagnosis
from service.bridge.pose import StampedPose
from service.errors import ExtraMissingError
from service.runtime.wakeup import Wakeup

#: Name of the node.
NODE = "streetfix_bridge"
#: Seconds between two checks for images.
_LOOK_S = 0.05


@contextmanager
def ros_node(*, args: list[str] | None = None, domain: int | None = None) -> Iterator[Any]:
    """Provide an rclpy node, and take it down at the end.

    rclpy installs no signal handlers, because they would shut ROS down before the last result is published. The caller ends
    ``spin`` by its own handler.

    Args:
        args: ROS arguments such as parameters and remappings; None takes those of the process.
        domain: ``ROS_DOMAIN_ID`` of the robot; None takes that of the environment.

    Raises:
        ExtraMissingError: rclpy or a ROS message package is not installed.
    """
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions

        packages = ("diagnostic_msgs.msg", "geometry_msgs.msg", "nav_msgs.msg", "sensor_msgs.msg", "tf2_msgs.msg")
        for messages in packages:  # of `spin`
            import_module(messages)
    except ModuleNotFoundError as error:
        raise ExtraMissingError(
            f"--node rclpy needs the package {error.name!r}, which comes with ROS 2: source /opt/ros/DISTRIBUTION/setup.bash in an "
            "environment with system packages, or use --node dds, which needs no ROS",
            field="node",
        ) from error
    rclpy.init(args=args, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node(NODE)
        try:
            yield node
        finally:
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


def run(
    bridge: Bridge,
    over: Event | Wakeup,
    callback: Callable[[Published], None] = lambda _: None,
    *,
    domain: int = 0,
    reliable: bool = False,
    depth: int = 5,
) -> None:
    """Process images in a new node and publish the results until ``over`` is set.

    Args:
        bridge: that processes the messages.
        over: ends the loop; set from elsewhere, for example by a signal.
        callback: called with the result of every processed pair.
        domain: ``ROS_DOMAIN_ID`` of the robot.
        reliable: request lost images again; see ``DdsNode``.
        depth: length of the image queue during a query; 0 keeps all.

    Raises:
        ExtraMissingError: rclpy or a ROS message package is not installed.
    """
    with ros_node(domain=domain) as node:
        spin(node, bridge, over, callback, reliable=reliable, depth=depth)


def spin(
    node: Any,
    bridge: Bridge,
    over: Event | Wakeup,
    callback: Callable[[Published], None] = lambda _: None,
    *,
    reliable: bool = False,
    depth: int = 5,
) -> None:
    """Process images in a node and publish the results until ``over`` is set.

    Args:
        node: of ``ros_node``.
        bridge: that processes the messages.
        over: ends the loop; set from elsewhere, for example by a signal.
        callback: called with the result of every processed pair.
        reliable: request lost images again; see ``DdsNode``.
        depth: length of the image queue during a query; 0 keeps all.
    """
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from nav_msgs.msg import Odometry
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import CameraInfo, Image, Imu
    from tf2_msgs.msg import TFMessage

    topics = bridge.topics
    kinds = {
        "color": Image,
        "depth": Image,
        "info": CameraInfo,
        "right_info": CameraInfo,
        "tf_static": TFMessage,
        "odom": Odometry,
        "imu": Imu,
        "prior": PoseWithCovarianceStamped,
    }
    for name, handler in bridge.handlers().items():
        how = DELIVERIES.get(name, Delivery(depth, reliable))
        quality = QoSProfile(
            depth=how.depth or 1000,
            history=HistoryPolicy.KEEP_LAST if how.depth else HistoryPolicy.KEEP_ALL,
            reliability=ReliabilityPolicy.RELIABLE if how.reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if how.latched else DurabilityPolicy.VOLATILE,
        )
        node.create_subscription(kinds[name], getattr(topics, name), handler, quality)
    poses = node.create_publisher(PoseWithCovarianceStamped, topics.pose, 10)
    diagnoses = node.create_publisher(DiagnosticArray, topics.diagnostics, 10)
    spoken_s = bridge.clock()
    while rclpy.ok() and not over.is_set():
        rclpy.spin_once(node, timeout_sec=_LOOK_S)
        now = node.get_clock().now().to_msg()
        if (published := bridge.step()) is not None:
            if published.pose is not None:
                poses.publish(filled_pose(PoseWithCovarianceStamped(), published.pose))
            diagnoses.publish(filled_diagnostics(DiagnosticArray(), published.diagnosis, now))
            callback(published)
        elif bridge.clock() - spoken_s < bridge.quiet_s():
            continue
        else:
            diagnoses.publish(filled_diagnostics(DiagnosticArray(), bridge.idle(), now))
        spoken_s = bridge.clock()


def filled_pose(message: Any, pose: StampedPose) -> Any:
    """Fill a geometry_msgs/PoseWithCovarianceStamped and return it.

    Args:
        message: empty.
        pose: of the vehicle.
    """
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(pose.stamp_ns, 10**9)
    message.header.frame_id = pose.frame_id
    at, turned = message.pose.pose.position, message.pose.pose.orientation
    at.x, at.y, at.z = pose.T_map_vehicle[:3, 3].tolist()
    turned.x, turned.y, turned.z, turned.w = pose.quaternion_xyzw.tolist()
    message.pose.covariance = pose.covariance.reshape(-1).tolist()
    return message


def filled_diagnostics(message: Any, diagnosis: Diagnosis, now: Any) -> Any:
    """Fill a diagnostic_msgs/DiagnosticArray and return it.

    Args:
        message: empty.
        diagnosis: to publish.
        now: current time, builtin_interfaces/Time.
    """
    from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

    message.header.stamp = now
    message.status = [
        DiagnosticStatus(
            level=bytes([diagnosis.level]),
            name=NAME,
            message=diagnosis.message,
            hardware_id="streetfix",
            values=[KeyValue(key=name, value=value) for name, value in diagnosis.values],
        )
    ]
    return message
