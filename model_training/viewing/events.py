"""Visible content, independent of the viewer. All coordinates are in the map frame (metres, z up), except images.

``stamp_s`` counts seconds from the start. None means that the content is always visible.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """A cloud. The local origin keeps float32 sufficient anywhere.

    Attributes:
        topic: name of the content.
        stamp_s: time, seconds; None for always.
        origin_m: origin of the points (3,), map frame.
        points_m: points relative to the origin (n, 3).
        grey: grey levels (n,).
    """

    topic: str
    stamp_s: float | None
    origin_m: NDArray[np.float64]
    points_m: NDArray[np.float32]
    grey: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Positions that form a line.

    Attributes:
        topic: name of the content.
        stamp_s: time, seconds; None for always.
        positions_m: positions (n, 3).
    """

    topic: str
    stamp_s: float | None
    positions_m: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Outlines:
    """Closed rings on the ground.

    Attributes:
        topic: name of the content.
        stamp_s: time, seconds; None for always.
        names: name of each ring.
        rings_m: points of each ring (n, 3).
    """

    topic: str
    stamp_s: float | None
    names: tuple[str, ...]
    rings_m: tuple[NDArray[np.float64], ...]


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera and its images.

    Attributes:
        topic: name of the content.
        stamp_s: time, seconds.
        T_map_camera: pose (4, 4).
        camera: intrinsics.
        colour_jpeg: colour image, JPEG.
        depth_m: depth (H, W), metres, 0 for no measurement.
        fused_jpeg: 2.5D image, JPEG.
    """

    topic: str
    stamp_s: float
    T_map_camera: NDArray[np.float64]
    camera: PinholeCamera
    colour_jpeg: bytes
    depth_m: NDArray[np.float32]
    fused_jpeg: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of cameras: ground truth, neighbours, hypotheses, registered candidates or answers.

    Attributes:
        topic: name of the content.
        stamp_s: time, seconds.
        T_map_camera: poses (n, 4, 4).
    """

    topic: str
    stamp_s: float
    T_map_camera: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Note:
    """A line of text.

    Attributes:
        topic: name of the content.
        stamp_s: time, seconds.
        text: the text.
        good: whether it reports success.
    """

    topic: str
    stamp_s: float
    text: str
    good: bool


Event: TypeAlias = Cloud | Track | Outlines | View | Poses | Note


def millimetres(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Convert a depth image to millimetres (H, W) for both formats: 0 for no measurement, clipped at 65.5 m.

    Args:
        depth_m: depth (H, W), metres.
    """
    return np.asarray(np.clip(np.rint(1000.0 * np.nan_to_num(depth_m)), 0, 65535), np.uint16)
