"""What the rays of a small picture meet of the map: its surfels as discs, each in its own plane.

A question asks that from several poses that are metres apart, and of the tiles around them a camera sees a tenth. So what can be
seen from anywhere near a pose is gathered once.
"""

import ctypes
from ctypes import POINTER, Structure, byref, c_double, c_int64, c_void_p
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int32
from numpy.typing import NDArray

from service.compiled import load
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Transform
from service.registration.kernel import SURFEL
from service.registration.surfel_map import TILE_M, SurfelMap

LIBRARY = Path(__file__).with_name("_rays.so")
#: Poses that differ by no more than this see what has been gathered at one of them.
NEAR_M, NEAR_RAD = 2.0, 0.1
#: So many gatherings are kept, the last that were asked: a megabyte or two each, and a question has as many frames.
KEPT = 16
#: Gathered is this much more, so that rounding leaves nothing out.
ROUNDING = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscSettings:
    """Ours, November 2026; chosen on watch cities.

    Attributes:
        radius_m: of the disc that a surfel is taken for.
        behind_m: discs so far behind the first one on a ray may be the same surface.
        grazing: cosine; discs seen flatter are not met.
        nearest_m: of depths that count, and
        reach_m: the furthest.
    """

    radius_m: float = 0.2
    behind_m: float = 0.3
    grazing: float = 0.05
    nearest_m: float = 0.5
    reach_m: float = 40.0


#: Room for one surfel in the camera's axes: position, normal, number, the pixels that it may cover.
_DISC = np.dtype(
    [("xyz", "<f4", (3,)), ("normal", "<f4", (3,)), *((name, "<i4") for name in ("number", "left", "right", "top", "bottom"))]
)  # fmt: skip


class View(Structure):
    """A small picture's camera and where it stands, as ``rays.c`` takes them."""

    _fields_ = [("R", c_double * 9), ("t", c_double * 3), *((name, c_double) for name in ("fx", "fy", "cx", "cy")),
                ("width", c_int64), ("height", c_int64)]  # fmt: skip

    @classmethod
    def of(cls, T_map_camera: Transform, camera: PinholeCamera) -> "View":
        """The pose is in the surfels' frame."""
        return cls(
            (c_double * 9)(*T_map_camera[:3, :3].ravel()), (c_double * 3)(*T_map_camera[:3, 3]), camera.fx, camera.fy, camera.cx,
            camera.cy, camera.width, camera.height,
        )  # fmt: skip


class _Discs(Structure):
    _fields_ = [(name, c_double) for name in ("radius", "nearest", "reach", "behind", "grazing")]


@cache
def _library() -> ctypes.CDLL:
    library = load(LIBRARY, {"Surfel": SURFEL, "View": View, "Discs": _Discs, "Disc": _DISC})
    library.streetfix_gather.argtypes = [
        c_void_p, c_void_p, c_int64, POINTER(View), POINTER(_Discs), c_double, c_double, c_void_p, c_void_p
    ]  # fmt: skip
    library.streetfix_gather.restype = c_int64
    library.streetfix_meet.argtypes = [
        c_void_p, c_void_p, c_int64, POINTER(View), POINTER(_Discs), c_void_p, c_void_p, c_void_p, c_void_p
    ]  # fmt: skip
    library.streetfix_meet.restype = None
    return library


@dataclass(frozen=True, slots=True, eq=False)
class _Gathered:
    """Surfels that a camera may see from near a pose, in the map's order, and their numbers in the map."""

    T_map_camera: Transform
    camera: PinholeCamera
    surfels: NDArray[Any]
    numbers: Int32[NDArray[np.int32], " n"]

    def holds(self, T_map_camera: Transform, camera: PinholeCamera) -> bool:
        """Whether all that is seen from there is among them."""
        if camera != self.camera or np.linalg.norm(T_map_camera[:3, 3] - self.T_map_camera[:3, 3]) > NEAR_M:
            return False
        # The trace of a rotation is 1 + 2 cos of its angle.
        cosine = (np.vdot(T_map_camera[:3, :3], self.T_map_camera[:3, :3]) - 1) / 2
        return bool(cosine >= np.cos(NEAR_RAD))


class Sights:
    """What one question's rays meet, from wherever it is asked; each pose is looked up once."""

    def __init__(self, cloud: SurfelMap, settings: DiscSettings) -> None:
        """The map's cloud, and what of it is met."""
        self.cloud = cloud
        self._settings = settings
        self._discs = _Discs(
            settings.radius_m, settings.nearest_m, settings.reach_m, settings.behind_m, settings.grazing
        )
        self._gathered: list[_Gathered] = []
        self._met: dict[tuple[bytes, PinholeCamera], Int32[NDArray[np.int32], "H W"]] = {}

    def meet(self, T_map_camera: Transform, camera: PinholeCamera) -> Int32[NDArray[np.int32], "H W"]:
        """Number of the surfel that each pixel's ray meets, -1 for none.

        Args:
            T_map_camera: in the surfels' frame.
            camera: of a small picture.
        """
        asked = T_map_camera.tobytes(), camera
        if asked not in self._met:
            self._met[asked] = self._look_up(T_map_camera, camera)
        return self._met[asked]

    def _look_up(self, T_map_camera: Transform, camera: PinholeCamera) -> Int32[NDArray[np.int32], "H W"]:
        near = next((each for each in self._gathered if each.holds(T_map_camera, camera)), None)
        if near is None:
            near = self._gather(T_map_camera, camera)
        self._gathered = [each for each in self._gathered if each is not near][1 - KEPT :] + [near]
        seen, met = np.empty(len(near.surfels), _DISC), np.empty((camera.height, camera.width), np.int32)
        first, middle = np.empty((2, camera.height * camera.width), np.float32)
        _library().streetfix_meet(
            near.surfels.ctypes.data, near.numbers.ctypes.data, len(near.surfels), byref(View.of(T_map_camera, camera)),
            byref(self._discs), seen.ctypes.data, first.ctypes.data, middle.ctypes.data, met.ctypes.data,
        )  # fmt: skip
        return met

    def _gather(self, T_map_camera: Transform, camera: PinholeCamera) -> _Gathered:
        parts = self._tiles_in_view(T_map_camera, camera)
        room = int(parts[:, 1].sum())
        surfels, numbers = np.empty(room, SURFEL), np.empty(room, np.int32)
        count = _library().streetfix_gather(
            self.cloud.surfels.ctypes.data, parts.ctypes.data, len(parts), byref(View.of(T_map_camera, camera)),
            byref(self._discs), NEAR_M + ROUNDING, NEAR_RAD + ROUNDING, surfels.ctypes.data, numbers.ctypes.data,
        )  # fmt: skip
        for each in (surfels, numbers):
            each.resize(count, refcheck=False)  # gives back what was not needed
        return _Gathered(T_map_camera, camera, surfels, numbers)

    def _tiles_in_view(self, T_map_camera: Transform, camera: PinholeCamera) -> NDArray[np.int64]:
        """First surfel and count of the tiles that a camera may see from near a pose.

        Seen from above, its field of view lies in the hull of where it stands and of what is furthest in its corners.
        """
        u, v = (np.array([-0.5, side - 0.5]) for side in (camera.width, camera.height))
        x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
        corners = self._settings.reach_m * np.stack([x.ravel(), y.ravel(), np.ones(4)], axis=1) @ T_map_camera[:3, :3].T
        hull = np.vstack([np.zeros(2), corners[:, :2]])
        away = self.cloud.tiles[:, :2] - T_map_camera[:2, 3]
        moved = NEAR_M + NEAR_RAD * float(np.linalg.norm(corners, axis=1).max())
        half = TILE_M / np.sqrt(2) + self._settings.radius_m + moved
        seen = np.ones(len(away), bool)
        for one, other in combinations(range(len(hull)), 2):
            along = hull[other] - hull[one]
            length = np.hypot(*along)
            if length < 1e-6:
                continue
            outward = np.array([along[1], -along[0]]) / length
            sides = (hull - hull[one]) @ outward
            for sign in (1.0, -1.0):
                if (sign * sides <= 1e-6).all():  # all of it lies on the other side of this edge
                    seen &= sign * ((away - hull[one]) @ outward) <= half
        return np.ascontiguousarray(self.cloud.tiles[seen, 2:4].astype(np.int64))
