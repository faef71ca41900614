"""A folder of scans, a file each, with one TUM file of poses: what many tools can write."""

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

#: Files of poses that are looked for beside the scans.
POSES = ("poses.txt", "trajectory.txt")
#: Between scans whose times nobody tells.
STEP_S = 0.1


@dataclass(frozen=True, slots=True)
class Clouds:
    """Scans in the LiDAR's frame, which is the vehicle's, in the order of their names.

    Attributes:
        path: the folder.
        files: the scans.
        stamps_s: of each: that of its pose, or counted.
        poses: T_map_lidar, a line a scan; None where there is no file.
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
        """How many there are."""
        kinds = sorted({path.suffix for path in self.files})
        return Notes((f"{len(self.files)} scans ({', '.join(kinds)})",), {"path": self.path.name})

    def count(self) -> int:
        """Scans."""
        return len(self.files)

    def trajectory(self) -> Trajectory | None:
        """As the file has it."""
        return self.poses

    def events(self, *, pictures: bool = True) -> Iterator[Event]:
        """File by file; there are no pictures."""
        del pictures
        for path, stamp_s in zip(self.files, self.stamps_s, strict=True):
            points = read_cloud(path)
            yield Unusable("scan", path.name, points) if isinstance(points, str) else RecordedScan(path.name, stamp_s, points)  # fmt: skip


def open_clouds(source: Path, poses: Path | None = None) -> Clouds:
    """Open a folder.

    Args:
        source: the folder.
        poses: TUM file, a line a scan; by default one of ``POSES`` beside the scans.

    Raises:
        DatasetError: there is no scan in it, or poses and scans do not go together.
    """
    files = tuple(sorted(p for p in source.iterdir() if p.suffix.lower() in SUFFIXES)) if source.is_dir() else ()
    if not files:
        raise DatasetError(
            f"{source}: a folder of scans is wanted ({', '.join(SUFFIXES)}); here is none", field="source"
        )
    named = poses or next((source / name for name in POSES if (source / name).is_file()), None)
    if named is None:
        return Clouds(source, files, tuple(k * STEP_S for k in range(len(files))), None)
    stamps, T = read_tum(named)
    if len(stamps) != len(files):
        raise DatasetError(
            f"{named} has {len(stamps)} poses for {len(files)} scans; a line a scan is wanted, in the order of their names",
            field="poses",
        )
    return Clouds(source, files, tuple(float(s) for s in stamps), Trajectory(stamps, T, str(named)))
