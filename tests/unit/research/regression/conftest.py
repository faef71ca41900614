"""A hall with walls, ground and roof, and image pairs taken in it."""

from collections.abc import Callable

import numpy as np
import pytest

from research.baselines.paper_data.pairs import SIDE, Pairs
from research.baselines.regression.map_cloud import MapCloud
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from, transform_points

CAMERA = PinholeCamera(SIDE, SIDE, 112.0, 112.0, 111.5, 111.5)
LOW, HIGH = np.array([0.0, 0.0, 0.0]), np.array([60.0, 24.0, 9.0])
PILLARS = np.array([[14.0, 6.0], [23.0, 19.0], [35.0, 4.0], [46.0, 15.0]])
PILLAR_RADIUS_M = 1.5


def depth_in_hall(T_map_camera):
    """Return Z (224, 224) of walls, ground, roof and pillars."""
    rays_camera = CAMERA.rays_of_pixels().reshape(-1, 3)
    rays, origin = rays_camera @ T_map_camera[:3, :3].T, T_map_camera[:3, 3]
    with np.errstate(divide="ignore"):
        nearest = np.where(rays > 0, (HIGH - origin) / rays, (LOW - origin) / rays).min(axis=1)
    for pillar in PILLARS:
        a, b = (rays[:, :2] ** 2).sum(axis=1), rays[:, :2] @ (origin[:2] - pillar)
        root = b**2 - a * (((origin[:2] - pillar) ** 2).sum() - PILLAR_RADIUS_M**2)
        hit = (-b - np.sqrt(np.maximum(root, 0))) / a
        nearest = np.where((root > 0) & (hit > 0), np.minimum(nearest, hit), nearest)
    return nearest.reshape(SIDE, SIDE)


def camera_at(x, y, heading_rad):
    return transform_from(rotation_z(heading_rad) @ R_BODY_OPTICAL, np.array([x, y, 1.6]))


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """Two threads that wait for each other are many times slower on a busy machine."""
    from research.baselines.learning import one_thread

    with one_thread():
        yield


@pytest.fixture(scope="session")
def pairs_in_hall() -> Callable[..., Pairs]:
    """Return pairs spread over the hall. Colours encode the position."""

    def made(count: int = 12, *, seed: int = 0) -> Pairs:
        rng = np.random.default_rng(seed)
        x, y = np.linspace(5, 55, count), rng.uniform(9, 13, count)
        T = np.stack([camera_at(*each) for each in zip(x, y, rng.uniform(-3, 3, count), strict=True)])
        depth_mm = np.stack([np.rint(depth_in_hall(each) * 1000).clip(0, 65535) for each in T]).astype(np.uint16)
        rgb = rng.integers(0, 60, (count, SIDE, SIDE, 3)).astype(np.uint8)
        rgb += np.linspace(0, 190, count).astype(np.uint8)[:, None, None, None]
        none = np.zeros((count, 1, 1), np.float16)
        views = np.zeros((count, 4))
        return Pairs(
            rgb, depth_mm, none, np.zeros((count, 1, 1, 3), np.uint8), views, T, np.zeros(count, np.int64), CAMERA
        )

    return made


@pytest.fixture(scope="session")
def hall(pairs_in_hall) -> MapCloud:
    """Return the surfaces of the hall as points 0.3 m apart."""
    T = [camera_at(x, y, heading) for x in range(6, 60, 12) for y in (8.0, 16.0) for heading in np.arange(0, 6, 1.5)]
    seen = []
    for each in T:
        points = CAMERA.rays_of_pixels()[::2, ::2] * depth_in_hall(each)[::2, ::2, None]
        seen.append(transform_points(each, points.reshape(-1, 3)))
    points = np.concatenate(seen)
    _, first = np.unique(np.floor(points / 0.3).astype(int), axis=0, return_index=True)
    return MapCloud(points[np.sort(first)])
