"""A street of flat rectangles: its surfels, and its view from a known pose."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from model_training.mapping.voxel_map import VoxelMap
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from
from service.registration.kernel import STATE, SURFEL, QueryPoints, SolverOptions, align
from service.registration.register import Registered
from service.registration.surfel_map import SurfelMap
from service.scoring.candidates import Candidate

Floats = NDArray[np.float64]


class Scene:
    """Rectangles, each with a corner and two perpendicular edges (metres, map frame)."""

    def __init__(self, *rectangles: tuple[Any, Any, Any]) -> None:
        self.corners, self.a, self.b = (np.array(each, np.float64) for each in zip(*rectangles, strict=True))
        normals = np.cross(self.a, self.b)
        self.normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def surfels(self, step_m: float = 0.3) -> NDArray[Any]:
        """Return one surfel every ``step_m``, exactly on its rectangle."""
        found = []
        for corner, a, b, normal in zip(self.corners, self.a, self.b, self.normals, strict=True):
            shares = [(np.arange(n) + 0.5) / n for n in (max(1, round(np.linalg.norm(e) / step_m)) for e in (a, b))]
            i, j = (each.ravel() for each in np.meshgrid(*shares))
            rows = np.zeros(len(i), SURFEL)
            rows["xyz"] = corner + np.outer(i, a) + np.outer(j, b)
            rows["normal"], rows["thickness_m"], rows["points"] = normal, 0.01, 5
            found.append(rows)
        return np.concatenate(found)

    def survey(self, *, noise_m: float = 0.01, per_m2: float = 150.0, origin: Any = (0.0, 0.0, 0.0)) -> SurfelMap:
        """Return the cloud that a map build makes from measured points."""
        rng = np.random.default_rng(11)
        voxels = VoxelMap(0.3, np.array(origin, np.float64))
        for corner, a, b in zip(self.corners, self.a, self.b, strict=True):
            shares = rng.uniform(0, 1, (int(per_m2 * np.linalg.norm(a) * np.linalg.norm(b)), 2))
            points = corner + shares[:, :1] * a + shares[:, 1:] * b
            voxels.add(points + rng.normal(0, noise_m, points.shape))
        return SurfelMap.prepare(voxels.origin, *voxels.surfels())

    def ranges(self, origin_m: Floats, directions: Floats) -> Floats:
        """Return the distance along each direction to the first rectangle; infinite without an intersection."""
        found = np.full(len(directions), np.inf)
        for corner, a, b, normal in zip(self.corners, self.a, self.b, self.normals, strict=True):
            toward = directions @ normal
            with np.errstate(divide="ignore", invalid="ignore"):
                ahead = ((corner - origin_m) @ normal) / toward
                local = origin_m + ahead[:, None] * directions - corner
                i, j = local @ a / (a @ a), local @ b / (b @ b)
                met = (ahead > 0.05) & (i >= 0) & (i <= 1) & (j >= 0) & (j <= 1)
            found = np.where(met & (ahead < found), ahead, found)
        return found

    def depth(self, camera: PinholeCamera, T_map_camera: Floats) -> NDArray[np.float32]:
        """Return the depth image of an exact depth camera; 0 without an intersection."""
        rays = camera.rays_of_pixels().reshape(-1, 3) @ T_map_camera[:3, :3].T
        z = self.ranges(T_map_camera[:3, 3], rays).reshape(camera.height, camera.width)
        return np.where(np.isfinite(z), z, 0).astype(np.float32)

    def points(self, R_map_level: Floats, camera_m: Floats, *, focal_baseline_px_m: float = 80.0) -> QueryPoints:
        """Return exact points of a fan of 110 x 40 degrees."""
        azimuth, elevation = np.meshgrid(np.deg2rad(np.linspace(-55, 55, 45)), np.deg2rad(np.linspace(-25, 15, 27)))
        fan = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        rays = np.stack(fan, axis=-1).reshape(-1, 3)
        distance = self.ranges(camera_m, rays @ R_map_level.T)
        met = np.isfinite(distance)
        return query_points(rays[met] * distance[met, None], focal_baseline_px_m=focal_baseline_px_m)


def query_points(xyz: Any, *, sigma: Any = 0.02, weight: Any = 1.0, focal_baseline_px_m: float = np.inf) -> QueryPoints:
    """Return query points in a level frame. Without a baseline the camera has no disparity offset."""
    xyz = np.array(xyz, np.float64).reshape(-1, 3)
    f, n = np.float32, len(xyz)
    return QueryPoints(
        xyz.astype(f),
        (xyz / np.linalg.norm(xyz, axis=1, keepdims=True)).astype(f),
        np.full(n, sigma, f),
        np.broadcast_to(np.asarray(weight, f), n).copy(),
        (xyz[:, 0] / focal_baseline_px_m).astype(f),
    )


def states_at(
    R: Floats, t: Any, *, log_scale: float = 0.0, offset: float = 0.0, anchor: Any = None, up: Any = None
) -> Any:
    """Return one start, with its priors at its own pose by default."""
    states = np.zeros(1, STATE)
    states["R"], states["t"], states["log_scale"], states["offset"] = R, t, log_scale, offset
    states["anchor"] = t if anchor is None else anchor
    states["up"] = np.array([0.0, 0.0, 1.0]) if up is None else up
    return states


COARSE = {"iterations": 12, "reach": 1.2, "robust_first": 0.8, "robust_last": 0.3, "surface": 0.1}
FINE = {"iterations": 20, "reach": 1.2, "robust_first": 0.6, "robust_last": 0.06}


def settled(cloud: SurfelMap, points: QueryPoints, states: Any, **changed: Any) -> Any:
    """Run a coarse and an exact solver. The given starts stay unchanged."""
    states = states.copy()
    align(cloud.pieces, points, states, SolverOptions(**(COARSE | changed)))
    align(cloud.pieces, points, states, SolverOptions(**(FINE | changed)))
    return states


def box(low: Any, high: Any) -> list[tuple[Any, Any, Any]]:
    """Return the four sides and the top of a box."""
    (x0, y0, z0), (x, y, z) = low, np.array(high) - low
    return [
        ((x0, y0, z0), (x, 0, 0), (0, 0, z)),
        ((x0, y0 + y, z0), (x, 0, 0), (0, 0, z)),
        ((x0, y0, z0), (0, y, 0), (0, 0, z)),
        ((x0 + x, y0, z0), (0, y, 0), (0, 0, z)),
        ((x0, y0, z0 + z), (x, 0, 0), (0, y, 0)),
    ]


def street_at(x0: float, y0: float) -> list[tuple[Any, Any, Any]]:
    """Return ground, two facades, the end of the street, a lorry on the left and a pillar on the right; 30 x 12 m."""
    return [
        ((x0, y0 - 6, 0), (30, 0, 0), (0, 12, 0)),
        ((x0, y0 - 6, 0), (30, 0, 0), (0, 0, 5)),
        ((x0, y0 + 6, 0), (30, 0, 0), (0, 0, 5)),
        ((x0 + 30, y0 - 6, 0), (0, 12, 0), (0, 0, 5)),
        *box((x0 + 14, y0 + 3, 0), (x0 + 19, y0 + 5, 3)),
        *box((x0 + 11, y0 - 4, 0), (x0 + 11.6, y0 - 3.4, 4)),
    ]


@pytest.fixture(scope="session")
def street() -> Scene:
    return Scene(*street_at(-6.0, 0.0))


@pytest.fixture(scope="session")
def street_map(street: Scene) -> SurfelMap:
    """Return surfels exactly on the rectangles of the street."""
    surfels = street.surfels()
    return SurfelMap.prepare(np.zeros(3), surfels)


@pytest.fixture(scope="session")
def pose() -> tuple[Floats, Floats]:
    """Return the true pose: R_map_level and camera position, 1.5 m above the ground."""
    return rotation_z(np.deg2rad(8.0)), np.array([0.7, -0.4, 1.5])


@pytest.fixture(scope="session")
def seen(street: Scene, pose: tuple[Floats, Floats]) -> QueryPoints:
    return street.points(*pose)


@pytest.fixture(scope="session")
def scene_of() -> type[Scene]:
    return Scene


@pytest.fixture(scope="session")
def streets_at() -> Callable[..., list[tuple[Any, Any, Any]]]:
    return street_at


@pytest.fixture(scope="session")
def points_at() -> Callable[..., QueryPoints]:
    return query_points


@pytest.fixture(scope="session")
def start_at() -> Callable[..., Any]:
    return states_at


@pytest.fixture(scope="session")
def settle() -> Callable[..., Any]:
    return settled


@pytest.fixture(scope="session")
def candidate():
    """Return a registered candidate with a given support."""

    def made(support=0.0, *, xyz=(0.0, 0.0, 1.5), heading_deg=0.0, scale=1.0):
        R = rotation_z(np.deg2rad(heading_deg))
        registered = Registered(R, np.array(xyz, np.float64), scale, 0.0, 0.7, np.eye(8), 0)
        T_map_camera = transform_from(R @ R_BODY_OPTICAL, np.array(xyz, np.float64))
        scores = {"similarity": 0.8, "place_m": 1.5, "likelihood": -1.5, "through": 0.02, "front": 0.2, "unmapped": 0.1}
        scores |= {"structure": 12.0, "shared_edges": 0.3, "upper_inliers": 0.7, "contrast": 0.2}
        return Candidate(T_map_camera, registered, scores, support)

    return made
