"""What every reader of a recording gives: scans and picture pairs in time order, and where the vehicle was.

A reader converts its format's conventions and no more: frames are REP-103's, times are seconds, depth is z in metres. What
cannot be used is given too, as ``Unusable``, so that good frames are kept and the others are counted.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from jaxtyping import Float32, Float64, UInt8, UInt16
from numpy.typing import NDArray

from model_training.datasets.dataset import LidarSensor
from model_training.importing.trajectory import Trajectory
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Transform

Lens = Literal["pinhole", "fisheye"]
Depth = UInt16[NDArray[np.uint16], "H W"] | Float32[NDArray[np.float32], "H W"]


@dataclass(frozen=True, slots=True)
class RecordedScan:
    """One turn of the LiDAR.

    Attributes:
        name: what the recording calls it, for messages.
        stamp_s: when; the points are in the LiDAR's frame at that moment unless ``offsets_s`` says otherwise.
        points: x y z (m, LiDAR frame) and intensity.
        offsets_s: when each point was measured, against ``stamp_s``; None where the recording does not say.
    """

    name: str
    stamp_s: float
    points: Float32[NDArray[np.float32], "N 4"]
    offsets_s: Float64[NDArray[np.float64], " N"] | None = None


@dataclass(frozen=True, slots=True)
class RecordedPicture:
    """A colour picture with the depth of the same camera at the same moment.

    Attributes:
        name: what the recording calls it.
        stamp_s: when.
        rgb: sRGB, as recorded, before rectification.
        camera: intrinsics and distortion of both.
        depth: whole numbers of ``depth_scale_m`` or metres, z; 0 or NaN where nothing was measured; None where the recording has none.
        depth_scale_m: metres of one step of a depth of whole numbers.
        T_vehicle_camera: takes the optical frame to the vehicle's.
        file: the file that ``rgb`` was read from, to be copied as it is where nothing has to be rectified.
        lens: what ``camera.distortion`` are the coefficients of: OpenCV's pinhole models, or its fisheye's.
        baseline_m: of the stereo rig that the depth was matched from, metres; None where it comes from elsewhere.
    """

    name: str
    stamp_s: float
    rgb: UInt8[NDArray[np.uint8], "H W 3"]
    camera: PinholeCamera
    T_vehicle_camera: Transform
    depth: Depth | None = None
    depth_scale_m: float = 0.001
    file: Path | None = None
    lens: Lens = "pinhole"
    baseline_m: float | None = None


@dataclass(frozen=True, slots=True)
class Unusable:
    """A frame that cannot be used: ``kind`` is ``scan`` or ``picture``; ``why`` says so in words that are the same for all like it."""

    kind: str
    name: str
    why: str


Event = RecordedScan | RecordedPicture | Unusable


@dataclass(frozen=True, slots=True)
class Notes:
    """What a reader found and guessed: printed, and kept in ``dataset.json``."""

    lines: tuple[str, ...] = ()
    source: dict[str, Any] = field(default_factory=dict)


class Recording(Protocol):
    """A recording that was opened: what is in it is known, nothing is read yet."""

    @property
    def kind(self) -> str:
        """Name of the format, as the command line has it."""

    @property
    def lidar(self) -> LidarSensor:
        """The LiDAR; ``T_vehicle_sensor`` is where it stands."""

    @property
    def notes(self) -> Notes:
        """What was found and guessed."""

    @property
    def georeference(self) -> dict[str, Any] | None:
        """Where on the Earth the origin of the given poses lies, or None."""

    def count(self) -> int:
        """Scans and pictures together, for a progress bar."""

    def trajectory(self) -> Trajectory | None:
        """T_map_vehicle over time as the recording gives it, or None where it gives none."""

    def events(self, *, pictures: bool = True) -> Iterator[Event]:
        """Scans, and pictures where wanted, in time order, one at a time."""
