"""Write a dataset as a ROS bag, to view it in RViz or Foxglove or to play it to another program."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np

from model_training.datasets.dataset import CameraSensor, Dataset
from model_training.datasets.files import read_bytes
from model_training.exporting.moments import Moment, T_vehicle_camera, T_vehicle_lidar, moments, single_camera
from service.errors import DatasetError
from service.geometry.rigid import Transform, quaternion_xyzw_from
from service.imaging.depth_formats import read_depth_values
from service.imaging.picture_headers import ImageLimits

BagFormat = Literal["mcap", "sqlite3", "bag"]
#: Names of the frames.
VEHICLE, LIDAR, CAMERA, MAP = "base_link", "lidar", "camera", "map"
#: Message type of each topic.
TOPICS = {
    "/points": "sensor_msgs/msg/PointCloud2",
    "/camera/color/image_raw": "sensor_msgs/msg/Image",
    "/camera/depth/image_raw": "sensor_msgs/msg/Image",
    "/camera/color/camera_info": "sensor_msgs/msg/CameraInfo",
    "/odometry": "nav_msgs/msg/Odometry",
    "/tf_static": "tf2_msgs/msg/TFMessage",
}
Send = Callable[[str, float, Any], None]


def write_bag(
    dataset: Dataset, queries: str | None, out: Path, *, kind: BagFormat, report: Callable[[int, int], None]
) -> int:
    """Write survey and a query set as a bag.

    Args:
        dataset: to read.
        queries: name of the query set to write, of one camera; None writes no images.
        out: the bag to write: a folder (``mcap``, ``sqlite3``; ROS 2) or a file (``bag``; ROS 1).
        kind: format of the bag.
        report: called with the moments done and all moments.

    Returns:
        Number of moments that were written.

    Raises:
        DatasetError: ``out`` already exists or has an unsuitable name, or the dataset cannot be written as one traversal.
    """
    if out.exists():
        raise DatasetError(f"{out} already exists; choose another --out", field="out")
    if kind != "bag" and out.suffix == ".bag":
        raise DatasetError(
            f"{out}: readers take the ending .bag for a ROS 1 file; choose another name for the folder",
            field="out",
        )
    camera = None if queries is None else single_camera(dataset, queries)
    total = len(dataset.survey_poses()) + (0 if queries is None else sum(1 for _ in dataset.queries(queries)))
    done = 0
    with _writing(out, kind) as (types, send):
        messages = _Messages(types, T_vehicle_lidar(dataset), camera)
        for moment in moments(dataset, queries):
            if done == 0:
                send("/tf_static", moment.stamp_s, messages.mountings(moment.stamp_s))
            for topic, message in messages.of(moment):
                send(topic, moment.stamp_s, message)
            done += 1
            report(done, total)
    return done


@contextmanager
def _writing(out: Path, kind: BagFormat) -> Iterator[tuple[dict[str, Any], Send]]:
    """Yield the message types, and a function that writes a message."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    if kind == "bag":  # the package's ROS 1 types lack this type
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TOPICS["/tf_static"]))
    with _whole(out) as part:
        writer: Any
        if kind == "bag":
            writer = rosbag1.Writer(part)
        else:
            plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
            writer = rosbag2.Writer(part, version=9, storage_plugin=plugin)
        with writer:
            connections = {
                topic: writer.add_connection(topic, msgtype, typestore=store) for topic, msgtype in TOPICS.items()
            }

            def send(topic: str, stamp_s: float, message: Any) -> None:
                serialize = store.serialize_ros1 if kind == "bag" else store.serialize_cdr
                writer.write(connections[topic], round(stamp_s * 1e9), serialize(message, TOPICS[topic]))

            yield dict(store.types), send


@contextmanager
def _whole(out: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``out``; rename it when all is written. The temporary folder is always removed."""
    import shutil

    part = out.with_name(f".{out.name}.part")
    if part.exists():
        shutil.rmtree(part)
    part.mkdir(parents=True)
    try:
        yield part / out.name  # the final name, because the files of a ROS 2 bag contain it
        (part / out.name).rename(out)
    finally:
        shutil.rmtree(part)


class _Messages:
    """Make the messages of a moment."""

    def __init__(self, types: dict[str, Any], T_vehicle_lidar: Transform, camera: CameraSensor | None) -> None:
        self._types, self._T_vehicle_lidar, self._camera = types, T_vehicle_lidar, camera
        self._sequence = 0

    def of(self, moment: Moment) -> Iterator[tuple[str, Any]]:
        """Topics and messages of a moment; the pose comes first."""
        yield "/odometry", self._odometry(moment)
        if moment.points is not None:
            yield "/points", self._cloud(moment.stamp_s, moment.points)
        if moment.frame is not None:
            frame, camera = moment.frame, moment.frame.camera
            yield "/camera/color/camera_info", self._info(moment.stamp_s, camera)
            yield "/camera/color/image_raw", self._image(moment.stamp_s, frame.rgb(), "rgb8")
            yield "/camera/depth/image_raw", self._depth(moment)

    def mountings(self, stamp_s: float) -> Any:
        """The message of ``/tf_static``."""
        edges = [self._edge(stamp_s, LIDAR, self._T_vehicle_lidar)]
        if self._camera is not None:
            edges.append(self._edge(stamp_s, CAMERA, T_vehicle_camera(self._camera)))
        return self._make("tf2_msgs/msg/TFMessage", transforms=edges)

    def _depth(self, moment: Moment) -> Any:
        """Depth as 16UC1 if it is in whole millimetres, otherwise as 32FC1 in metres (REP-118)."""
        assert moment.frame is not None  # noqa: S101
        spec = moment.frame.camera.depth
        values = read_depth_values(read_bytes(moment.frame.depth_path), encoding=None, limits=ImageLimits())
        if values.dtype == np.uint16 and spec.scale_m == 0.001 and spec.kind == "z":
            return self._image(moment.stamp_s, values.astype(np.uint16, copy=False), "16UC1")
        return self._image(moment.stamp_s, moment.frame.depth_m(), "32FC1")

    def _image(self, stamp_s: float, pixels: Any, encoding: str) -> Any:
        data = np.ascontiguousarray(pixels)
        return self._make(
            "sensor_msgs/msg/Image",
            header=self._header(stamp_s, CAMERA),
            height=data.shape[0],
            width=data.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=data.strides[0],
            data=data.view(np.uint8).reshape(-1),
        )

    def _info(self, stamp_s: float, camera: CameraSensor) -> Any:
        name = "sensor_msgs/msg/CameraInfo"
        K = camera.pinhole().matrix
        P = np.c_[K, np.zeros(3)]
        upper = "K" in self._types[name].__dataclass_fields__
        matrices = {"d": np.zeros(5), "k": K.reshape(-1), "r": np.eye(3).reshape(-1), "p": P.reshape(-1)}
        roi = self._make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._make(
            name,
            header=self._header(stamp_s, CAMERA),
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **{(key.upper() if upper else key): value for key, value in matrices.items()},
        )

    def _cloud(self, stamp_s: float, points: Any) -> Any:
        data = np.ascontiguousarray(points, "<f4")
        fields = [
            self._make("sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=7, count=1)
            for k, name in enumerate(("x", "y", "z", "intensity"))
        ]
        return self._make(
            "sensor_msgs/msg/PointCloud2",
            header=self._header(stamp_s, LIDAR),
            height=1,
            width=len(data),
            fields=fields,
            is_bigendian=False,
            point_step=16,
            row_step=16 * len(data),
            data=data.view(np.uint8).reshape(-1),
            is_dense=True,
        )

    def _odometry(self, moment: Moment) -> Any:
        point, quaternion = self._vectors(moment.T_map_vehicle)
        pose = self._make("geometry_msgs/msg/Pose", position=point("geometry_msgs/msg/Point"), orientation=quaternion)
        zero = self._make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self._make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        unknown = np.zeros(36)
        return self._make(
            "nav_msgs/msg/Odometry",
            header=self._header(moment.stamp_s, MAP),
            child_frame_id=VEHICLE,
            pose=self._make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=unknown),
            twist=self._make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown),
        )

    def _edge(self, stamp_s: float, child: str, T: Transform) -> Any:
        point, quaternion = self._vectors(T)
        transform = self._make(
            "geometry_msgs/msg/Transform", translation=point("geometry_msgs/msg/Vector3"), rotation=quaternion
        )
        return self._make(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(stamp_s, VEHICLE),
            child_frame_id=child,
            transform=transform,
        )

    def _vectors(self, T: Transform) -> tuple[Callable[[str], Any], Any]:
        x, y, z, w = (float(value) for value in quaternion_xyzw_from(T[:3, :3]))
        a, b, c = (float(value) for value in T[:3, 3])
        quaternion = self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
        return lambda name: self._make(name, x=a, y=b, z=c), quaternion

    def _header(self, stamp_s: float, frame: str) -> Any:
        nanoseconds = round(stamp_s * 1e9)
        stamp = self._make("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        name = "std_msgs/msg/Header"
        more = {}
        if "seq" in self._types[name].__dataclass_fields__:
            more["seq"] = self._sequence
            self._sequence += 1
        return self._make(name, stamp=stamp, frame_id=frame, **more)

    def _make(self, name: str, /, **values: Any) -> Any:
        return self._types[name](**values)
