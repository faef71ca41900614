"""CARLA recordings on disk, as ``save_to_disk`` writes them: PLY, PNG and 24-bit depth PNG, with poses and mountings.

``recording.json`` holds the mountings of the sensors and the camera's field of view. ``poses.csv`` holds the vehicle's pose
in each frame. Both use CARLA's own convention. ``streetfix record carla`` writes both files.
"""

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from model_training.datasets.dataset import LidarSensor
from model_training.importing.carla_frame import T_from_carla, depth_from_carla, optical, points_from_carla
from model_training.importing.cloud_file import read_cloud
from model_training.importing.kitti_files import read_rgb
from model_training.importing.recording import Event, Notes, RecordedPicture, RecordedScan, Unusable
from model_training.importing.trajectory import Trajectory
from service.errors import DatasetError, StreetfixError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Transform
from service.imaging.decode import ImageLimits
from service.imaging.picture_headers import header_of, require_pixels

_LIMITS = ImageLimits()


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Mounting(_Model):
    """A ``carla.Transform`` relative to the vehicle, in CARLA's left-handed frame.

    Attributes:
        x: forward, metres.
        y: to the right, metres.
        z: up, metres.
        roll: degrees.
        pitch: degrees.
        yaw: degrees.
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0

    def T_vehicle_sensor(self) -> Transform:
        """Convert the mounting to a right-handed transform of a body: x forward, y left, z up."""
        return T_from_carla(self.x, self.y, self.z, self.roll, self.pitch, self.yaw)


class CarlaCamera(_Model):
    """An RGB and a depth camera with the same mounting.

    Attributes:
        width: pixels.
        height: pixels.
        fov_deg: horizontal field of view from edge to edge, degrees.
        mounting: on the vehicle.
    """

    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fov_deg: float = Field(gt=0, lt=180)
    mounting: Mounting = Mounting()

    def pinhole(self) -> PinholeCamera:
        """Return the intrinsics. CARLA's field of view is horizontal and reaches from edge to edge."""
        focal = self.width / (2.0 * np.tan(np.deg2rad(self.fov_deg) / 2))
        return PinholeCamera(self.width, self.height, focal, focal, (self.width - 1) / 2, (self.height - 1) / 2)


class CarlaLidar(_Model):
    """The ray-cast LiDAR.

    Attributes:
        channels: number of beams.
        upper_fov_deg: elevation of the highest beam, degrees.
        lower_fov_deg: elevation of the lowest beam, degrees.
        range_m: greatest range, metres.
        mounting: on the vehicle.
    """

    channels: int = 32
    upper_fov_deg: float = 10.0
    lower_fov_deg: float = -30.0
    range_m: float = 100.0
    mounting: Mounting = Mounting()


class CarlaRecording(_Model):
    """Content of ``recording.json``.

    Attributes:
        town: name of CARLA's map.
        lidar: the LiDAR.
        camera: the camera; None without images.
    """

    town: str = ""
    lidar: CarlaLidar
    camera: CarlaCamera | None = None


@dataclass(frozen=True, slots=True)
class CarlaFolder:
    """A CARLA recording. The vehicle frame is at the actor's origin, on the ground.

    Attributes:
        path: folder of the recording.
        recording: content of ``recording.json``.
        frames: names of the frames, in order.
        poses: T_map_vehicle at the frames.
        kind: name of the format.
        georeference: always None.
    """

    path: Path
    recording: CarlaRecording
    frames: tuple[str, ...]
    poses: Trajectory
    kind: str = "carla"
    georeference: dict[str, Any] | None = None

    @property
    def lidar(self) -> LidarSensor:
        """The LiDAR in our convention."""
        lidar = self.recording.lidar
        return LidarSensor(
            name="carla",
            channels=lidar.channels,
            top_deg=lidar.upper_fov_deg,
            bottom_deg=lidar.lower_fov_deg,
            max_range_m=lidar.range_m,
            T_vehicle_sensor=lidar.mounting.T_vehicle_sensor().tolist(),
        )

    @property
    def notes(self) -> Notes:
        """Number of frames, and the town."""
        town = f" of {self.recording.town}" if self.recording.town else ""
        return Notes((f"{len(self.frames)} frames{town}",), {"path": self.path.name, "town": self.recording.town})

    @property
    def has_images(self) -> bool:
        """Whether the recording has images."""
        return self.recording.camera is not None

    def count(self) -> int:
        """Count one scan per frame, and one image per frame if there is a camera."""
        return len(self.frames) * (2 if self.recording.camera else 1)

    def trajectory(self) -> Trajectory | None:
        """Return T_map_vehicle. The map frame is CARLA's world, mirrored to be right-handed, as in its OpenDRIVE file."""
        return self.poses

    def events(self, *, pictures: bool = True) -> Iterator[Event]:
        """Yield scan and image of each frame.

        Args:
            pictures: yield images too.
        """
        for name, stamp_s in zip(self.frames, self.poses.stamps_s, strict=True):
            scan = self.path / "lidar" / f"{name}.ply"
            points = read_cloud(scan) if scan.is_file() else "the file is missing"
            if isinstance(points, str):
                yield Unusable("scan", scan.name, points)
            else:
                yield RecordedScan(scan.name, float(stamp_s), points_from_carla(points))
            if pictures and self.recording.camera is not None:
                yield self._picture(name, float(stamp_s), self.recording.camera)

    def _picture(self, name: str, stamp_s: float, camera: CarlaCamera) -> RecordedPicture | Unusable:
        rgb_path, depth_path = (self.path / kind / f"{name}.png" for kind in ("rgb", "depth"))
        try:
            rgb = read_rgb(rgb_path)
            data = depth_path.read_bytes()
            header = header_of(data, "PNG", field="depth")
            require_pixels(header.height, header.width, _LIMITS, field="depth")
        except (StreetfixError, OSError) as error:
            return Unusable("image", rgb_path.name, f"cannot be read: {type(error).__name__}")
        bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        if bgr is None:
            return Unusable("image", rgb_path.name, "its depth cannot be decoded")
        T = optical(camera.mounting.T_vehicle_sensor())
        depth = depth_from_carla(np.asarray(bgr, np.uint8))
        return RecordedPicture(rgb_path.name, stamp_s, rgb, camera.pinhole(), T, depth=depth, file=rgb_path)


def open_carla(source: Path) -> CarlaFolder:
    """Open a recording.

    Args:
        source: folder of the recording.

    Raises:
        DatasetError: ``recording.json`` or ``poses.csv`` is missing or broken.
    """
    file = source / "recording.json"
    try:
        recording = CarlaRecording.model_validate_json(file.read_bytes())
    except OSError as error:
        raise DatasetError(
            f"{file} cannot be read ({error}); it gives the mounting of the sensors, see docs/recordings.md",
            field=file.name,
        ) from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise DatasetError(
            f"{file}: {where}: {first['msg']}; correct this field, see docs/recordings.md", field=where
        ) from error
    names, stamps, poses = _poses(source / "poses.csv")
    return CarlaFolder(source, recording, names, Trajectory(stamps, poses, str(source / "poses.csv")))


def write_recording(out: Path, recording: CarlaRecording) -> None:
    """Write ``recording.json``.

    Args:
        out: folder of the recording.
        recording: mountings and camera.
    """
    (out / "recording.json").write_text(json.dumps(recording.model_dump(mode="json"), indent=1) + "\n")


#: Columns of ``poses.csv``: seconds, metres and degrees, in CARLA's convention.
POSE_COLUMNS = ("frame", "timestamp", "x", "y", "z", "roll", "pitch", "yaw")


def _poses(path: Path) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    if not path.is_file():
        raise DatasetError(
            f"{path} is missing; it has one line per frame: {', '.join(POSE_COLUMNS)} of the vehicle", field=path.name
        )
    names, stamps, poses = [], [], []
    with path.open(newline="", errors="replace") as file:
        for number, row in enumerate(csv.DictReader(file), 2):
            try:
                values = [float(row[column]) for column in POSE_COLUMNS[1:]]
            except (KeyError, TypeError, ValueError) as error:
                raise DatasetError(
                    f"{path}, line {number}: not numbers in the columns {', '.join(POSE_COLUMNS)}; the first line of the file "
                    "names the columns, and each further line has one number per column",
                    field=path.name,
                ) from error
            if not (row["frame"] or "").isdigit() or not np.isfinite(values).all():
                raise DatasetError(
                    f"{path}, line {number}: the frame {(row['frame'] or '')[:20]!r} is not an integer, or a value is not finite; "
                    "correct or remove this line",
                    field=path.name,
                )
            names.append(row["frame"])
            stamps.append(values[0])
            poses.append(T_from_carla(*values[1:]))
    return tuple(names), np.array(stamps), np.array(poses).reshape(-1, 4, 4)
