"""A folder of scans, one file each, with one TUM file of poses. Many tools can write this."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from model_training.datasets.dataset import LidarSensor, read_tum
from model_training.importing.cloud_file import SUFFIXES, read_cloud
from model_training.importing.recording import Event, Notes, RecordedScan, Unusable
from model_training.importing.trajectory import Trajectory
from service.errors import DatasetError

#: Names of the file of poses beside the scans.
POSES = ("poses.txt", "trajectory.txt")
#: Time between scans without times, seconds.
STEP_S = 0.1


@dataclass(frozen=True, slots=True)
class Clouds:
    """Scans in the LiDAR frame, in the order of their names. The vehicle frame is the LiDAR frame.

    Attributes:
        path: the folder.
        files: the scans.
        stamps_s: time of each scan, seconds: that of its pose, or ``STEP_S`` times its number.
        poses: T_map_lidar, one per scan; None without a file of poses.
        kind: name of the format.
        lidar: the LiDAR.
        georeference: always None.
    """

    path: Path
    files: tuple[Path, ...]
    stamps_s: tuple[float, ...]
    poses: Trajectory | None
    kind: str = "clouds"
    lidar: LidarSensor = field(default_factory=lambda: LidarSensor(name="lidar", T_vehicle_sensor=np.eye(4).tolist()))
    georeference: dict[str, Any] | None = None

    @property
    def notes(self) -> Notes:
        """Number and formats of the scans."""
        kinds = sorted({path.suffix for path in self.files})
        return Notes((f"{len(self.files)} scans ({', '.join(kinds)})",), {"path": self.path.name})

    @property
    def has_images(self) -> bool:
        """Whether the recording has images."""
        return False

    def count(self) -> int:
        """Count the scans."""
        return len(self.files)

    def trajectory(self) -> Trajectory | None:
        """Return T_map_lidar from the file of poses, or None."""
        return self.poses

    def events(self, *, pictures: bool = True) -> Iterator[Event]:
        """Yield the scans, file by file. There are no images.

        Args:
            pictures: has no effect.
        """
        del pictures
        for path, stamp_s in zip(self.files, self.stamps_s, strict=True):
            points = read_cloud(path)
            yield (
                Unusable("scan", path.name, points)
                if isinstance(points, str)
                else RecordedScan(path.name, stamp_s, points)
            )


def open_clouds(source: Path, poses: Path | None = None) -> Clouds:
    """Open a folder of scans.

    Args:
        source: the folder.
        poses: TUM file with one line per scan; by default one of ``POSES`` beside the scans.

    Raises:
        DatasetError: the folder has no scan, or the numbers of poses and scans differ.
    """
    files = tuple(sorted(p for p in source.iterdir() if p.suffix.lower() in SUFFIXES)) if source.is_dir() else ()
    if not files:
        raise DatasetError(f"{source}: no scans found; give a folder of scans ({', '.join(SUFFIXES)})", field="source")
    named = poses or next((source / name for name in POSES if (source / name).is_file()), None)
    if named is None:
        return Clouds(source, files, tuple(k * STEP_S for k in range(len(files))), None)
    stamps, T = read_tum(named)
    if len(stamps) != len(files):
        raise DatasetError(
            f"{named} has {len(stamps)} poses for {len(files)} scans; expected one line per scan, in the order of "
            "their names",
            field="poses",
        )
    return Clouds(source, files, tuple(float(s) for s in stamps), Trajectory(stamps, T, str(named)))
