"""Which formats there are, and how each is opened; a format's packages are imported when it is."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from model_training.importing.extrinsics import Extrinsics
from model_training.importing.recording import Recording
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera

DepthFrom = Literal["recorded", "stored", "sgbm", "lidar"]


@dataclass(frozen=True, slots=True)
class OpenSettings:
    """What a reader is told; each takes what concerns it.

    Attributes:
        depth: what a picture's depth comes from.
        topics: of a bag, by role.
        extrinsics: mountings that the recording does not tell.
        camera: intrinsics that the recording does not tell.
        rectified: whether a bag's pictures are rectified already; None believes the topic's name.
    """

    depth: DepthFrom = "recorded"
    topics: Mapping[str, str] = field(default_factory=dict)
    extrinsics: Extrinsics = field(default_factory=Extrinsics)
    camera: PinholeCamera | None = None
    rectified: bool | None = None


def open_recording(kind: str, source: Path, settings: OpenSettings) -> Recording:
    """Open a recording.

    Args:
        kind: one of ``KINDS``.
        source: its file or folder.
        settings: for the reader.

    Raises:
        DatasetError: the kind is not known, or the reader cannot open it.
    """
    if kind not in KINDS:
        raise DatasetError(f"kind: {kind!r} is not known; there is: {', '.join(sorted(KINDS))}", field="kind")
    if not source.exists():
        raise DatasetError(f"{source}: there is nothing of that name", field="source")
    return KINDS[kind](source, settings)


def _kitti_raw(source: Path, settings: OpenSettings) -> Recording:
    from model_training.importing.kitti_raw import open_kitti_raw

    return open_kitti_raw(source, depth=_kitti_depth(settings.depth))


def _kitti_odometry(source: Path, settings: OpenSettings) -> Recording:
    from model_training.importing.kitti_odometry import open_kitti_odometry

    return open_kitti_odometry(source, depth=_kitti_depth(settings.depth))


def _clouds(source: Path, settings: OpenSettings) -> Recording:
    from model_training.importing.clouds import open_clouds

    del settings  # nothing of them concerns scans in files
    return open_clouds(source)


def _carla(source: Path, settings: OpenSettings) -> Recording:
    from model_training.importing.carla_folder import open_carla

    del settings
    return open_carla(source)


def _tum_rgbd(source: Path, settings: OpenSettings) -> Recording:
    from model_training.importing.rgbd_folder import open_tum_rgbd

    return open_tum_rgbd(source, settings.camera)


def _open3d(source: Path, settings: OpenSettings) -> Recording:
    from model_training.importing.rgbd_folder import open_open3d

    return open_open3d(source, settings.camera)


def _rosbag(source: Path, settings: OpenSettings) -> Recording:
    from model_training.importing.ros_bag import BagSettings, RosBag

    if settings.depth not in ("recorded", "lidar"):
        raise DatasetError(f"depth: a bag has no {settings.depth!r} depth; give recorded or lidar", field="depth")
    bag = BagSettings(
        settings.topics, extrinsics=settings.extrinsics, rectified=settings.rectified, want_depth=settings.depth == "recorded"
    )  # fmt: skip
    return RosBag(source, bag)


def _kitti_depth(depth: DepthFrom) -> Literal["none", "stored", "sgbm"]:
    return "none" if depth == "lidar" else "stored" if depth in ("stored", "recorded") else "sgbm"


KINDS: dict[str, Callable[[Path, OpenSettings], Recording]] = {
    "kitti-raw": _kitti_raw,
    "kitti-odometry": _kitti_odometry,
    "rosbag": _rosbag,
    "carla": _carla,
    "clouds": _clouds,
    "open3d": _open3d,
    "tum-rgbd": _tum_rgbd,
}
