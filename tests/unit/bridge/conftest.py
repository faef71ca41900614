import sys
from collections.abc import Callable
from threading import Event
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.contract.schema import LocalizeAnswer


def header_of(stamp_ns: int, frame_id: str = "optical") -> SimpleNamespace:
    sec, nanosec = divmod(stamp_ns, 10**9)
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id=frame_id)


def image(picture: Any, encoding: str, stamp_ns: int = 0, **changed: Any) -> Any:
    """Return a sensor_msgs/Image of an array without padding. Any object with the fields of the ROS message will do."""
    height, width = picture.shape[:2]
    data = np.ascontiguousarray(picture).tobytes()
    fields = {
        "header": header_of(stamp_ns),
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": len(data) // height,
        "data": data,
    }
    return SimpleNamespace(**(fields | changed))


def info(stamp_ns: int = 0, **changed: Any) -> Any:
    """Return a sensor_msgs/CameraInfo of 6 x 4 pixels."""
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
    fields = {
        "header": header_of(stamp_ns),
        "height": 4,
        "width": 6,
        "distortion_model": "plumb_bob",
        "d": [],
        "k": [3.0, 0, 2.5, 0, 3.5, 1.5, 0, 0, 1],
        "p": [0.0] * 12,
        "roi": roi,
    }
    return SimpleNamespace(**(fields | changed))


def place(*numbers: float) -> Any:
    """Return a Point, or a Vector3."""
    return SimpleNamespace(**dict(zip("xyz", numbers, strict=True)))


def turn(*numbers: float) -> Any:
    """Return a geometry_msgs/Quaternion."""
    return SimpleNamespace(**dict(zip("xyzw", numbers, strict=True)))


def fixed(*transforms: tuple[str, str, tuple[float, ...]]) -> Any:
    """Return a tf2_msgs/TFMessage of (parent, child, x, y, z and the quaternion of the child in the parent)."""
    return SimpleNamespace(
        transforms=[
            SimpleNamespace(
                header=SimpleNamespace(frame_id=parent),
                child_frame_id=child,
                transform=SimpleNamespace(translation=place(*numbers[:3]), rotation=turn(*numbers[3:])),
            )
            for parent, child, numbers in transforms
        ]
    )


def odometry(
    stamp_ns: int, x: float, y: float, yaw_deg: float = 0.0, *, frame: str = "odom", child: str = "base_link"
) -> Any:
    """Return a nav_msgs/Odometry of a vehicle on level ground."""
    half = np.deg2rad(yaw_deg) / 2
    pose = SimpleNamespace(position=place(x, y, 0.0), orientation=turn(0.0, 0.0, np.sin(half), np.cos(half)))
    return SimpleNamespace(
        header=header_of(stamp_ns, frame), child_frame_id=child, pose=SimpleNamespace(pose=pose, covariance=[0.0] * 36)
    )


def initial_pose(
    x: float,
    y: float,
    yaw_deg: float = 0.0,
    *,
    variances: tuple[float, float, float] = (0.0, 0.0, 0.0),
    frame: str = "map",
    stamp_ns: int = 0,
) -> Any:
    """Return a geometry_msgs/PoseWithCovarianceStamped with the variances of x, y (m2) and yaw (rad2)."""
    message = odometry(stamp_ns, x, y, yaw_deg, frame=frame)
    for index, variance in zip((0, 7, 35), variances, strict=True):
        message.pose.covariance[index] = variance
    return message


@pytest.fixture(scope="session")
def fixed_of() -> Callable[..., Any]:
    return fixed


@pytest.fixture(scope="session")
def odometry_of() -> Callable[..., Any]:
    return odometry


@pytest.fixture(scope="session")
def initial_pose_of() -> Callable[..., Any]:
    return initial_pose


@pytest.fixture(scope="session")
def image_of() -> Callable[..., Any]:
    return image


@pytest.fixture(scope="session")
def info_of() -> Callable[..., Any]:
    return info


@pytest.fixture(scope="session")
def answer_of(refused_of: Callable[..., dict[str, Any]]) -> Callable[..., LocalizeAnswer]:
    """Return an accepted answer: camera at (10, 20, 1.5), view along map x. With another status it has no pose."""

    def made(**changed: Any) -> LocalizeAnswer:
        position = {"x": 10.0, "y": 20.0, "z": 1.5}
        pose = {
            "position": position,
            "orientation": {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5},
            "heading_deg": 0.0,
            "covariance": np.diag([0.01, 0.02, 0.03, 0.001, 0.002, 0.003]).reshape(-1).tolist(),
        }
        content = {
            "status": "LOCALIZED",
            "confidence": 0.95,
            "camera_height": {"height_m": 0.31, "origin": "given"},
            "street": {"id": "s2", "name": "End", "street": "4", "section": "end", "class_index": 6, "vote": 0.5},
            "pose": pose,
            "vehicle_pose": None,
            "geopose": None,
            "hypotheses": [],
            "spread": None,
            "reasons": [],
            "neighbours": [],
            "map": {"name": "tiny", "version": "abc"},
            "timings_ms": {"decode": 1, "fuse": 1, "encode": 1, "search": 1, "register": 1, "total": 5},
        }
        if changed.get("status", "LOCALIZED") != "LOCALIZED":
            return LocalizeAnswer.model_validate(refused_of(content, **changed))
        return LocalizeAnswer.model_validate(content | changed)

    return made


class Ros:
    """The part of ROS that the node calls. ``spin_once`` runs the next of ``turns``, and ``no_more`` after the last one."""

    def __init__(self) -> None:
        self.subscriptions: dict[str, Any] = {}
        self.published: dict[str, list[Any]] = {}
        self.turns: list[Callable[[], object]] = []
        self.over = Event()
        self.no_more: Callable[[], object] = self.over.set
        self.ended: list[str] = []
        self.domain: int | None = None
        self.args: list[str] | None = None
        self.signals = ""
        self.given: dict[str, object] = {}
        self.declared: dict[str, Any] = {}
        self.logged: list[tuple[str, str]] = []

    def init(self, *, args: list[str] | None, domain_id: int | None, signal_handler_options: str) -> None:
        self.args, self.domain, self.signals = args, domain_id, signal_handler_options

    def create_node(self, name: str) -> "Ros":
        assert name == "streetfix_bridge"
        return self

    def destroy_node(self) -> None:
        self.ended.append("node")

    def declare_parameter(self, name: str, default: object, descriptor: Any) -> Any:
        """Declare a parameter as rclpy does: the default sets the type, so 1 is invalid for 1.0."""
        value = self.given.get(name, default)
        assert type(value) is type(default), name
        self.declared[name] = SimpleNamespace(default=default, descriptor=descriptor)
        return SimpleNamespace(value=value)

    def get_logger(self) -> Any:
        return SimpleNamespace(
            info=lambda text: self.logged.append(("info", text)),
            warning=lambda text: self.logged.append(("warning", text)),
            fatal=lambda text: self.logged.append(("fatal", text)),
        )

    def create_subscription(self, kind: Any, topic: str, heard: Any, qos: Any) -> None:
        self.subscriptions[topic] = SimpleNamespace(kind=kind, heard=heard, qos=qos)

    def create_publisher(self, _kind: Any, topic: str, _depth: int) -> Any:
        return SimpleNamespace(publish=self.published.setdefault(topic, []).append)

    def spin_once(self, _node: Any, *, timeout_sec: float) -> None:
        assert timeout_sec > 0
        if self.turns:
            self.turns.pop(0)()
        else:
            self.no_more()

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: "now"))


def posed_message() -> Any:
    empty = SimpleNamespace
    header = empty(stamp=empty(), frame_id="")
    return empty(header=header, pose=empty(pose=empty(position=empty(), orientation=empty()), covariance=None))


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> Ros:
    ros = Ros()
    qos = SimpleNamespace(
        HistoryPolicy=SimpleNamespace(KEEP_LAST="last", KEEP_ALL="all"),
        ReliabilityPolicy=SimpleNamespace(RELIABLE="reliable", BEST_EFFORT="best effort"),
        DurabilityPolicy=SimpleNamespace(TRANSIENT_LOCAL="latched", VOLATILE="volatile"),
        QoSProfile=SimpleNamespace,
    )
    modules: dict[str, Any] = {
        "rclpy": SimpleNamespace(
            init=ros.init,
            create_node=ros.create_node,
            ok=lambda: True,
            spin_once=ros.spin_once,
            try_shutdown=lambda: ros.ended.append("shutdown"),
        ),
        "rclpy.qos": qos,
        "rclpy.signals": SimpleNamespace(SignalHandlerOptions=SimpleNamespace(NO="no handlers")),
        "rcl_interfaces": SimpleNamespace(),
        "rcl_interfaces.msg": SimpleNamespace(ParameterDescriptor=SimpleNamespace),
        "sensor_msgs": SimpleNamespace(),
        "sensor_msgs.msg": SimpleNamespace(Image="Image", CameraInfo="CameraInfo", Imu="Imu"),
        "nav_msgs": SimpleNamespace(),
        "nav_msgs.msg": SimpleNamespace(Odometry="Odometry"),
        "tf2_msgs": SimpleNamespace(),
        "tf2_msgs.msg": SimpleNamespace(TFMessage="TFMessage"),
        "geometry_msgs": SimpleNamespace(),
        "geometry_msgs.msg": SimpleNamespace(PoseWithCovarianceStamped=posed_message),
        "diagnostic_msgs": SimpleNamespace(),
        "diagnostic_msgs.msg": SimpleNamespace(
            DiagnosticArray=lambda: SimpleNamespace(header=SimpleNamespace(stamp=None), status=[]),
            DiagnosticStatus=SimpleNamespace,
            KeyValue=SimpleNamespace,
        ),
    }
    for name, content in modules.items():
        module = ModuleType(name)
        module.__dict__.update(vars(content))
        monkeypatch.setitem(sys.modules, name, module)
    return ros
