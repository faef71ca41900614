"""Cast the rays of a small image on the map: each surfel is a disc in its own plane.

One request casts rays from several poses that are metres apart. A camera sees a tenth of the regions around these poses. So the
surfels that are visible from anywhere near a pose are collected once and reused.

Speed: the C code takes a twenty-fifth of the time of NumPy to cast the rays (26 November 2026, decision 0148).
"""

import ctypes
from ctypes import POINTER, Structure, byref, c_double, c_int64, c_void_p
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int32
from numpy.typing import NDArray

from service.compiled import load
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Transform
from service.imaging.view_grid import MAX_RANGE_M
from service.registration.kernel import CUBE, PACKED_SURFEL, SURFEL, Piece
from service.registration.surfel_tiles import Cloud, Surfels

LIBRARY = Path(__file__).with_name("_rays.so")
#: Largest distance (m) and rotation (rad) of a pose from the one whose collected surfels it reuses.
NEAR_M, NEAR_RAD = 2.0, 0.1
#: Number of collections to keep, the last used ones. Each takes one or two megabytes, and a request has at most 16 frames.
MOST_COLLECTIONS = 16
#: Margin added to both limits (m, rad), so that rounding loses no surfel.
ROUNDING = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscSettings:
    """Settings of the discs, chosen on validation cities in November 2026.

    Attributes:
        radius_m: radius of a surfel's disc, m.
        same_surface_m: discs up to this depth behind the first one on a ray may be the same surface, m.
        grazing: least cosine between a disc's normal and the line of sight; rays ignore discs seen flatter.
        nearest_m: least depth that counts, m.
        reach_m: largest depth that counts, m.
    """

    radius_m: float = 0.2
    same_surface_m: float = 0.3
    grazing: float = 0.05
    nearest_m: float = 0.5
    reach_m: float = MAX_RANGE_M


#: Work memory for one surfel in the camera's axes: position, normal, index, and the range of pixels that it may cover.
_DISC = np.dtype(
    [
        ("xyz", "<f4", (3,)),
        ("normal", "<f4", (3,)),
        *((name, "<i4") for name in ("number", "left", "right", "top", "bottom")),
    ]
)


class View(Structure):
    """Intrinsics and pose of a small image's camera, as ``rays.c`` takes them."""

    _fields_ = [
        ("R", c_double * 9),
        ("t", c_double * 3),
        *((name, c_double) for name in ("fx", "fy", "cx", "cy")),
        ("width", c_int64),
        ("height", c_int64),
    ]

    @classmethod
    def of(cls, T_map_camera: Transform, camera: PinholeCamera) -> "View":
        """Convert a camera and its pose.

        Args:
            T_map_camera: pose of the camera in the surfels' frame.
            camera: intrinsics of the small image.
        """
        return cls(
            (c_double * 9)(*T_map_camera[:3, :3].ravel()),
            (c_double * 3)(*T_map_camera[:3, 3]),
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            camera.width,
            camera.height,
        )


class _Discs(Structure):
    _fields_ = [(name, c_double) for name in ("radius", "nearest", "reach", "same_surface", "grazing")]


@cache
def _library() -> ctypes.CDLL:
    library = load(
        LIBRARY,
        {"Surfel": SURFEL, "PackedSurfel": PACKED_SURFEL, "Cube": CUBE, "View": View, "Discs": _Discs, "Disc": _DISC},
    )
    library.streetfix_collect.argtypes = [
        c_void_p,
        c_void_p,
        c_int64,
        c_double,
        POINTER(View),
        POINTER(_Discs),
        c_double,
        c_double,
        c_void_p,
        c_void_p,
    ]
    library.streetfix_collect.restype = c_int64
    library.streetfix_intersect.argtypes = [
        c_void_p,
        c_void_p,
        c_int64,
        POINTER(View),
        POINTER(_Discs),
        c_void_p,
        c_void_p,
        c_void_p,
        c_void_p,
    ]
    library.streetfix_intersect.restype = None
    return library


@dataclass(frozen=True, slots=True, eq=False)
class _Collection:
    """Surfels that a camera may see from near a pose, in the map's order, and their indices in the map."""

    T_map_camera: Transform
    camera: PinholeCamera
    surfels: NDArray[Any]
    numbers: Int32[NDArray[np.int32], " n"]

    def covers(self, T_map_camera: Transform, camera: PinholeCamera) -> bool:
        """Whether these surfels include all that the camera sees from a pose."""
        near = np.linalg.norm(T_map_camera[:3, 3] - self.T_map_camera[:3, 3]) <= NEAR_M
        if not near or not _has_rays_within(camera, self.camera):
            return False
        # The trace of a rotation is 1 + 2 cos of its angle.
        cosine = (np.vdot(T_map_camera[:3, :3], self.T_map_camera[:3, :3]) - 1) / 2
        return bool(cosine >= np.cos(NEAR_RAD))


def _has_rays_within(inner: PinholeCamera, outer: PinholeCamera) -> bool:
    """Return whether the rays of all pixels of a camera lie in the image of another camera at the same pose."""
    return bool(
        (0.5 + outer.cx) / outer.fx >= inner.cx / inner.fx
        and (0.5 + outer.cy) / outer.fy >= inner.cy / inner.fy
        and (outer.width - 0.5 - outer.cx) / outer.fx >= (inner.width - 1 - inner.cx) / inner.fx
        and (outer.height - 0.5 - outer.cy) / outer.fy >= (inner.height - 1 - inner.cy) / inner.fy
    )


class SurfelRaycaster:
    """Ray casting for one request; each pose of a camera is computed once.

    Attributes:
        cloud: surfels of the map.
    """

    def __init__(self, cloud: Surfels, settings: DiscSettings) -> None:
        """Prepare ray casting on a map.

        Args:
            cloud: surfels of the map.
            settings: of the discs.
        """
        self.cloud = cloud
        self._settings = settings
        self._discs = _Discs(
            settings.radius_m, settings.nearest_m, settings.reach_m, settings.same_surface_m, settings.grazing
        )
        self._collections: list[_Collection] = []
        self._results: dict[tuple[bytes, PinholeCamera], Int32[NDArray[np.int32], "H W"]] = {}

    def intersect(self, T_map_camera: Transform, camera: PinholeCamera) -> Int32[NDArray[np.int32], "H W"]:
        """Return the index of the surfel that each pixel's ray intersects, -1 for none.

        Args:
            T_map_camera: pose of the camera in the surfels' frame.
            camera: intrinsics of the small image.
        """
        key = T_map_camera.tobytes(), camera
        if key not in self._results:
            self._results[key] = self._cast(T_map_camera, camera)
        return self._results[key]

    def depth(self, T_map_camera: Transform, camera: PinholeCamera) -> Float64[NDArray[np.float64], "H W"]:
        """Return the depth (along the optical axis) at which each pixel's ray meets the plane of its surfel, m; 0 for none.

        Args:
            T_map_camera: pose of the camera in the surfels' frame.
            camera: intrinsics of the small image.
        """
        found = self.intersect(T_map_camera, camera).ravel()
        hit = np.flatnonzero(found >= 0)
        surfels = self.cloud.unpacked(found[hit])
        rays = camera.rays_of_pixels().reshape(-1, 3)[hit] @ T_map_camera[:3, :3].T
        normal = surfels["normal"].astype(np.float64)
        # A ray that meets a disc is not parallel to its plane (``DiscSettings.grazing``).
        distance = ((surfels["xyz"] - T_map_camera[:3, 3]) * normal).sum(axis=1)
        depth_m = np.zeros(found.size)
        depth_m[hit] = np.maximum(distance / (rays * normal).sum(axis=1), 0.0)
        return depth_m.reshape(camera.height, camera.width)

    def _cast(self, T_map_camera: Transform, camera: PinholeCamera) -> Int32[NDArray[np.int32], "H W"]:
        collection = next((each for each in self._collections if each.covers(T_map_camera, camera)), None)
        if collection is None:
            collection = self._collect(T_map_camera, camera)
        others = [each for each in self._collections if each is not collection]
        self._collections = [*others[1 - MOST_COLLECTIONS :], collection]
        discs, surfel_of = np.empty(len(collection.surfels), _DISC), np.empty((camera.height, camera.width), np.int32)
        nearest, centre_distance2 = np.empty((2, camera.height * camera.width), np.float32)
        _library().streetfix_intersect(
            collection.surfels.ctypes.data,
            collection.numbers.ctypes.data,
            len(collection.surfels),
            byref(View.of(T_map_camera, camera)),
            byref(self._discs),
            discs.ctypes.data,
            nearest.ctypes.data,
            centre_distance2.ctypes.data,
            surfel_of.ctypes.data,
        )
        return surfel_of

    def _collect(self, T_map_camera: Transform, camera: PinholeCamera) -> _Collection:
        pieces = self.cloud.pieces
        visible = [self._cubes_in_view(piece, T_map_camera, camera) for piece in pieces]
        room = sum(int(cubes["count"].sum()) for cubes in visible)
        surfels, numbers = np.empty(room, SURFEL), np.empty(room, np.int32)
        count = first = 0
        for piece, cubes in zip(pieces, visible, strict=True):
            found = _library().streetfix_collect(
                piece.surfels.ctypes.data,
                cubes.ctypes.data,
                len(cubes),
                piece.grid.cell_m,
                byref(View.of(T_map_camera, camera)),
                byref(self._discs),
                NEAR_M + ROUNDING,
                NEAR_RAD + ROUNDING,
                surfels[count:].ctypes.data,
                numbers[count:].ctypes.data,
            )
            numbers[count : count + found] += first
            count, first = count + found, first + len(piece.surfels)
        for each in (surfels, numbers):
            each.resize(count, refcheck=False)  # frees the unused memory
        return _Collection(T_map_camera, camera, surfels, numbers)

    def _cubes_in_view(self, piece: Piece, T_map_camera: Transform, camera: PinholeCamera) -> NDArray[Any]:
        """Cubes of a piece's regions that a camera may see from near a pose: (n,) of ``CUBE``.

        Seen from above, the field of view lies in the convex hull of five points. They are the camera and the four corners of the image
        at the largest depth.
        """
        u, v = (np.array([-0.5, side - 0.5]) for side in (camera.width, camera.height))
        x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
        corners = self._settings.reach_m * np.stack([x.ravel(), y.ravel(), np.ones(4)], axis=1) @ T_map_camera[:3, :3].T
        hull = np.vstack([np.zeros(2), corners[:, :2]])
        cubes, edge_m = piece.cubes, piece.grid.region_m
        centres = cubes["corner"][:, :2] + edge_m / 2 - T_map_camera[:2, 3]
        motion_m = NEAR_M + NEAR_RAD * float(np.linalg.norm(corners, axis=1).max())
        half = edge_m / np.sqrt(2) + self._settings.radius_m + motion_m
        visible = np.ones(len(centres), bool)
        for one, other in combinations(range(len(hull)), 2):
            along = hull[other] - hull[one]
            length = np.hypot(*along)
            if length < 1e-6:
                continue
            outward = np.array([along[1], -along[0]]) / length
            sides = (hull - hull[one]) @ outward
            for sign in (1.0, -1.0):
                if (sign * sides <= 1e-6).all():  # an edge of the hull: all points lie on its inner side
                    visible &= sign * ((centres - hull[one]) @ outward) <= half
        return cubes[visible & (cubes["count"] > 0)]


class Raycasters:
    """Ray casting for one request on the cloud of a map: one ``SurfelRaycaster`` for each surfel map of it.

    Args:
        cloud: cloud of the map.
        settings: of the discs.
    """

    def __init__(self, cloud: Cloud, settings: DiscSettings) -> None:
        self._cloud, self._settings = cloud, settings
        self._opened: list[SurfelRaycaster] = []

    @property
    def have_brightness(self) -> bool:
        """Whether all surfels of the map may have a brightness."""
        return self._cloud.has_brightness

    def at(self, position_m: Float64[NDArray[np.float64], "3"]) -> SurfelRaycaster:
        """Return the ray casting on the surfel map at a position.

        Args:
            position_m: position, map frame, m.
        """
        cloud = self._cloud.at(position_m)
        for opened in self._opened:
            if opened.cloud is cloud:
                return opened
        self._opened.append(SurfelRaycaster(cloud, self._settings))
        return self._opened[-1]
