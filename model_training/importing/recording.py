"""Common result of all readers: scans and image pairs in order of time, and the vehicle's trajectory.

A reader only converts the conventions of its format. Frames follow REP-103, times are seconds, depth is z in metres.
It also yields unusable frames, as ``Unusable``. So good frames are kept and the others are counted.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float32, Float64, UInt8, UInt16
from numpy.typing import NDArray

from model_training.datasets.dataset import LidarSensor
from model_training.importing.trajectory import Trajectory
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Transform

#: Greatest time between colour and depth of a pair, seconds. One camera gives both nearly the same stamp. TUM's sequences have
#: separate stamps.
PAIR_TOLERANCE_S = 0.02
#: Hint for recorded depth whose origin nobody named.
BASELINE_HINT = (
    "the baseline of the depth is not known: if stereo matching measured the depth, give the distance of its cameras with --baseline-m "
    "METRES{}; `evaluate` and `calibrate` then send it as the robot does"
)
Depth = UInt16[NDArray[np.uint16], "H W"] | Float32[NDArray[np.float32], "H W"]


@dataclass(frozen=True, slots=True)
class RecordedScan:
    """One turn of the LiDAR.

    Attributes:
        name: name in the recording, for messages.
        stamp_s: time, seconds. Points are in the LiDAR frame at this time unless ``offsets_s`` is given.
        points: x y z (m, LiDAR frame) and intensity.
        offsets_s: time of each point relative to ``stamp_s``, seconds; None if the recording does not contain it.
    """

    name: str
    stamp_s: float
    points: Float32[NDArray[np.float32], "N 4"]
    offsets_s: Float64[NDArray[np.float64], " N"] | None = None


@dataclass(frozen=True, slots=True)
class RecordedPicture:
    """A colour image with the depth of the same camera at the same time.

    Attributes:
        name: name in the recording.
        stamp_s: time, seconds.
        rgb: sRGB as recorded, before rectification.
        camera: intrinsics and distortion of colour and depth.
        T_vehicle_camera: mounting of the optical frame (4, 4).
        depth: z, as integers in units of ``depth_scale_m`` or as metres; 0 or NaN where nothing was measured. None if the
            recording has none.
        depth_scale_m: metres per step of an integer depth.
        file: file of ``rgb``. It is copied unchanged if no rectification is needed.
        baseline_m: baseline of the stereo rig that the depth was matched from, metres; None for other depth.
    """

    name: str
    stamp_s: float
    rgb: UInt8[NDArray[np.uint8], "H W 3"]
    camera: PinholeCamera
    T_vehicle_camera: Transform
    depth: Depth | None = None
    depth_scale_m: float = 0.001
    file: Path | None = None
    baseline_m: float | None = None


@dataclass(frozen=True, slots=True)
class Unusable:
    """A frame that cannot be used.

    Attributes:
        kind: such as ``scan`` or ``image``.
        name: of the frame.
        why: the reason; the same text for all frames with that reason.
    """

    kind: str
    name: str
    why: str


Event = RecordedScan | RecordedPicture | Unusable


@dataclass(frozen=True, slots=True)
class Notes:
    """What a reader found and assumed; printed, and kept in ``dataset.json``.

    Attributes:
        lines: for people.
        source: for ``dataset.json``.
        picture_lines: for people who import images.
    """

    lines: tuple[str, ...] = ()
    source: dict[str, Any] = field(default_factory=dict)
    picture_lines: tuple[str, ...] = ()


class Recording(Protocol):
    """An opened recording. Its content is known, but its frames are not read yet."""

    @property
    def kind(self) -> str:
        """Name of the format on the command line."""

    @property
    def lidar(self) -> LidarSensor:
        """The LiDAR; ``T_vehicle_sensor`` is its mounting."""

    @property
    def notes(self) -> Notes:
        """What the reader found and assumed."""

    @property
    def georeference(self) -> dict[str, Any] | None:
        """Georeference of the map frame of the recording's poses, or None."""

    @property
    def has_images(self) -> bool:
        """Whether the recording has images."""

    def count(self) -> int:
        """Count scans and images together, for a progress bar."""

    def trajectory(self) -> Trajectory | None:
        """Return T_map_vehicle over time as the recording gives it, or None."""

    def events(self, *, pictures: bool = True) -> Iterator[Event]:
        """Yield scans, and images if wanted, in order of time, one at a time.

        Args:
            pictures: yield images too.
        """
