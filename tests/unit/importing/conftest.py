"""Small files in KITTI's object layout, recordings from lists, and ROS bags written message by message."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from model_training.datasets.dataset import LidarSensor
from model_training.importing.recording import Event, Notes, RecordedPicture, RecordedScan
from model_training.importing.trajectory import Trajectory
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, quaternion_xyzw_from, rotation_x, transform_from

HEIGHT, WIDTH = 60, 220
K = np.array([[200.0, 0.0, 110.0], [0.0, 200.0, 30.0], [0.0, 0.0, 1.0]])
BASELINE_M, DISPARITY_PX = 0.5, 20  # so the wall stands at z = 200 * 0.5 / 20 = 5 m
OFFSET_M = np.array([0.06, -0.01, 0.003])  # of camera 2, as P2 hides it in its last column


def matrix_line(key: str, matrix: np.ndarray) -> str:
    return f"{key}: " + " ".join(f"{x:.12e}" for x in matrix.reshape(-1))


def calibration_text(focal_px: float = 200.0) -> str:
    camera = K.copy()
    camera[0, 0] = camera[1, 1] = focal_px
    right = OFFSET_M - [BASELINE_M, 0, 0]
    lines = [
        matrix_line("P2", np.column_stack([camera, camera @ OFFSET_M])),
        matrix_line("P3", np.column_stack([camera, camera @ right])),
        matrix_line("R0_rect", rotation_x(0.02)),
        matrix_line("Tr_velo_to_cam", np.column_stack([R_BODY_OPTICAL.T, [0.01, -0.08, -0.27]])),
    ]
    return "\n".join(lines) + "\n"


def write_frame(
    training: Path, name: str, *, right: bool = True, scan: bool = True, stored: bool = True, focal_px: float = 200.0
) -> None:
    """Write a wall of random dots 5 m ahead: a stereo pair, a sparse scan and a stored depth."""
    rng = np.random.default_rng(int(name))
    for kind in ("image_2", "image_3", "velodyne", "gt_depth", "calib"):
        (training / kind).mkdir(parents=True, exist_ok=True)
    dots = rng.integers(0, 256, (HEIGHT, WIDTH + DISPARITY_PX, 3), np.uint8)
    dots = cv2.GaussianBlur(dots, (3, 3), 0)
    cv2.imwrite(str(training / "image_2" / f"{name}.png"), dots[:, :WIDTH])
    if right:
        cv2.imwrite(str(training / "image_3" / f"{name}.png"), dots[:, DISPARITY_PX:])
    if scan:
        points = np.column_stack([rng.uniform(4, 40, 50), rng.uniform(-4, 4, (50, 2)), np.zeros(50)])
        points.astype(np.float32).tofile(training / "velodyne" / f"{name}.bin")
    if stored:
        cv2.imwrite(str(training / "gt_depth" / f"{name}.png"), np.full((HEIGHT, WIDTH), 5 * 256, np.uint16))
    (training / "calib" / f"{name}.txt").write_text(calibration_text(focal_px))


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """Return two complete frames, one without a scan (and depth), one without a right image."""
    training = tmp_path / "source" / "training"
    write_frame(training, "000003")
    write_frame(training, "000004", focal_px=190.0)
    write_frame(training, "000005", scan=False, stored=False)
    write_frame(training, "000106", right=False, stored=False)
    return training


@pytest.fixture
def add_frame(kitti: Path) -> Callable[..., None]:
    return lambda name, **options: write_frame(kitti, name, **options)


@pytest.fixture
def kitti_recording() -> Path:
    folder = Path(__file__).parents[4] / "shared" / "data" / "kitti_stereo"
    if not folder.is_dir():
        pytest.skip("the recordings (../shared/data/kitti_stereo) are not here")
    return folder


@dataclass
class ListedRecording:
    """A recording with given events."""

    given: Iterable[Event | BaseException]
    poses: Trajectory | None = None
    lidar: LidarSensor = field(default_factory=lambda: LidarSensor(name="listed", T_vehicle_sensor=np.eye(4).tolist()))
    kind: str = "listed"
    notes: Notes = field(default_factory=lambda: Notes(("a list",), {"path": "list"}))
    georeference: dict[str, Any] | None = None
    has_images: bool = True

    def count(self) -> int:
        return 10

    def trajectory(self) -> Trajectory | None:
        return self.poses

    def events(self, *, pictures: bool = True) -> Iterator[Event]:
        for event in self.given:
            if isinstance(event, BaseException):
                raise event
            if pictures or not isinstance(event, RecordedPicture):
                yield event


@pytest.fixture(scope="session")
def recording_of() -> Callable[..., ListedRecording]:
    return ListedRecording


def make_trajectory(seconds: float = 10.0, *, speed: float = 1.0, rate_hz: float = 10.0) -> Trajectory:
    """Return a straight trajectory along x."""
    stamps = np.arange(0, seconds + 1e-9, 1 / rate_hz)
    T = np.tile(np.eye(4), (len(stamps), 1, 1))
    T[:, 0, 3] = speed * stamps
    return Trajectory(stamps, T, "straight on")


@pytest.fixture(scope="session")
def straight() -> Callable[..., Trajectory]:
    return make_trajectory


def make_scan(stamp_s: float, *, points: Any = ((1.0, 2.0, 3.0, 0.5),), offsets_s: Any = None) -> RecordedScan:
    offsets = None if offsets_s is None else np.array(offsets_s, np.float64)
    return RecordedScan(f"scan at {stamp_s:g}", stamp_s, np.array(points, np.float32).reshape(-1, 4), offsets)


@pytest.fixture(scope="session")
def scan_at() -> Callable[..., RecordedScan]:
    return make_scan


def make_picture(stamp_s: float, **changed: Any) -> RecordedPicture:
    camera = PinholeCamera(8, 6, 8.0, 8.0, 3.5, 2.5)
    rgb = np.random.default_rng(round(stamp_s * 1000)).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    given: dict[str, Any] = {
        "name": f"picture at {stamp_s:g}",
        "stamp_s": stamp_s,
        "rgb": rgb,
        "camera": camera,
        "T_vehicle_camera": transform_from(R_BODY_OPTICAL, np.zeros(3)),
        "depth": np.full((6, 8), 2.5, np.float32),
    }
    return RecordedPicture(**(given | changed))


@pytest.fixture(scope="session")
def picture_at() -> Callable[..., RecordedPicture]:
    return make_picture


class Ros:
    """Messages of ROS 2, and bags of them."""

    def __init__(self) -> None:
        typesys = pytest.importorskip("rosbags.typesys")
        self.store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)

    def make(self, name: str, /, **values: Any) -> Any:
        package, _, short = name.partition("/")
        return self.store.types[f"{package}/msg/{short}"](**values)

    def header(self, stamp_s: float, frame: str) -> Any:
        nanoseconds = round(stamp_s * 1e9)
        stamp = self.make("builtin_interfaces/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return self.make("std_msgs/Header", stamp=stamp, frame_id=frame)

    def cloud(self, stamp_s: float, points: Any = ((1, 2, 3, 4),), *, frame: str = "lidar", names: str = "xyzi") -> Any:
        data = np.array(points, "<f4").reshape(-1, len(names))
        fields = [
            self.make("sensor_msgs/PointField", name=name, offset=4 * k, datatype=7, count=1)
            for k, name in enumerate(names)
        ]
        return self.make(
            "sensor_msgs/PointCloud2",
            header=self.header(stamp_s, frame),
            height=1,
            width=len(data),
            fields=fields,
            is_bigendian=False,
            point_step=4 * len(names),
            row_step=4 * len(names) * len(data),
            data=data.view(np.uint8).reshape(-1),
            is_dense=True,
        )

    def image(self, stamp_s: float, pixels: Any, encoding: str, *, frame: str = "camera") -> Any:
        pixels = np.ascontiguousarray(pixels)
        return self.make(
            "sensor_msgs/Image",
            header=self.header(stamp_s, frame),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=pixels.strides[0],
            data=pixels.view(np.uint8).reshape(-1),
        )

    def info(
        self, stamp_s: float, *, focal: float = 8.0, size: tuple[int, int] = (6, 8), frame: str = "camera", D: Any = ()
    ) -> Any:
        K = np.array([focal, 0, 3.5, 0, focal, 2.5, 0, 0, 1.0])
        roi = self.make("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self.make(
            "sensor_msgs/CameraInfo",
            header=self.header(stamp_s, frame),
            height=size[0],
            width=size[1],
            distortion_model="plumb_bob",
            d=np.array(D, np.float64),
            k=K,
            r=np.eye(3).reshape(-1),
            p=np.c_[K.reshape(3, 3), np.zeros(3)].reshape(-1),
            binning_x=0,
            binning_y=0,
            roi=roi,
        )

    def pose(self, T: Any) -> Any:
        x, y, z, w = (float(v) for v in quaternion_xyzw_from(T[:3, :3]))
        a, b, c = (float(v) for v in T[:3, 3])
        point = self.make("geometry_msgs/Point", x=a, y=b, z=c)
        return self.make(
            "geometry_msgs/Pose", position=point, orientation=self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)
        )

    def odometry(self, stamp_s: float, T: Any, *, child: str = "base_link") -> Any:
        zero = self.make("geometry_msgs/Vector3", x=0.0, y=0.0, z=0.0)
        pose = self.make("geometry_msgs/PoseWithCovariance", pose=self.pose(T), covariance=np.zeros(36))
        twist = self.make(
            "geometry_msgs/TwistWithCovariance",
            twist=self.make("geometry_msgs/Twist", linear=zero, angular=zero),
            covariance=np.zeros(36),
        )
        return self.make(
            "nav_msgs/Odometry", header=self.header(stamp_s, "map"), child_frame_id=child, pose=pose, twist=twist
        )

    def pose_stamped(self, stamp_s: float, T: Any) -> Any:
        return self.make("geometry_msgs/PoseStamped", header=self.header(stamp_s, "map"), pose=self.pose(T))

    def edge(self, stamp_s: float, parent: str, child: str, T: Any) -> Any:
        pose = self.pose(np.asarray(T))
        at = self.make("geometry_msgs/Vector3", x=pose.position.x, y=pose.position.y, z=pose.position.z)
        transform = self.make("geometry_msgs/Transform", translation=at, rotation=pose.orientation)
        return self.make(
            "geometry_msgs/TransformStamped",
            header=self.header(stamp_s, parent),
            child_frame_id=child,
            transform=transform,
        )

    def tf(self, *edges: Any) -> Any:
        return self.make("tf2_msgs/TFMessage", transforms=list(edges))

    def write(self, folder: Path, messages: list[tuple[str, float, Any]], *, storage: str = "mcap") -> Path:
        """Write a ROS 2 bag of (topic, seconds, message). Bytes are written unchanged, as a point cloud."""
        rosbag2 = pytest.importorskip("rosbags.rosbag2")
        plugin = rosbag2.StoragePlugin.MCAP if storage == "mcap" else rosbag2.StoragePlugin.SQLITE3
        with rosbag2.Writer(folder, version=9, storage_plugin=plugin) as writer:
            connections: dict[str, Any] = {}
            for topic, stamp_s, message in messages:
                msgtype = "sensor_msgs/msg/PointCloud2" if isinstance(message, bytes) else message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, msgtype, typestore=self.store)
                raw = message if isinstance(message, bytes) else self.store.serialize_cdr(message, msgtype)
                writer.write(connections[topic], round(stamp_s * 1e9), raw)
        return folder


@pytest.fixture(scope="session")
def ros() -> Ros:
    return Ros()
