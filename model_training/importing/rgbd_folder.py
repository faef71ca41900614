"""RGB-D recordings in folders: TUM's and Open3D's layouts. They have no LiDAR, so scans are made from their depth."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import LidarSensor, read_tum
from model_training.datasets.files import read_bytes
from model_training.importing.depth_scan import scan_from_depth
from model_training.importing.kitti_files import read_rgb
from model_training.importing.recording import BASELINE_HINT, PAIR_TOLERANCE_S, Event, Notes, RecordedPicture, Unusable
from model_training.importing.rectify import rectified
from model_training.importing.trajectory import Trajectory
from service.errors import DatasetError, StreetfixError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, Transform, transform_from
from service.imaging.depth_formats import read_depth_values
from service.imaging.picture_headers import ImageLimits

#: Depth step, metres: TUM's files have 5000 steps per metre; Open3D's tools write millimetres.
TUM_SCALE_M, OPEN3D_SCALE_M = 1 / 5000, 0.001
#: Frames per second of a folder without times.
RATE_HZ = 30.0
_AHEAD: Transform = transform_from(R_BODY_OPTICAL, np.zeros(3))
_LIMITS = ImageLimits()


@dataclass(frozen=True, slots=True)
class RgbdFrame:
    """Files of one moment.

    Attributes:
        stamp_s: time, seconds.
        rgb: colour image.
        depth: depth image.
    """

    stamp_s: float
    rgb: Path
    depth: Path


@dataclass(frozen=True, slots=True)
class RgbdFolder:
    """A recording of one RGB-D camera. The vehicle frame is the camera's body: x forward, z up.

    Attributes:
        kind: ``tum-rgbd`` or ``open3d``.
        path: folder of the recording.
        frames: in order of time.
        camera: intrinsics.
        scale_m: metres per step of an integer depth.
        poses: T_map_vehicle, or None.
        baseline_m: of the stereo rig that measured the depth, metres; None if it is not known.
        lidar: stands for the depth camera.
        georeference: always None.
    """

    kind: str
    path: Path
    frames: tuple[RgbdFrame, ...]
    camera: PinholeCamera
    scale_m: float
    poses: Trajectory | None
    baseline_m: float | None = None
    lidar: LidarSensor = field(
        default_factory=lambda: LidarSensor(name="depth camera", T_vehicle_sensor=np.eye(4).tolist())
    )
    georeference: dict[str, Any] | None = None

    @property
    def notes(self) -> Notes:
        """Number of frames."""
        line = (
            f"{len(self.frames)} RGB-D frames; scans come from their depth, so the map covers only what the camera saw"
        )
        hints = (BASELINE_HINT.format(""),) if self.baseline_m is None else ()
        return Notes((line,), {"path": self.path.name}, hints)

    @property
    def has_images(self) -> bool:
        """Whether the recording has images."""
        return bool(self.frames)

    def count(self) -> int:
        """Count one scan and one image per frame."""
        return 2 * len(self.frames)

    def trajectory(self) -> Trajectory | None:
        """Return T_map_vehicle as the recording gives it, or None."""
        return self.poses

    def events(self, *, pictures: bool = True) -> Iterator[Event]:
        """Yield the scan of each frame, then its image pair.

        Args:
            pictures: yield image pairs too.
        """
        for frame in self.frames:
            picture = self._picture(frame)
            if isinstance(picture, Unusable):
                yield picture
                continue
            scan = scan_from_depth(rectified(picture))
            yield Unusable("scan", picture.name, "the image has no depth") if scan is None else scan
            if pictures:
                yield picture

    def _picture(self, frame: RgbdFrame) -> RecordedPicture | Unusable:
        rgb: NDArray[np.uint8] | None = None
        try:
            rgb = read_rgb(frame.rgb)
            values = read_depth_values(frame.depth.read_bytes(), encoding=None, limits=_LIMITS)
        except (StreetfixError, OSError) as error:
            file = "its depth" if rgb is not None else "it"
            why = (
                "is missing"
                if isinstance(error.__cause__ or error, FileNotFoundError)
                else f"cannot be read ({type(error).__name__})"
            )
            return Unusable("image", frame.rgb.name, f"{file} {why}")
        depth = np.asarray(values, np.uint16) if values.dtype == np.uint16 else np.asarray(values, np.float32)
        size = (self.camera.height, self.camera.width)
        if rgb.shape[:2] != size or depth.shape != size:
            return Unusable(
                "image", frame.rgb.name, f"sizes differ: colour {rgb.shape[:2]}, depth {depth.shape}, camera {size}"
            )
        return RecordedPicture(
            frame.rgb.name,
            frame.stamp_s,
            rgb,
            self.camera,
            _AHEAD,
            depth=depth,
            depth_scale_m=self.scale_m,
            file=frame.rgb,
            baseline_m=self.baseline_m,
        )


def open_tum_rgbd(source: Path, camera: PinholeCamera | None, baseline_m: float | None = None) -> RgbdFolder:
    """Open TUM's layout: ``rgb.txt``, ``depth.txt``, ``groundtruth.txt`` (T_world_camera) and the images that they name.

    Args:
        source: the folder.
        camera: intrinsics; the layout does not contain them.
        baseline_m: of the stereo rig that measured the depth, metres; None for other depth.

    Raises:
        DatasetError: a list is missing or broken, no colour image has a depth image, or there is no camera.
    """
    colour, depth = (_listed(source / name) for name in ("rgb.txt", "depth.txt"))
    stamps = np.array([stamp for stamp, _ in depth])
    frames = []
    for stamp_s, path in colour:
        nearest = int(np.argmin(np.abs(stamps - stamp_s)))
        if abs(stamps[nearest] - stamp_s) <= PAIR_TOLERANCE_S:
            frames.append(RgbdFrame(stamp_s, path, depth[nearest][1]))
    if not frames:
        raise DatasetError(
            f"{source}: no depth image within {PAIR_TOLERANCE_S:g} s of any colour image", field="depth.txt"
        )
    if camera is None:
        raise DatasetError(
            f"{source}: TUM's layout has no camera parameters; give --camera FILE with width, height, fx, fy, cx, cy",
            field="camera",
        )
    truth = source / "groundtruth.txt"
    poses = None
    if truth.is_file():
        times, T = read_tum(truth)
        poses = Trajectory(times, T, str(truth)).moved_by(_AHEAD)
    return RgbdFolder("tum-rgbd", source, tuple(frames), camera, TUM_SCALE_M, poses, baseline_m)


def open_open3d(source: Path, camera: PinholeCamera | None, baseline_m: float | None = None) -> RgbdFolder:
    """Open a folder of Open3D's reconstruction: ``color``, ``depth``, ``camera_intrinsic.json``, ``trajectory.log``.

    Args:
        source: the folder.
        camera: intrinsics; by default those of the JSON file.
        baseline_m: of the stereo rig that measured the depth, metres; None for other depth.

    Raises:
        DatasetError: images, camera or a pose are missing or broken.
    """
    folder = next((source / name for name in ("color", "rgb", "image") if (source / name).is_dir()), source / "color")
    colour, depth = (
        sorted(p for p in where.iterdir() if p.suffix in (".jpg", ".png")) if where.is_dir() else []
        for where in (folder, source / "depth")
    )
    if not colour or len(colour) != len(depth):
        raise DatasetError(
            f"{source}: color and depth must have the same number of images; they have {len(colour)} and {len(depth)}",
            field="source",
        )
    intrinsics = next(
        (p for name in ("camera_intrinsic.json", "intrinsic.json") if (p := source / name).is_file()), None
    )
    if camera is None and intrinsics is not None:
        camera = _open3d_camera(intrinsics)
    if camera is None:
        raise DatasetError(f"{source}: camera_intrinsic.json not found; add it, or give --camera FILE", field="camera")
    frames = tuple(RgbdFrame(k / RATE_HZ, a, b) for k, (a, b) in enumerate(zip(colour, depth, strict=True)))
    log = next((p for p in (source / "trajectory.log", source / "scene" / "trajectory.log") if p.is_file()), None)
    poses = None if log is None else _open3d_poses(log).moved_by(_AHEAD)
    return RgbdFolder("open3d", source, frames, camera, OPEN3D_SCALE_M, poses, baseline_m)


def _listed(path: Path) -> list[tuple[float, Path]]:
    """Read times and files of one of TUM's lists."""
    if not path.is_file():
        raise DatasetError(f"{path} is missing; TUM's layout has it beside the images", field=path.name)
    found = []
    for number, line in enumerate(read_bytes(path).decode(errors="replace").splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        parts = line.split()
        try:
            stamp_s, name = float(parts[0]), parts[1]
        except (ValueError, IndexError) as error:
            raise DatasetError(
                f"{path}, line {number}: not `timestamp file`: {line[:60]!r}; write seconds and a path, with a space between",
                field=path.name,
            ) from error
        named = (path.parent / name).resolve()
        if not named.is_relative_to(path.parent.resolve()):
            raise DatasetError(
                f"{path}, line {number}: the file {name[:60]!r} is outside the recording; copy it into {path.parent} "
                "and give its path relative to this folder",
                field=path.name,
            )
        found.append((stamp_s, named))
    if not found:
        raise DatasetError(f"{path} lists no image; write one line `timestamp file` per image", field=path.name)
    return found


def _open3d_camera(path: Path) -> PinholeCamera:
    try:
        loaded = json.loads(path.read_text())
        K = np.array(loaded["intrinsic_matrix"], np.float64).reshape(3, 3).T  # stored column by column
        return PinholeCamera(int(loaded["width"]), int(loaded["height"]), K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    except (OSError, json.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        raise DatasetError(
            f"{path}: not a camera file of Open3D ({type(error).__name__}: {error}); it needs width, height and "
            "intrinsic_matrix (9 numbers, column by column). Correct it, or give --camera FILE",
            field=path.name,
        ) from error


def _open3d_poses(path: Path) -> Trajectory:
    """Read T_world_camera: per frame a line of three integers, then four rows of the matrix."""
    lines = [line for line in read_bytes(path).decode(errors="replace").splitlines() if line.strip()]
    stamps, poses = [], []
    for start in range(0, len(lines), 5):
        try:
            T = np.array([line.split() for line in lines[start + 1 : start + 5]], np.float64).reshape(4, 4)
            stamps.append(int(lines[start].split()[0]) / RATE_HZ)
        except (ValueError, IndexError) as error:
            raise DatasetError(
                f"{path}, line {start + 1}: not a frame of five lines; write a line of three integers, then the four rows "
                "of T_world_camera",
                field=path.name,
            ) from error
        R = T[:3, :3]
        if not (np.isfinite(T).all() and np.allclose(R @ R.T, np.eye(3), atol=1e-3)):
            raise DatasetError(
                f"{path}, line {start + 1}: the matrix of the frame is not a valid pose; its rotation must be orthonormal "
                "and its numbers finite. Correct or remove the five lines of this frame",
                field=path.name,
            )
        poses.append(T)
    return Trajectory(np.array(stamps), np.array(poses).reshape(-1, 4, 4), str(path))
