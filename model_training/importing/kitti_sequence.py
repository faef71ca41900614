"""Common part of KITTI's raw, odometry and 360 layouts: numbered frames of a rig with one calibration."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from model_training.datasets.dataset import LidarSensor
from model_training.importing.kitti_calibration import KittiCalibration
from model_training.importing.kitti_files import read_rgb, read_stored_depth
from model_training.importing.recording import Event, Notes, RecordedPicture, RecordedScan, Unusable
from model_training.importing.row_alignment import PAIRS, Rgb, RowAlignment, row_alignment
from model_training.importing.scan_file import read_scan
from model_training.importing.spinning import raised, times_by_azimuth
from model_training.importing.stereo import RECORDED, depth_from_stereo
from model_training.importing.trajectory import Trajectory
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import inverse

#: Step of KITTI's stored depth, metres; 16 bits reach 256 m.
STORED_SCALE_M = 1 / 256
#: Frames per second if the recording has no times.
RATE_HZ = 10.0
#: KITTI's LiDAR. The vehicle frame is its frame.
HDL64 = LidarSensor(
    name="hdl-64", channels=64, top_deg=2.0, bottom_deg=-24.8, max_range_m=120.0, T_vehicle_sensor=np.eye(4).tolist()
)
KittiDepth = Literal["none", "stored", "sgbm"]


@dataclass(frozen=True, slots=True)
class KittiFrame:
    """The files of one moment; None for a file that is missing.

    Attributes:
        name: number of the frame.
        stamp_s: time, seconds.
        scan: the scan.
        left: left image.
        right: right image.
        stored: stored depth of the left image.
    """

    name: str
    stamp_s: float
    scan: Path | None
    left: Path | None
    right: Path | None
    stored: Path | None


@dataclass(frozen=True, slots=True)
class KittiSequence:
    """A KITTI drive. The vehicle frame is the LiDAR frame.

    Attributes:
        kind: ``kitti-raw``, ``kitti-odometry`` or ``kitti-360``.
        path: folder of the drive.
        frames: in order of time.
        calibration: of all frames.
        depth: source of an image's depth; ``none`` yields images without depth.
        poses: T_map_lidar, or None.
        georeference: of the map's origin, or None.
        lidar: the LiDAR.
        turn_s: time of one turn of the LiDAR, seconds: the times of points follow from their azimuths. None if the scans are
            already compensated.
        vertical_deg: rotation upwards of every point, degrees.
        rows: how far the rows of a stereo pair are apart; None if it is not known.
    """

    kind: str
    path: Path
    frames: tuple[KittiFrame, ...]
    calibration: KittiCalibration
    depth: KittiDepth
    poses: Trajectory | None
    georeference: dict[str, Any] | None = None
    lidar: LidarSensor = HDL64
    turn_s: float | None = None
    vertical_deg: float = 0.0
    rows: RowAlignment | None = None

    def with_aligned_rows(self) -> "KittiSequence":
        """Return the drive with the alignment of its rows, measured on some of its pairs; pairs that cannot be read are omitted."""
        paired = [frame for frame in self.frames if frame.left is not None and frame.right is not None]
        chosen = {int(k) for k in np.linspace(0, len(paired) - 1, PAIRS).round()} if paired else set()
        pairs = [pair for k in sorted(chosen) if (pair := _pair(paired[k])) is not None]
        return replace(self, rows=row_alignment(pairs, self._camera(pairs[0][0])) if pairs else None)

    @property
    def notes(self) -> Notes:
        """Numbers of scans and images, and how times and angles of points are treated."""
        scans, left, right = (
            sum(getattr(frame, kind) is not None for frame in self.frames) for kind in ("scan", "left", "right")
        )
        source: dict[str, Any] = {
            "path": self.path.name,
            "depth": self.depth,
            "vertical_correction_deg": self.vertical_deg,
            "point_times": "none" if self.turn_s is None else "azimuth",
        }
        if self.turn_s is not None:
            source["turn_s"] = self.turn_s
        if self.depth == "sgbm":
            source["matching"] = RECORDED.description()
        times = (
            "scans are assumed to be corrected for the vehicle's motion"
            if self.turn_s is None
            else f"points' times by azimuth, {self.turn_s:.4f} s per turn"
        )
        turned = f"; points turned up by {self.vertical_deg:g} degrees" if self.vertical_deg else ""
        counted = f"{len(self.frames)} moments: {scans} scans, {left} left and {right} right images"
        lines = [counted, times + turned]
        if self.rows is not None:
            source["row_alignment"] = asdict(self.rows)
            lines.append(
                f"the right camera is turned by {np.rad2deg(self.rows.pitch_rad):.3f} degrees of pitch and "
                f"{np.rad2deg(self.rows.roll_rad):.3f} of roll ({self.rows.matches} matched features): its rows are aligned"
            )
        needed = {"stored": "stored", "sgbm": "right"}.get(self.depth)
        lacking = left > 0 and needed and not any(frame.left and getattr(frame, needed) for frame in self.frames)
        what = "stored depth" if needed == "stored" else "a right image"
        hint = (
            f"no image has {what}, so no image becomes a query: {self._depth_choices()}; --no-pictures imports no "
            "images"
        )
        return Notes(tuple(lines), source, (hint,) if lacking else ())

    def _depth_choices(self) -> str:
        """Which values of ``--depth`` serve this recording, and why the others do not."""
        left = sum(frame.left is not None for frame in self.frames)
        stored = sum(frame.left is not None and frame.stored is not None for frame in self.frames)
        pairs = sum(frame.left is not None and frame.right is not None for frame in self.frames)
        scans = sum(frame.scan is not None for frame in self.frames)
        pictures = f"of {left} image{'s' * (left != 1)}"
        choices = []
        if self.kind != "kitti-360":
            choices.append(f"stored ({stored} {pictures} {'has' if stored == 1 else 'have'} it)")
        if self.calibration.focal_baseline_px_m is None:
            choices.append("sgbm (not possible: the calibration lacks the right camera)")
        else:
            choices.append(f"sgbm ({pairs} {pictures} {'has' if pairs == 1 else 'have'} a right one)")
        choices.append(f"lidar ({scans} scan{'s' * (scans != 1)})")
        return f"the choices of --depth are {', '.join(choices)}"

    @property
    def has_images(self) -> bool:
        """Whether the recording has images."""
        return any(frame.left is not None for frame in self.frames)

    def count(self) -> int:
        """Count the scans and the left images."""
        return sum((frame.scan is not None) + (frame.left is not None) for frame in self.frames)

    def trajectory(self) -> Trajectory | None:
        """Return T_map_lidar as the recording gives it, or None."""
        return self.poses

    def events(self, *, pictures: bool = True) -> Iterator[Event]:
        """Yield scan and image of each frame.

        Args:
            pictures: yield images too.

        Raises:
            DatasetError: depth ``sgbm`` is wanted, and the right camera is not calibrated.
        """
        if pictures and self.depth == "sgbm" and self.calibration.focal_baseline_px_m is None:
            raise DatasetError(
                f"{self.path}: the calibration has no right camera (P3), so stereo has no baseline; add it, or use "
                "--depth lidar",
                field="P3",
            )
        choices = self._depth_choices()
        for frame in self.frames:
            if frame.scan is not None:
                points = read_scan(frame.scan)
                name = f"velodyne {frame.name}"
                yield Unusable("scan", name, points) if isinstance(points, str) else self._scan(name, frame, points)
            if pictures and frame.left is not None:
                yield self._picture(frame, frame.left, choices)

    def _scan(self, name: str, frame: KittiFrame, points: NDArray[np.float32]) -> RecordedScan:
        offsets = None if self.turn_s is None else times_by_azimuth(points, period_s=self.turn_s)
        return RecordedScan(name, frame.stamp_s, raised(points, self.vertical_deg), offsets)

    def _picture(self, frame: KittiFrame, left: Path, choices: str) -> RecordedPicture | Unusable:
        name, calibration = f"image {frame.name}", self.calibration
        try:
            rgb = read_rgb(left)
            picture = RecordedPicture(
                name,
                frame.stamp_s,
                rgb,
                self._camera(rgb),
                inverse(calibration.T_camera_lidar),
                depth_scale_m=STORED_SCALE_M,
                file=left,
            )
            if self.depth == "stored":
                if frame.stored is None:
                    return Unusable("image", name, f"no stored depth beside it; {choices}")
                return replace(picture, depth=read_stored_depth(frame.stored, rgb.shape[:2]))
            if self.depth == "sgbm":
                if frame.right is None:
                    return Unusable("image", name, f"no right image beside it; {choices}")
                return self._matched(picture, read_rgb(frame.right))
            return picture
        except DatasetError as error:
            return Unusable("image", name, _without_names(error.message, (left, frame.right, frame.stored)))

    def _camera(self, rgb: Rgb) -> PinholeCamera:
        of = self.calibration
        return PinholeCamera(rgb.shape[1], rgb.shape[0], of.fx, of.fy, of.cx, of.cy)

    def _matched(self, picture: RecordedPicture, right: Rgb) -> RecordedPicture | Unusable:
        if right.shape != picture.rgb.shape:
            return Unusable("image", picture.name, "its right image has another size")
        assert self.calibration.focal_baseline_px_m is not None  # noqa: S101  # ``events`` checked this
        if self.rows is not None:
            right = self.rows.aligned(right, picture.camera)
        depth_m: Float32[NDArray[np.float32], "H W"] = depth_from_stereo(
            picture.rgb, right, focal_baseline_px_m=self.calibration.focal_baseline_px_m
        )
        return replace(picture, depth=depth_m, baseline_m=self.calibration.baseline_m)


def _pair(frame: KittiFrame) -> tuple[Rgb, Rgb] | None:
    """Read both images of a frame; None if one is missing or broken, or if their sizes differ."""
    if frame.left is None or frame.right is None:
        return None
    try:
        left, right = read_rgb(frame.left), read_rgb(frame.right)
    except DatasetError:  # the event of this frame reports it
        return None
    return (left, right) if left.shape == right.shape else None


def _without_names(message: str, files: tuple[Path | None, ...]) -> str:
    """Remove file names from a message, so that equal errors of several files count as one."""
    for path in files:
        if path is not None:
            message = message.replace(f"{path}: ", f"{path.parent.name}: ")
    return message


def numbered(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Return the files of a folder by their number; other files are ignored.

    Args:
        folder: need not exist.
        suffixes: of the wanted files.
    """
    if not folder.is_dir():
        return {}
    return {
        int(path.stem): path for path in sorted(folder.iterdir()) if path.stem.isdigit() and path.suffix in suffixes
    }
