"""Read ROS 1 bags and ROS 2 bags (SQLite and MCAP) as a recording, without ROS."""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from model_training.datasets.dataset import LidarSensor
from model_training.importing.recording import (
    BASELINE_HINT,
    PAIR_TOLERANCE_S,
    Event,
    Notes,
    RecordedPicture,
    RecordedScan,
    Unusable,
)
from model_training.importing.ros_cloud import points_of_cloud
from model_training.importing.ros_content import BagSettings, content_of
from model_training.importing.ros_frames import stamp_of
from model_training.importing.ros_pairs import Pair, Pairing, UnpairedImage
from model_training.importing.ros_picture import colour_of, depth_of
from model_training.importing.ros_reader import BagReader, Damage, opened
from model_training.importing.ros_stereo import STEREO_TOLERANCE_S, StereoRig, spread_pairs
from model_training.importing.ros_topics import ROLES
from model_training.importing.stereo import RECORDED
from model_training.importing.trajectory import Trajectory

_WITHOUT_DEPTH = f"no depth within {PAIR_TOLERANCE_S:g} s of it"
_WITHOUT_RIGHT = f"no right image within {STEREO_TOLERANCE_S:g} s of it"


class RosBag:
    """A bag as a recording.

    Args:
        path: a ``.bag`` file, the folder of a ROS 2 bag, or one of its files.
        settings: of the reader.

    Attributes:
        kind: name of the format.
        georeference: always None.

    Raises:
        DatasetError: it cannot be opened, has no scan, or lacks intrinsics or a mounting.
    """

    kind = "rosbag"
    georeference: dict[str, Any] | None = None

    def __init__(self, path: Path, settings: BagSettings) -> None:
        self._path, self._settings = path, settings
        with opened(path) as bag:
            self._content = content_of(bag, settings)
            self._rig = self._aligned(bag)
        mounted = self._content.T_vehicle_lidar.tolist()
        self.lidar = LidarSensor(name=self._content.scan_frame or "lidar", T_vehicle_sensor=mounted)

    @property
    def notes(self) -> Notes:
        """Topics, and the frame of the poses."""
        topics = self._content.topics
        names = {role: None if (topic := getattr(topics, role)) is None else topic.name for role in ROLES}
        lines = [*topics.lines(), *self._content.remarks]
        lacking = self._settings.want_depth and topics.color is not None and topics.depth is None
        hint = (
            "no depth topic, so no image becomes a query: give --depth lidar (depth from the scans), --depth sgbm (depth from a stereo "
            "pair), --topic depth=NAME, or --no-pictures"
        )
        source: dict[str, Any] = {"path": self._path.name, "topics": names, "vehicle": self._content.vehicle}
        if self._rig is not None:
            source |= {"depth": "sgbm", "matching": RECORDED.description()}
            lines.append(_line_of(self._rig))
            if self._rig.rows is not None:
                source["row_alignment"] = asdict(self._rig.rows)
        if lacking:
            return Notes(tuple(lines), source, (hint,))
        has_depth = self._settings.want_depth and topics.color is not None
        unknown = has_depth and self._content.baseline_m is None
        or_topic = ", or its right CameraInfo with --topic right_info=NAME"
        return Notes(tuple(lines), source, (BASELINE_HINT.format(or_topic),) if unknown else ())

    @property
    def has_images(self) -> bool:
        """Whether the recording has images."""
        return self._content.topics.color is not None

    def count(self) -> int:
        """Count scans and colour images."""
        topics = self._content.topics
        return topics.scan.count + (topics.color.count if topics.color else 0)

    def trajectory(self) -> Trajectory | None:
        """Return T_map_vehicle from the topic of poses, or None."""
        return self._content.poses

    def events(self, *, pictures: bool = True) -> Iterator[Event]:
        """Yield scans and images in the bag's order. A damaged bag yields what can be read.

        Args:
            pictures: yield images too.
        """
        roles = self._roles(pictures and self._content.camera is not None)
        pairing = Pairing(PAIR_TOLERANCE_S if self._rig is None else STEREO_TOLERANCE_S)
        with opened(self._path) as bag:
            for found in bag.messages(roles):
                if isinstance(found, Damage):
                    kind = "bag" if found.is_end else "scan" if roles[found.topic] == "scan" else "image"
                    yield Unusable(kind, found.topic or self._path.name, found.why)
                    continue
                role, stamp_s = roles[found.topic], stamp_of(found.content.header)
                if role == "scan":
                    yield self._scan(found.content, stamp_s)
                elif role == "color" and "partner" not in roles.values():
                    yield self._picture(Pair(stamp_s, found.content, None))
                else:
                    yield from map(self._paired, pairing.add(role, stamp_s, found.content))
            yield from map(self._paired, pairing.finish())

    def _roles(self, pictures: bool) -> dict[str, str]:
        topics = self._content.topics
        roles = {topics.scan.name: "scan"}
        if pictures and topics.color is not None:
            roles[topics.color.name] = "color"
            if self._rig is not None and topics.right is not None:
                roles[topics.right.name] = "partner"
            elif self._settings.want_depth and topics.depth is not None:
                roles[topics.depth.name] = "partner"
        return roles

    def _scan(self, message: Any, stamp_s: float) -> Event:
        name = f"{self._content.topics.scan.name} at {stamp_s:.6f}"
        found = points_of_cloud(message, stamp_s=stamp_s, max_points=self._settings.max_points)
        return Unusable("scan", name, found) if isinstance(found, str) else RecordedScan(name, stamp_s, *found)

    def _paired(self, found: Pair | UnpairedImage) -> Event:
        if isinstance(found, Pair):
            return self._picture(found) if self._rig is None else self._matched(found, self._rig)
        why = _WITHOUT_DEPTH if self._rig is None else _WITHOUT_RIGHT
        return Unusable("image", f"{found.role} at {found.stamp_s:.6f}", why)

    def _aligned(self, bag: BagReader) -> StereoRig | None:
        """The stereo rig with the alignment of its rows, if pairs are matched."""
        rig, topics = self._content.rig, self._content.topics
        if rig is None or topics.color is None or topics.right is None:
            return None
        return rig.with_aligned_rows(spread_pairs(bag, topics.color.name, topics.right.name))

    def _matched(self, pair: Pair, rig: StereoRig) -> Event:
        camera, topic = self._content.camera, self._content.topics.color
        assert camera is not None  # noqa: S101  # a rig has a camera
        assert topic is not None  # noqa: S101
        name = f"{topic.name} at {pair.stamp_s:.6f}"
        images = rig.rectified(pair)
        if isinstance(images, str):
            return Unusable("image", name, images)
        depth = rig.depth(*images)
        return RecordedPicture(
            name,
            pair.stamp_s,
            images[0],
            rig.camera,
            camera.T_vehicle_camera,
            depth=depth,
            baseline_m=rig.baseline_m,
        )

    def _picture(self, pair: Pair) -> Event:
        camera, topic = self._content.camera, self._content.topics.color
        assert camera is not None  # noqa: S101  # colour is read only with a camera
        assert topic is not None  # noqa: S101
        name = f"{topic.name} at {pair.stamp_s:.6f}"
        rgb = colour_of(pair.color)
        depth = None if pair.partner is None else depth_of(pair.partner)
        if isinstance(rgb, str):
            return Unusable("image", name, rgb)
        if isinstance(depth, str):
            return Unusable("image", name, f"depth: {depth}")
        size = (camera.pinhole.height, camera.pinhole.width)
        if rgb.shape[:2] != size or (depth is not None and depth.shape != size):
            have = f"colour {rgb.shape[:2]}" + ("" if depth is None else f", depth {depth.shape}")
            return Unusable("image", name, f"sizes differ: {have}, camera {size}; record depth aligned to colour")
        return RecordedPicture(
            name,
            pair.stamp_s,
            rgb,
            camera.pinhole,
            camera.T_vehicle_camera,
            depth=depth,
            baseline_m=None if depth is None else self._content.baseline_m,
        )


def _line_of(rig: StereoRig) -> str:
    """How pairs are matched, for people."""
    of = "rectified" if rig.lookups is None else "raw images, rectified by their calibrations"
    rows = (
        "rows as recorded (too few matched features)"
        if rig.rows is None
        else f"rows aligned by {np.rad2deg(rig.rows.pitch_rad):.3f} degrees of pitch and {np.rad2deg(rig.rows.roll_rad):.3f} of roll"
    )
    return f"stereo pairs: {of}, baseline {rig.baseline_m:.4f} m; right camera: {rows}"
