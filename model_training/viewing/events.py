"""What there is to see, whoever draws it. Everything lies in the map frame (metres, z up) but pictures.

``stamp_s`` counts seconds from the start of what is shown; None is there all the time.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points (n, 3), metres from ``origin_m`` (map frame), so that float32 suffices anywhere, with grey levels (n)."""

    topic: str
    stamp_s: float | None
    origin_m: NDArray[np.float64]
    points_m: NDArray[np.float32]
    grey: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Positions (n, 3) that belong together as a line."""

    topic: str
    stamp_s: float | None
    positions_m: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Outlines:
    """Rings on the ground, each closed, (n, 3), with a name each."""

    topic: str
    stamp_s: float | None
    names: tuple[str, ...]
    rings_m: tuple[NDArray[np.float64], ...]


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera where it stood, what it saw: colour as JPEG, depth (H, W), metres, 0 for not measured, and the 2.5D picture as JPEG."""

    topic: str
    stamp_s: float
    T_map_camera: NDArray[np.float64]
    camera: PinholeCamera
    colour_jpeg: bytes
    depth_m: NDArray[np.float32]
    fused_jpeg: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Cameras' poses T_map_camera (n, 4, 4): truth, neighbours, hypotheses, what was registered, what was answered."""

    topic: str
    stamp_s: float
    T_map_camera: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Note:
    """A line of text; ``good`` where nothing is amiss."""

    topic: str
    stamp_s: float
    text: str
    good: bool


Event: TypeAlias = Cloud | Track | Outlines | View | Poses | Note


def millimetres(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """A depth picture as both formats take it: 0 for not measured, nothing beyond 65.5 m."""
    return np.asarray(np.clip(np.rint(1000.0 * np.nan_to_num(depth_m)), 0, 65535), np.uint16)
