"""The last stage of registration: the map's surface on each pixel's own ray, residuals in inverse depth.

Looked up where it was measured, a noisy point finds whatever surface happens to be near: by a stereo rig metres off. Where its ray
meets the map does not depend on its noise, and the residual is in the unit that a triangulating camera errs evenly in. What neighbouring
pixels err alike (of block matching, or a car that has moved) is one more unknown for each patch of the picture.
"""

import ctypes
from ctypes import POINTER, Structure, byref, c_double, c_int64, c_void_p
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32
from numpy.typing import NDArray

from service.compiled import load
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Rotation, Transform, transform_from
from service.registration.kernel import SURFEL, UNKNOWNS
from service.registration.points import DepthBlocks
from service.registration.register import Registered
from service.registration.sight import LIBRARY, DiscSettings, Sights, View
from service.registration.surfel_map import SurfelMap

MOST_PATCH = 16  # pixels along its edge; as in ``rays.c``


@dataclass(frozen=True, slots=True, kw_only=True)
class RaySettings(DiscSettings):
    """Ours, November 2026; chosen on watch cities. The depths that count for discs count here.

    Attributes:
        rounds: of looking up what the rays meet, at most, and
        steps: of the solver in each.
        still_m: a round that moves the pose by less, and
        still_rad: turns it by less, is the last.
        surface_m: how far the map's surfaces may be off along a ray.
        robust: standard deviations at which the robust kernel (Geman and McClure) takes three quarters off a pixel's weight.
        patch: pixels of the small picture along the edge of a patch.
        shared: standard deviation of what a patch's pixels err alike, in units of one pixel's noise.
        moved_m: standard deviation of how far what may move stands from where it was mapped; a patch's pixels err alike in that.
        alike: so many pixels tell as much as one; against the priors.
        position_m: standard deviations of the priors about the pose that is adjusted,
        turn_rad: likewise;
        scale: and of the depth's scale, which is 1;
        offset_px: and of a rig's disparity offset, which is 0.
        fewest: pictures of which fewer pixels meet the map adjust nothing.
    """

    rounds: int = 5
    steps: int = 2
    still_m: float = 0.02
    still_rad: float = 1e-3
    surface_m: float = 0.05
    robust: float = 1.5
    patch: int = 6
    shared: float = 1.0
    moved_m: float = 1.0
    alike: float = 8.0
    position_m: float = 1.0
    turn_rad: float = float(np.deg2rad(2.0))
    scale: float = 0.01
    offset_px: float = 0.6
    fewest: int = 300

    def __post_init__(self) -> None:
        """Refuse patches that the kernel has no room for."""
        if not 1 <= self.patch <= MOST_PATCH:
            raise ValueError(f"patch: {self.patch} is not from 1 to {MOST_PATCH}")


@dataclass(frozen=True, slots=True, eq=False)
class RayPicture:
    """A small picture of inverse depths.

    Attributes:
        inverse: 1/m, 0 where nothing was measured.
        camera: of the small picture.
        T_level_camera: of the camera against the reference's level frame.
        noise: standard deviation of an inverse depth, 1/m.
        focal_baseline_px_m: of a stereo rig; None where the depth has no disparity.
        movable: where vehicles and people stand, which may have moved since the survey.
    """

    inverse: Float32[NDArray[np.float32], "H W"]
    camera: PinholeCamera
    T_level_camera: Transform
    noise: float
    focal_baseline_px_m: float | None
    movable: Bool[NDArray[np.bool_], "H W"]


def picture_of(
    blocks: DepthBlocks,
    T_level_camera: Transform,
    *,
    noise: float,
    focal_baseline_px_m: float | None,
    movable: Bool[NDArray[np.bool_], "H W"],
) -> RayPicture:
    """What the rays of a thinned depth picture measured; arguments as in ``RayPicture``."""
    inverse = np.divide(1.0, blocks.z_m, out=np.zeros_like(blocks.z_m), where=blocks.z_m > 0)
    return RayPicture(inverse, blocks.camera, T_level_camera, noise, focal_baseline_px_m, movable)


class _Asked(Structure):
    _fields_ = [("about", c_double * 3), *((name, c_double) for name in (
        "scale", "offset", "unit", "noise", "surface", "robust", "shared", "moved", "nearest",
        "reach", "grazing")), ("patch", c_int64)]  # fmt: skip


@cache
def _library() -> ctypes.CDLL:
    library = load(
        LIBRARY,
        {"Surfel": SURFEL, "View": View, "Asked": _Asked},
        {"UNKNOWNS": UNKNOWNS, "MOST_PIXELS": MOST_PATCH**2},
    )
    library.streetfix_pull.argtypes = [
        c_void_p, POINTER(View), c_void_p, c_void_p, c_void_p, POINTER(_Asked), c_void_p, c_void_p, c_void_p
    ]  # fmt: skip
    library.streetfix_pull.restype = c_int64
    return library


@dataclass(slots=True)
class _State:
    """What is adjusted: pose of the reference's level frame in the surfels' frame, log scale, disparity offset (px)."""

    R: Rotation
    t: Float64[NDArray[np.float64], "3"]
    log_scale: float
    offset: float

    def moved(self, step: Float64[NDArray[np.float64], "8"]) -> "_State":
        return _State(
            _turned_by(step[3:6]) @ self.R, self.t + step[:3], self.log_scale + float(step[6]), self.offset + float(step[7])
        )  # fmt: skip

    def camera_of(self, picture: RayPicture) -> Transform:
        T: Transform = transform_from(self.R, self.t) @ picture.T_level_camera
        return T


@dataclass(frozen=True, slots=True)
class _Pull:
    """Normal equations of all pixels, the scatter of their patches' pulls (where asked for), and how many pixels took part."""

    H: Float64[NDArray[np.float64], "8 8"]
    b: Float64[NDArray[np.float64], "8"]
    scatter: Float64[NDArray[np.float64], "8 8"]
    pixels: int


def met_by(sights: Sights, pictures: list[RayPicture], found: Registered) -> list[Int32[NDArray[np.int32], "H W"]]:
    """What the rays of all pictures meet (``Sights.meet``) from a registered pose; arguments as in ``adjust``."""
    state = _state_of(sights.cloud, found)
    return [sights.meet(state.camera_of(picture), picture.camera) for picture in pictures]


def _state_of(cloud: SurfelMap, found: Registered) -> _State:
    return _State(found.R_map_level, found.camera_m - cloud.origin_m, float(np.log(found.scale)), found.offset)


def adjust(
    sights: Sights, pictures: list[RayPicture], found: Registered, settings: RaySettings
) -> tuple[Registered, Float64[NDArray[np.float64], "8 8"]] | None:
    """Move a registered pose to where the rays of all pictures agree best with the map; None where too little is met.

    Args:
        sights: what the rays meet of the map, by the same settings.
        pictures: the reference's first.
        found: of the reference's level frame.
        settings: of the solver.

    Returns:
        The pose, its ``information`` that of the pixels alone, and the sum over patches of the outer products of their pulls
        (as in ``scatter_of``).
    """
    cloud, state = sights.cloud, _state_of(sights.cloud, found)
    free = np.ones(UNKNOWNS, bool)
    free[7] = pictures[0].focal_baseline_px_m is not None
    sigma = np.r_[np.full(3, settings.position_m), np.full(3, settings.turn_rad), settings.scale, settings.offset_px]
    prior, moved = np.diag(sigma**-2.0), np.zeros(UNKNOWNS)
    moved[6:] = state.log_scale, state.offset  # these priors are about none, the pose's about what was registered
    for _ in range(settings.rounds):
        before = moved
        met = [sights.meet(state.camera_of(picture), picture.camera) for picture in pictures]
        for _ in range(settings.steps):
            pull = _pull(cloud, pictures, met, state, settings)
            if pull.pixels < settings.fewest:
                return None
            told, wanted = pull.H / settings.alike + prior, pull.b / settings.alike - prior @ moved
            step = np.zeros(UNKNOWNS)
            step[free] = np.linalg.solve(told[np.ix_(free, free)], wanted[free])
            state, moved = state.moved(step), moved + step
        went = np.linalg.norm((moved - before)[:6].reshape(2, 3), axis=1)
        if went[0] < settings.still_m and went[1] < settings.still_rad:
            break
    pull = _pull(cloud, pictures, met, state, settings, scattered=True)
    pose = replace(
        found, R_map_level=state.R, camera_m=state.t + cloud.origin_m, scale=float(np.exp(state.log_scale)),
        offset=state.offset, information=pull.H,
    )  # fmt: skip
    return pose, pull.scatter


def _pull(
    cloud: SurfelMap, pictures: list[RayPicture], met: list[Int32[NDArray[np.int32], "H W"]], state: _State, settings: RaySettings, *,
    scattered: bool = False,
) -> _Pull:  # fmt: skip
    H, b, scatter, pixels = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS), np.zeros((UNKNOWNS, UNKNOWNS)), 0
    for picture, surfels in zip(pictures, met, strict=True):
        camera, rig = picture.camera, picture.focal_baseline_px_m
        down, across = (-(-side // settings.patch) for side in (camera.height, camera.width))
        pulls = np.zeros((down, across, UNKNOWNS))
        asked = _Asked(
            (c_double * 3)(*state.t), float(np.exp(state.log_scale)), state.offset, 0.0 if rig is None else 1.0 / rig,
            picture.noise, settings.surface_m, settings.robust, settings.shared * picture.noise, settings.moved_m, settings.nearest_m,
            settings.reach_m, settings.grazing, settings.patch,
        )  # fmt: skip
        view = View.of(state.camera_of(picture), camera)
        pixels += _library().streetfix_pull(
            cloud.surfels.ctypes.data, byref(view), surfels.ctypes.data, picture.inverse.ctypes.data, picture.movable.ctypes.data,
            byref(asked), H.ctypes.data, b.ctypes.data, pulls.ctypes.data,
        )  # fmt: skip
        if scattered:
            scatter += _scattered(pulls)
    return _Pull(H, b, scatter, int(pixels))


def _scattered(pulls: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum of the outer products of what 2 x 2 patches pull together: a car that has moved is as wide."""
    padded = np.pad(pulls, [(0, pulls.shape[0] % 2), (0, pulls.shape[1] % 2), (0, 0)])
    joint = (padded[0::2, 0::2] + padded[1::2, 0::2] + padded[0::2, 1::2] + padded[1::2, 1::2]).reshape(-1, UNKNOWNS)
    told = int((joint != 0).any(axis=1).sum())
    return joint.T @ joint * (told / max(told - UNKNOWNS, 1))


def _turned_by(vector_rad: Float64[NDArray[np.float64], "3"]) -> Rotation:
    """Right-handed rotation about a vector, by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector_rad))
    x, y, z = vector_rad
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # Near zero both quotients by their series: neither loses digits nor divides by nothing.
    small = angle < 1e-4
    first = 1 - angle**2 / 6 if small else np.sin(angle) / angle
    second = 0.5 - angle**2 / 24 if small else (1 - np.cos(angle)) / angle**2
    turned: Rotation = np.eye(3) + first * cross + second * (cross @ cross)
    return turned
