"""The formats of recordings, and how each is opened. The packages of a format are imported only when it is opened."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from model_training.importing.extrinsics import Extrinsics
from model_training.importing.recording import Recording
from model_training.importing.spinning import KITTI_VERTICAL_DEG
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera

if TYPE_CHECKING:
    from model_training.importing.kitti_sequence import KittiSequence

DepthFrom = Literal["recorded", "stored", "sgbm", "lidar"]


@dataclass(frozen=True, slots=True)
class OpenSettings:
    """Settings of a reader. Each reader uses those that concern it.

    Attributes:
        depth: source of an image's depth.
        topics: topics of a bag, by role.
        extrinsics: mountings that the recording does not contain.
        camera: intrinsics that the recording does not contain.
        rectified: whether the images of a bag are rectified already; None decides by the topic's name.
        poses: TUM file of poses; scans in their own files take their times from it.
        pictures: whether images will be read.
        vertical_correction: correct the vertical angle of KITTI's HDL-64; False does not.
        baseline_m: of the stereo rig that measured the recorded depth, metres; None if it is not known.
    """

    depth: DepthFrom = "recorded"
    topics: Mapping[str, str] = field(default_factory=dict)
    extrinsics: Extrinsics | None = None
    camera: PinholeCamera | None = None
    rectified: bool | None = None
    poses: Path | None = None
    pictures: bool = True
    vertical_correction: bool | None = None
    baseline_m: float | None = None

    @property
    def kitti_vertical_deg(self) -> float:
        """Rotation upwards of KITTI's points, degrees."""
        return 0.0 if self.vertical_correction is False else KITTI_VERTICAL_DEG


@dataclass(frozen=True, slots=True)
class Kind:
    """A format.

    Attributes:
        open: its reader.
        depths: sources of depth that it offers.
        takes: options of ``streetfix import`` that it uses, without dashes.
    """

    open: Callable[[Path, OpenSettings], Recording]
    depths: tuple[DepthFrom, ...]
    takes: frozenset[str] = frozenset()


#: Settings of a reader that concern only some formats, and their options on the command line.
_OPTIONS = {
    "topics": "topic",
    "extrinsics": "extrinsics",
    "camera": "camera",
    "rectified": "rectified",
    "vertical_correction": "vertical-correction",
    "baseline_m": "baseline-m",
}


def open_recording(kind: str, source: Path, settings: OpenSettings) -> Recording:
    """Open a recording.

    Args:
        kind: one of ``KINDS``.
        source: its file or folder.
        settings: for the reader.

    Raises:
        DatasetError: the kind is unknown, a setting does not apply to it, or the reader cannot open the source.
    """
    if kind not in KINDS:
        raise DatasetError(
            f"kind: {kind!r} is not a known format; choose one of: {', '.join(sorted(KINDS))}", field="kind"
        )
    if not source.exists():
        raise DatasetError(f"{source}: file or folder not found", field="source")
    _refuse_what_does_not_apply(kind, settings)
    return KINDS[kind].open(source, settings)


def _refuse_what_does_not_apply(kind: str, settings: OpenSettings) -> None:
    known, unasked = KINDS[kind], OpenSettings()
    if settings.depth not in known.depths:
        raise DatasetError(
            f"depth: {kind} has no {settings.depth!r} depth; choose one of: {', '.join(known.depths)}", field="depth"
        )
    for field_name, option in _OPTIONS.items():
        if option not in known.takes and getattr(settings, field_name) != getattr(unasked, field_name):
            raise DatasetError(f"{option}: {kind} does not support this option; omit it", field=option)
    _refuse_topics_of_other_depth(settings)
    _refuse_baseline_without_its_depth(settings)


def _refuse_topics_of_other_depth(settings: OpenSettings) -> None:
    """Refuse right images that are not matched, and depth that matching replaces."""
    if "right" in settings.topics and settings.depth != "sgbm":
        raise DatasetError(
            "topic right: only --depth sgbm matches left and right images; give --depth sgbm too, or omit the topic",
            field="topic",
        )
    if "depth" in settings.topics and settings.depth == "sgbm":
        raise DatasetError(
            "topic depth: --depth sgbm computes the depth from left and right images; omit one of the two",
            field="topic",
        )


def _refuse_baseline_without_its_depth(settings: OpenSettings) -> None:
    """Refuse a baseline that no imported depth has, and one that is given twice."""
    of_topic = "right_info" in settings.topics
    if settings.baseline_m is None and not of_topic:
        return
    field_name = "topic" if settings.baseline_m is None else "baseline-m"
    named = "topic right_info" if settings.baseline_m is None else f"baseline-m {settings.baseline_m:g}"
    if settings.baseline_m is not None and of_topic:
        raise DatasetError(f"{named}: the topic right_info gives a baseline too; give one of the two", field=field_name)
    if not settings.pictures or settings.depth == "lidar":
        cause = (
            "--depth lidar takes the depth from the scans" if settings.pictures else "--no-pictures imports no depth"
        )
        raise DatasetError(f"{named}: {cause}, so there is no stereo depth; omit one of the two", field=field_name)


def _kitti_raw(source: Path, settings: OpenSettings) -> Recording:
    from model_training.importing.kitti_raw import open_kitti_raw

    depth = _kitti_depth(settings.depth)
    return _aligned(open_kitti_raw(source, depth=depth, vertical_deg=settings.kitti_vertical_deg), settings)


def _kitti_odometry(source: Path, settings: OpenSettings) -> Recording:
    from model_training.importing.kitti_odometry import open_kitti_odometry

    depth = _kitti_depth(settings.depth)
    return _aligned(open_kitti_odometry(source, depth=depth, vertical_deg=settings.kitti_vertical_deg), settings)


def _kitti_360(source: Path, settings: OpenSettings) -> Recording:
    from model_training.importing.kitti_360 import open_kitti_360

    # The layout has no stored depth, so the default is stereo-matched depth.
    return _aligned(open_kitti_360(source, depth="none" if settings.depth == "lidar" else "sgbm"), settings)


def _clouds(source: Path, settings: OpenSettings) -> Recording:
    from model_training.importing.clouds import open_clouds

    return open_clouds(source, settings.poses)


def _carla(source: Path, settings: OpenSettings) -> Recording:
    from model_training.importing.carla_folder import open_carla

    del settings
    return open_carla(source)


def _tum_rgbd(source: Path, settings: OpenSettings) -> Recording:
    from model_training.importing.rgbd_folder import open_tum_rgbd

    return open_tum_rgbd(source, settings.camera, settings.baseline_m)


def _open3d(source: Path, settings: OpenSettings) -> Recording:
    from model_training.importing.rgbd_folder import open_open3d

    return open_open3d(source, settings.camera, settings.baseline_m)


def _rosbag(source: Path, settings: OpenSettings) -> Recording:
    from model_training.importing.ros_bag import RosBag
    from model_training.importing.ros_content import BagSettings

    bag = BagSettings(
        settings.topics,
        extrinsics=settings.extrinsics or Extrinsics(),
        camera=settings.camera,
        rectified=settings.rectified,
        want_pictures=settings.pictures,
        want_depth=settings.depth == "recorded",
        stereo=settings.depth == "sgbm" and settings.pictures,
        baseline_m=settings.baseline_m,
    )
    return RosBag(source, bag)


def _aligned(drive: "KittiSequence", settings: OpenSettings) -> Recording:
    """Return a drive with aligned rows if its pairs will be matched."""
    return drive.with_aligned_rows() if drive.depth == "sgbm" and settings.pictures else drive


def _kitti_depth(depth: DepthFrom) -> Literal["none", "stored", "sgbm"]:
    return "none" if depth == "lidar" else "stored" if depth in ("stored", "recorded") else "sgbm"


_KITTI: tuple[DepthFrom, ...] = ("recorded", "stored", "sgbm", "lidar")
#: Options of every drive: its poses and their frame, and the scans that the survey leaves out.
_DRIVE = frozenset(
    {"poses", "align", "odometry", "loops", "lidar-height", "hold-out", "hold-out-first", "georeference"}
)
#: Options of drives with images. Without images, each scan has a pose at its own time, so ``sync`` and ``tolerance`` have no effect.
_FILMED = _DRIVE | {"pictures", "queries", "sync", "tolerance"}
_RGBD = _FILMED | {"camera", "baseline-m"}
#: All formats by name.
KINDS: dict[str, Kind] = {
    "kitti-raw": Kind(_kitti_raw, _KITTI, _FILMED | {"depth", "deskew", "vertical-correction"}),
    "kitti-odometry": Kind(_kitti_odometry, _KITTI, _FILMED | {"depth", "vertical-correction"}),
    "kitti-360": Kind(_kitti_360, ("recorded", "sgbm", "lidar"), _FILMED | {"depth", "deskew"}),
    "rosbag": Kind(
        _rosbag,
        ("recorded", "sgbm", "lidar"),
        _FILMED | {"depth", "deskew", "topic", "extrinsics", "camera", "rectified", "baseline-m"},
    ),
    "carla": Kind(_carla, ("recorded", "lidar"), _FILMED | {"depth"}),
    "clouds": Kind(_clouds, ("recorded",), _DRIVE),
    "open3d": Kind(_open3d, ("recorded",), _RGBD),
    "tum-rgbd": Kind(_tum_rgbd, ("recorded",), _RGBD),
}
