"""Adjust a registered pose along the pixels' rays, with residuals in inverse depth: the last stage of registration.

A noisy point matches any surface near its measured position. With a stereo rig that surface may be metres off. The intersection of
its ray with the map does not depend on its noise. The error of a triangulating camera is uniform in inverse depth. Neighbouring pixels
share errors, because of block matching or a car that has moved. Each patch of the image has one unknown for this correlated error.

Decision 0098 measures the method. docs/how_it_works.md gives the equation ("rays").

Speed: ``rays.c`` takes a twenty-fifth of the time of NumPy to cast the rays, and a sixth for a step of the adjustment (26 November
2026, decision 0148).
"""

import ctypes
from ctypes import POINTER, Structure, byref, c_double, c_int64, c_void_p
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32
from numpy.typing import NDArray

from service.compiled import load
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Rotation, Transform, transform_from
from service.registration.kernel import SURFEL, UNKNOWNS
from service.registration.points import DepthBlocks
from service.registration.register import Registered
from service.registration.surfel_tiles import Surfels
from service.registration.visibility import LIBRARY, DiscSettings, SurfelRaycaster, View

#: Standard deviation of a rig's disparity offset, px. With SGBM the offset was 0.1 to 0.46 px on real frames (feasibility study).
OFFSET_PX = 0.6
#: Largest edge of a patch, px. ``rays.c`` has room for this many pixels squared.
MOST_PATCH = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class RaySettings(DiscSettings):
    """Settings of the adjustment, chosen on validation cities in November 2026 (decision 0098).

    The limits of depth are those of the discs.

    Attributes:
        rounds: largest number of rounds. Each round casts the rays once.
        steps: solver steps per round.
        converged_m: largest movement of a round after which the adjustment ends, m. Both limits must hold.
        converged_rad: largest rotation of a round after which the adjustment ends, rad.
        surface_m: standard deviation of the map's surfaces along a ray, m.
        robust: width of the robust kernel (Geman and McClure), in standard deviations. There a pixel keeps a quarter of its weight.
        patch: edge of a patch, pixels of the small image.
        shared: standard deviation of the error that a patch's pixels share, as a multiple of one pixel's noise.
        moved_m: standard deviation of the distance that an object may have moved since the survey, m. Pixels of a patch share it.
        correlated_pixels: number of correlated pixels that count as one independent measurement. It scales the pixels against the
            priors.
        position_m: standard deviation of the prior of position, m. Its mean is the pose to adjust.
        turn_rad: standard deviation of the prior of rotation, rad. Its mean is the pose to adjust.
        scale: standard deviation of the prior of the log scale of depth. Its mean is 0.
        offset_px: standard deviation of the prior of a stereo rig's disparity offset, px. Its mean is 0.
        fewest: least number of pixels that intersect the map. With fewer the pose is not adjusted.
    """

    rounds: int = 10
    steps: int = 1
    converged_m: float = 0.02
    converged_rad: float = 1e-3
    surface_m: float = 0.05
    robust: float = 1.5
    patch: int = 6
    shared: float = 1.0
    moved_m: float = 1.0
    correlated_pixels: float = 8.0
    position_m: float = 1.0
    turn_rad: float = float(np.deg2rad(2.0))
    scale: float = 0.01
    offset_px: float = OFFSET_PX
    fewest: int = 300

    def __post_init__(self) -> None:
        """Check that the kernel has room for a patch.

        Raises:
            ValueError: ``patch`` is out of range.
        """
        if not 1 <= self.patch <= MOST_PATCH:
            raise ValueError(f"patch: {self.patch} must be 1 to {MOST_PATCH}")


@dataclass(frozen=True, slots=True, eq=False)
class RayPicture:
    """A small image of inverse depths.

    Attributes:
        inverse: inverse depth, 1/m; 0 where nothing was measured.
        camera: intrinsics of the small image.
        T_level_camera: pose of the camera in the reference's level frame.
        noise: standard deviation of an inverse depth, 1/m.
        focal_baseline_px_m: focal length times baseline of a stereo rig, px m; None if the depth has no disparity.
        movable: pixels that may show dynamic objects.
    """

    inverse: Float32[NDArray[np.float32], "H W"]
    camera: PinholeCamera
    T_level_camera: Transform
    noise: float
    focal_baseline_px_m: float | None
    movable: Bool[NDArray[np.bool_], "H W"]

    def thinned(self, each: int) -> "RayPicture":
        """Return the image of every n-th row and column, the first ones included.

        Args:
            each: n.
        """
        camera = self.camera
        thinned = replace(
            camera,
            width=-(-camera.width // each),
            height=-(-camera.height // each),
            fx=camera.fx / each,
            fy=camera.fy / each,
            cx=camera.cx / each,
            cy=camera.cy / each,
        )
        rows = np.s_[::each, ::each]
        return replace(self, inverse=self.inverse[rows].copy(), camera=thinned, movable=self.movable[rows].copy())


def picture_of(
    blocks: DepthBlocks,
    T_level_camera: Transform,
    *,
    noise: float,
    focal_baseline_px_m: float | None,
    movable: Bool[NDArray[np.bool_], "H W"],
) -> RayPicture:
    """Convert the blocks of a depth image to an image of inverse depths.

    Args:
        blocks: of the depth image, as ``blocks_of`` returns them.
        T_level_camera: pose of the camera in the reference's level frame.
        noise: standard deviation of an inverse depth, 1/m.
        focal_baseline_px_m: focal length times baseline of a stereo rig, px m; None if the depth has no disparity.
        movable: blocks that may show dynamic objects, as ``movable_of`` returns them.
    """
    inverse = np.divide(1.0, blocks.z_m, out=np.zeros_like(blocks.z_m), where=blocks.z_m > 0)
    return RayPicture(inverse, blocks.camera, T_level_camera, noise, focal_baseline_px_m, movable)


class _DepthModel(Structure):
    _fields_ = [("centre", c_double * 3), *((name, c_double) for name in (
        "scale", "offset", "per_offset", "noise", "surface", "robust", "shared", "moved", "nearest",
        "reach", "grazing")), ("patch", c_int64)]  # fmt: skip


@cache
def _library() -> ctypes.CDLL:
    library = load(
        LIBRARY,
        {"Surfel": SURFEL, "View": View, "DepthModel": _DepthModel},
        {"UNKNOWNS": UNKNOWNS, "MOST_PIXELS": MOST_PATCH**2},
    )
    library.streetfix_normal_equations.argtypes = [
        c_void_p, POINTER(View), c_void_p, c_void_p, c_void_p, POINTER(_DepthModel), c_void_p, c_void_p, c_void_p, POINTER(c_double)
    ]  # fmt: skip
    library.streetfix_normal_equations.restype = c_int64
    return library


@dataclass(slots=True)
class _State:
    """The unknowns: pose of the reference's level frame in the surfels' frame, log scale, disparity offset (px)."""

    R: Rotation
    t: Float64[NDArray[np.float64], "3"]
    log_scale: float
    offset: float

    def moved(self, step: Float64[NDArray[np.float64], "8"]) -> "_State":
        return _State(
            _rotation_of(step[3:6]) @ self.R,
            self.t + step[:3],
            self.log_scale + float(step[6]),
            self.offset + float(step[7]),
        )

    def camera_of(self, picture: RayPicture) -> Transform:
        T: Transform = transform_from(self.R, self.t) @ picture.T_level_camera
        return T


@dataclass(frozen=True, slots=True)
class _Hits:
    """The surfels that the rays of an image intersect: index of each pixel's surfel, -1 for none, and the surfels (H W,)."""

    indices: Int32[NDArray[np.int32], "H W"]
    surfels: NDArray[Any]

    @classmethod
    def of(cls, raycaster: SurfelRaycaster, state: _State, picture: RayPicture) -> "_Hits":
        indices = raycaster.intersect(state.camera_of(picture), picture.camera)
        return cls(indices, raycaster.cloud.unpacked(np.maximum(indices.ravel(), 0)))


@dataclass(frozen=True, slots=True)
class _NormalEquations:
    """Normal equations of all pixels, scatter of the patches' gradients (0 if not requested), number of pixels used, and error."""

    H: Float64[NDArray[np.float64], "8 8"]
    b: Float64[NDArray[np.float64], "8"]
    scatter: Float64[NDArray[np.float64], "8 8"]
    pixels: int
    error: float


def cast_rays(
    raycaster: SurfelRaycaster, pictures: list[RayPicture], found: Registered
) -> list[Int32[NDArray[np.int32], "H W"]]:
    """Cast the rays of all images from a registered pose (``SurfelRaycaster.intersect``).

    Args:
        raycaster: ray casting on the map.
        pictures: images of the query, the reference's first.
        found: registered pose of the reference's level frame, map frame.

    Returns:
        For each image the index of the surfel in each pixel, -1 for none.
    """
    state = _state_of(raycaster.cloud, found)
    return [raycaster.intersect(state.camera_of(picture), picture.camera) for picture in pictures]


def _state_of(cloud: Surfels, found: Registered) -> _State:
    return _State(found.R_map_level, found.camera_m - cloud.origin_m, float(np.log(found.scale)), found.offset)


def adjust(
    raycaster: SurfelRaycaster, pictures: list[RayPicture], found: Registered, settings: RaySettings
) -> tuple[Registered, Float64[NDArray[np.float64], "8 8"]] | None:
    """Adjust a registered pose so that the measured inverse depths of all images agree best with the map along their rays.

    Args:
        raycaster: ray casting on the map, with the same settings.
        pictures: images of the query, the reference's first.
        found: registered pose of the reference's level frame, map frame.
        settings: of the adjustment.

    Returns:
        The adjusted pose and the scatter of the patches' gradients, as in ``score_outer_product``.
        The pose's ``information`` excludes the priors.
        None if fewer than ``settings.fewest`` pixels intersect the map.
    """
    end = _minimised(raycaster, pictures, found, settings)
    if end is None:
        return None
    equations = _normal_equations(pictures, end.hits, end.state, settings, with_scatter=True)
    pose = replace(
        found,
        R_map_level=end.state.R,
        camera_m=end.state.t + raycaster.cloud.origin_m,
        scale=float(np.exp(end.state.log_scale)),
        offset=end.state.offset,
        information=equations.H,
        converged=end.converged,
        iterations=end.iterations,
        error=equations.error,
    )
    return pose, equations.scatter


def adjusted_pose(
    raycaster: SurfelRaycaster, pictures: list[RayPicture], found: Registered, settings: RaySettings
) -> Transform | None:
    """Return the pose T_map_level of ``adjust`` alone, without information and scatter; None if too few pixels intersect the map.

    Args:
        raycaster: ray casting on the map, with the same settings.
        pictures: images of the query, the reference's first.
        found: registered pose of the reference's level frame, map frame.
        settings: of the adjustment.
    """
    end = _minimised(raycaster, pictures, found, settings)
    return None if end is None else transform_from(end.state.R, end.state.t + raycaster.cloud.origin_m)


@dataclass(frozen=True, slots=True)
class _Minimum:
    """End of the minimisation: the unknowns, the surfels of the last round for each image, whether it converged, and its steps."""

    state: _State
    hits: list[_Hits]
    converged: bool
    iterations: int


def _minimised(
    raycaster: SurfelRaycaster, pictures: list[RayPicture], found: Registered, settings: RaySettings
) -> _Minimum | None:
    """Minimise the differences of inverse depths (Gauss and Newton); None if too few pixels intersect the map."""
    state = _state_of(raycaster.cloud, found)
    free = np.ones(UNKNOWNS, bool)
    free[7] = pictures[0].focal_baseline_px_m is not None
    sigma = np.r_[np.full(3, settings.position_m), np.full(3, settings.turn_rad), settings.scale, settings.offset_px]
    prior, moved = np.diag(sigma**-2.0), np.zeros(UNKNOWNS)
    moved[6:] = state.log_scale, state.offset  # priors of scale and offset: mean 0; of the pose: the start
    converged, iterations, hits = False, 0, list[_Hits]()
    for _ in range(settings.rounds):
        before = moved
        hits = [_Hits.of(raycaster, state, picture) for picture in pictures]
        for _ in range(settings.steps):
            equations = _normal_equations(pictures, hits, state, settings)
            if equations.pixels < settings.fewest:
                return None
            H = equations.H / settings.correlated_pixels + prior
            b = equations.b / settings.correlated_pixels - prior @ moved
            step = np.zeros(UNKNOWNS)
            step[free] = np.linalg.solve(H[np.ix_(free, free)], b[free])
            state, moved, iterations = state.moved(step), moved + step, iterations + 1
        change = np.linalg.norm((moved - before)[:6].reshape(2, 3), axis=1)
        if converged := bool(change[0] < settings.converged_m and change[1] < settings.converged_rad):
            break
    return _Minimum(state, hits, converged, iterations)


def _normal_equations(
    pictures: list[RayPicture],
    hits: list[_Hits],
    state: _State,
    settings: RaySettings,
    *,
    with_scatter: bool = False,
) -> _NormalEquations:
    H, b, scatter, pixels = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS), np.zeros((UNKNOWNS, UNKNOWNS)), 0
    error = c_double(0.0)
    for picture, hit in zip(pictures, hits, strict=True):
        camera, rig = picture.camera, picture.focal_baseline_px_m
        down, across = (-(-side // settings.patch) for side in (camera.height, camera.width))
        gradients = np.zeros((down, across, UNKNOWNS))
        model = _DepthModel(
            (c_double * 3)(*state.t),
            float(np.exp(state.log_scale)),
            state.offset,
            0.0 if rig is None else 1.0 / rig,
            picture.noise,
            settings.surface_m,
            settings.robust,
            settings.shared * picture.noise,
            settings.moved_m,
            settings.nearest_m,
            settings.reach_m,
            settings.grazing,
            settings.patch,
        )
        view = View.of(state.camera_of(picture), camera)
        pixels += _library().streetfix_normal_equations(
            hit.surfels.ctypes.data,
            byref(view),
            hit.indices.ctypes.data,
            picture.inverse.ctypes.data,
            picture.movable.ctypes.data,
            byref(model),
            H.ctypes.data,
            b.ctypes.data,
            gradients.ctypes.data,
            byref(error),
        )
        if with_scatter:
            scatter += _score_outer_product(gradients)
    return _NormalEquations(H, b, scatter, int(pixels), error.value)


def _score_outer_product(gradients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum of the outer products of the gradients, joined over 2 x 2 patches because a car that has moved is as wide.

    The factor for few patches is as in ``score_outer_product``.
    """
    padded = np.pad(gradients, [(0, gradients.shape[0] % 2), (0, gradients.shape[1] % 2), (0, 0)])
    joint = (padded[0::2, 0::2] + padded[1::2, 0::2] + padded[0::2, 1::2] + padded[1::2, 1::2]).reshape(-1, UNKNOWNS)
    count = int((joint != 0).any(axis=1).sum())
    return joint.T @ joint * (count / max(count - UNKNOWNS, 1))


def _rotation_of(vector_rad: Float64[NDArray[np.float64], "3"]) -> Rotation:
    """Right-handed rotation about a vector by its length in radians (Rodrigues' formula)."""
    angle = float(np.linalg.norm(vector_rad))
    x, y, z = vector_rad
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # Near 0 the series replace both quotients: they avoid cancellation and a division by 0.
    small = angle < 1e-4
    first = 1 - angle**2 / 6 if small else np.sin(angle) / angle
    second = 0.5 - angle**2 / 24 if small else (1 - np.cos(angle)) / angle**2
    turned: Rotation = np.eye(3) + first * cross + second * (cross @ cross)
    return turned
