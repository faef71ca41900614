"""ROS 1 bags and ROS 2 bags (SQLite and MCAP) by the package ``rosbags``, without ROS."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from model_training.datasets.dataset import LidarSensor
from model_training.importing.extrinsics import Extrinsics
from model_training.importing.recording import Event, Lens, Notes, RecordedPicture, RecordedScan, Unusable
from model_training.importing.ros_cloud import points_of_cloud
from model_training.importing.ros_frames import FrameTree, stamp_of, transform_of
from model_training.importing.ros_pairs import Alone, Pair, Pairing
from model_training.importing.ros_picture import camera_of, colour_of, depth_of
from model_training.importing.ros_topics import POSE_TYPES, ROLES, Topic, topics_of
from model_training.importing.trajectory import Trajectory
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Transform

#: Depth and colour of one camera bear the same stamp, or nearly.
PAIR_TOLERANCE_S = 0.02
_TF = POSE_TYPES[-1]


@dataclass(frozen=True, slots=True)
class BagSettings:
    """What is told of a bag.

    Attributes:
        topics: by role: scan, color, depth, info, poses.
        extrinsics: mountings that the bag does not tell.
        rectified: whether pictures are rectified already; None believes the topic's name.
        want_depth: False pairs no depth with colour.
        max_points: of a scan.
    """

    topics: Mapping[str, str]
    extrinsics: Extrinsics = field(default_factory=Extrinsics)
    rectified: bool | None = None
    want_depth: bool = True
    max_points: int = 5_000_000


@dataclass(frozen=True, slots=True)
class _Camera:
    camera: PinholeCamera
    lens: Lens
    T_vehicle_camera: Transform


class RosBag:
    """A bag as a recording.

    Args:
        path: a ``.bag`` file, a ROS 2 bag's folder, or one of its files.
        settings: what is told of it.

    Raises:
        DatasetError: it cannot be opened, has no scan, or lacks a mounting.
    """

    kind = "rosbag"
    georeference: dict[str, Any] | None = None

    def __init__(self, path: Path, settings: BagSettings) -> None:
        self._path, self._settings = path, settings
        with _opened(path) as reader:
            available = [
                Topic(name, info.msgtype, info.msgcount)
                for name, info in reader.topics.items()
                if info.msgtype is not None
            ]
            self._topics = topics_of(available, settings.topics, source=path.name)
            frames = self._frames(reader)
            tree, self._poses, self._vehicle = frames
            self._camera = self._camera_of(reader, tree)
            scan_frame = self._first(reader, self._topics.scan).header.frame_id
            T_vehicle_lidar = settings.extrinsics.T_vehicle_lidar
            if T_vehicle_lidar is None:
                T_vehicle_lidar = self._mounting(tree, scan_frame, "T_vehicle_lidar")
            self.lidar = LidarSensor(name=scan_frame or "lidar", T_vehicle_sensor=T_vehicle_lidar.tolist())

    @property
    def notes(self) -> Notes:
        """Topics, and what poses are of."""
        chosen = {role: getattr(self._topics, role) for role in ROLES}
        topics = {role: None if topic is None else topic.name for role, topic in chosen.items()}
        vehicle = self._vehicle or "the LiDAR"
        lines = (*self._topics.lines(), f"poses are of: {vehicle}")
        return Notes(lines, {"path": self._path.name, "topics": topics, "vehicle": vehicle})

    def count(self) -> int:
        """Scans and colour pictures."""
        return self._topics.scan.count + (self._topics.color.count if self._topics.color else 0)

    def trajectory(self) -> Trajectory | None:
        """T_map_vehicle of the topic of poses."""
        return self._poses

    def events(self, *, pictures: bool = True) -> Iterator[Event]:
        """Messages in the bag's order; one that ends early gives what came before."""
        with _opened(self._path) as reader:
            roles = self._roles(pictures and self._camera is not None)
            connections = [c for c in reader.connections if c.topic in roles]
            pairing = Pairing(PAIR_TOLERANCE_S)
            messages = reader.messages(connections=connections)
            while True:
                try:
                    connection, _, raw = next(messages)
                    role, message = roles[connection.topic], reader.deserialize(raw, connection.msgtype)
                except StopIteration:
                    break
                except _reading_errors() as error:
                    yield Unusable("bag", self._path.name, f"it cannot be read on from here: {error}")
                    break
                stamp_s = stamp_of(message.header)
                if role == "scan":
                    yield self._scan(message, stamp_s)
                elif role == "color" and "depth" not in roles.values():
                    yield self._picture(Pair(stamp_s, message, None))
                else:
                    yield from map(self._paired, pairing.add(role, stamp_s, message))
            yield from map(self._paired, pairing.finish())

    def _roles(self, pictures: bool) -> dict[str, str]:
        roles = {self._topics.scan.name: "scan"}
        if pictures and self._topics.color is not None:
            roles[self._topics.color.name] = "color"
            if self._settings.want_depth and self._topics.depth is not None:
                roles[self._topics.depth.name] = "depth"
        return roles

    def _scan(self, message: Any, stamp_s: float) -> Event:
        name = f"{self._topics.scan.name} at {stamp_s:.6f}"
        found = points_of_cloud(message, stamp_s=stamp_s, max_points=self._settings.max_points)
        return Unusable("scan", name, found) if isinstance(found, str) else RecordedScan(name, stamp_s, *found)

    def _paired(self, found: Pair | Alone) -> Event:
        if isinstance(found, Pair):
            return self._picture(found)
        return Unusable(
            "picture", f"{found.role} at {found.stamp_s:.6f}", f"no depth within {PAIR_TOLERANCE_S:g} s of it"
        )

    def _picture(self, pair: Pair) -> Event:
        assert self._camera is not None  # noqa: S101  # no colour is read without
        assert self._topics.color is not None  # noqa: S101
        name = f"{self._topics.color.name} at {pair.stamp_s:.6f}"
        rgb = colour_of(pair.color)
        depth = None if pair.depth is None else depth_of(pair.depth)
        if isinstance(rgb, str):
            return Unusable("picture", name, rgb)
        if isinstance(depth, str):
            return Unusable("picture", name, f"depth: {depth}")
        size = (self._camera.camera.height, self._camera.camera.width)
        if rgb.shape[:2] != size or (depth is not None and depth.shape != size):
            have = f"colour {rgb.shape[:2]}" + ("" if depth is None else f", depth {depth.shape}")
            return Unusable(
                "picture", name, f"sizes differ: {have}, camera_info {size}; record depth aligned to colour"
            )
        return RecordedPicture(
            name, pair.stamp_s, rgb, self._camera.camera, self._camera.T_vehicle_camera, depth=depth, lens=self._camera.lens
        )  # fmt: skip

    def _frames(self, reader: Any) -> tuple[FrameTree, Trajectory | None, str | None]:
        """All of ``/tf``, the poses, and the frame that they are of (None: the LiDAR's own)."""
        tree, topic = FrameTree(), self._topics.poses
        stamps: list[float] = []
        poses: list[Transform] = []
        vehicle: str | None = None
        wanted = [c for c in reader.connections if c.msgtype == _TF or (topic is not None and c.topic == topic.name)]
        for connection, _, raw in reader.messages(connections=wanted) if wanted else ():
            message = reader.deserialize(raw, connection.msgtype)
            try:
                if connection.msgtype == _TF:
                    for edge in message.transforms:
                        tree.add(edge, static=connection.topic.rstrip("/").endswith("tf_static"))
                    continue
                vehicle = getattr(message, "child_frame_id", "").lstrip("/") or vehicle
                pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
                stamps.append(stamp_of(message.header))
                poses.append(transform_of(pose))
            except ValueError as error:
                raise DatasetError(f"{self._path.name}, topic {connection.topic}: {error}", field="poses") from error
        if topic is None:
            return tree, None, None
        if topic.msgtype == _TF:
            scan_frame = self._first(reader, self._topics.scan).header.frame_id.lstrip("/")
            found = tree.moving(scan_frame, name=f"{self._path.name}, /tf")
            return tree, None if found is None else found[1], scan_frame
        name = f"{self._path.name}, topic {topic.name}"
        return tree, Trajectory(np.array(stamps), np.array(poses).reshape(-1, 4, 4), name), vehicle

    def _mounting(self, tree: FrameTree, frame: str, key: str) -> Transform:
        if self._vehicle is None or self._vehicle == frame.lstrip("/"):
            if self._vehicle is None and key == "T_vehicle_camera":
                lidar = self._first_frame
                found = tree.fixed(lidar, frame)
                if found is not None:
                    return found
                raise self._no_mounting(lidar, frame, key)
            return np.eye(4)
        found = tree.fixed(self._vehicle, frame)
        if found is None:
            raise self._no_mounting(self._vehicle, frame, key)
        return found

    def _no_mounting(self, vehicle: str, frame: str, key: str) -> DatasetError:
        return DatasetError(
            f"{self._path.name}: /tf_static has no way from {vehicle!r} to {frame!r}; give it as {key} in a file of --extrinsics",
            field=key,
        )

    def _camera_of(self, reader: Any, tree: FrameTree) -> _Camera | None:
        """The camera of the colour topic, where there is one."""
        color, info = self._topics.color, self._topics.info
        self._first_frame = self._first(reader, self._topics.scan).header.frame_id.lstrip("/")
        if color is None:
            return None
        if info is None:
            raise DatasetError(
                f"{self._path.name}: {color.name} has no sensor_msgs/CameraInfo, so its pictures cannot be used; record it, name it "
                "with --topic info=..., or take --no-pictures",
                field="info",
            )
        message = self._first(reader, info)
        is_rectified = (
            "rect" in color.name.rsplit("/", 1)[-1] if self._settings.rectified is None else self._settings.rectified
        )
        found = camera_of(message, is_rectified=is_rectified)
        if isinstance(found, str):
            raise DatasetError(f"{self._path.name}, topic {info.name}: {found}", field="info")
        T = self._settings.extrinsics.T_vehicle_camera
        if T is None:
            T = self._mounting(tree, message.header.frame_id, "T_vehicle_camera")
        return _Camera(found[0], found[1], T)

    def _first(self, reader: Any, topic: Topic) -> Any:
        connections = [c for c in reader.connections if c.topic == topic.name]
        for connection, _, raw in reader.messages(connections=connections):
            return reader.deserialize(raw, connection.msgtype)
        raise DatasetError(f"{self._path.name}: topic {topic.name} has no message", field="topic")


def _reading_errors() -> tuple[type[Exception], ...]:
    """What reading a damaged bag may raise."""
    import sqlite3
    import struct

    from rosbags.highlevel import AnyReaderError
    from rosbags.rosbag1 import ReaderError as Reader1Error
    from rosbags.rosbag2 import ReaderError as Reader2Error
    from rosbags.serde import SerdeError

    of_rosbags = (AnyReaderError, Reader1Error, Reader2Error, SerdeError)
    return (*of_rosbags, sqlite3.Error, struct.error, AssertionError, IndexError, ValueError, EOFError)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A reader of the bag.

    Raises:
        DatasetError: it cannot be opened.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    refused: tuple[type[Exception], ...] = (*_reading_errors(), OSError)
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except refused as error:
        raise DatasetError(
            f"{path}: it cannot be opened as a ROS bag ({error}); if it was cut off, mend it with `rosbag reindex`, "
            "`ros2 bag reindex` or `mcap recover`",
            field="source",
        ) from error
    try:
        yield reader
    finally:
        reader.close()
