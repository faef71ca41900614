"""A synthetic street of distinct places, as panoramas and as camera views. It is not simulated."""

import itertools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from research.baselines.paper_data.frames import Frames
from research.baselines.paper_data.pairs import SIDE, Pairs
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from
from service.imaging.view_grid import ViewGrid

GRID = ViewGrid()
CAMERA = PinholeCamera(640, 480, 320.0, 320.0, 319.5, 239.5).scaled_to(SIDE, SIDE)
LIDAR_HEIGHT_M, CAMERA_HEIGHT_M, WALL_M = 1.8, 1.5, 2.6
STEP_M = 3.0
#: What one reading of the processor's clock adds in these tests, seconds.
READING_S = 0.05


@pytest.fixture(scope="module", autouse=True)
def _counted_clock():
    """Replace the processor clock by a counter, so a budget gives the same number of steps on every machine."""
    readings = itertools.count()
    clock = SimpleNamespace(process_time=lambda: READING_S * next(readings))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("research.baselines.learning.time", clock)
        yield


def walls_of(seed: int) -> np.ndarray:
    """Return the distances of the walls around a place, by azimuth in 36 steps from -pi."""
    return np.random.default_rng([7, seed]).uniform(5, 35, 36)


def ranges_along(walls: np.ndarray, azimuth: Any, elevation: Any, height_m: float) -> np.ndarray:
    """Return the ranges, metres, to the ground or to a wall of 2.6 m, from a given height; 0 above the walls."""
    wall = walls[np.floor((azimuth + np.pi) % (2 * np.pi) / (2 * np.pi) * 36).astype(int).clip(0, 35)]
    z = height_m + wall * np.tan(elevation)
    ground = height_m / np.maximum(-np.sin(elevation), 1e-6)
    return np.where(z < 0, ground, np.where(z <= WALL_M, wall / np.cos(elevation), 0.0)) + np.zeros_like(wall)


def frames_of(count: int) -> Frames:
    azimuth = (np.arange(GRID.around) * (2 * np.pi / GRID.around) - np.pi)[None] + 1e-6
    panoramas = np.stack(
        [ranges_along(walls_of(k), azimuth, GRID.elevations_rad[:, None], LIDAR_HEIGHT_M) for k in range(count)]
    )
    places = np.column_stack(
        [np.arange(count) * STEP_M, np.zeros(count), np.zeros(count), np.full(count, LIDAR_HEIGHT_M)]
    )
    blank = np.zeros((count, 1, 1), np.uint8)
    return Frames(
        aligned=blank,
        plain=blank,
        panoramas=np.where(panoramas > GRID.max_range_m, 0, panoramas).astype(np.float16),
        intensities=np.full(panoramas.shape, 100, np.uint8),
        places=places,
        T_map_lidar=np.tile(np.eye(4), (count, 1, 1)),
        street=np.arange(count, dtype=np.int64) // 5,
    )


def pairs_of(places: list[int], headings_deg: list[float]) -> Pairs:
    rays = CAMERA.rays_of_pixels() @ R_BODY_OPTICAL.T
    flat = np.hypot(rays[..., 0], rays[..., 1])
    depth, views, poses, rgb = [], [], [], []
    for place, heading_deg in zip(places, headings_deg, strict=True):
        heading = np.deg2rad(heading_deg)
        azimuth = np.arctan2(rays[..., 1], rays[..., 0]) + heading
        ranges = ranges_along(walls_of(place), azimuth, np.arctan2(rays[..., 2], flat), CAMERA_HEIGHT_M)
        depth.append(np.rint(1000 * ranges / np.linalg.norm(rays, axis=-1)))
        views.append((place * STEP_M, 0.0, heading, CAMERA_HEIGHT_M))
        poses.append(
            transform_from(rotation_z(heading) @ R_BODY_OPTICAL, np.array([place * STEP_M, 0, CAMERA_HEIGHT_M]))
        )
        rgb.append(np.random.default_rng(place).integers(0, 255, (SIDE, SIDE, 3)))
    count = len(places)
    return Pairs(
        rgb=np.array(rgb, np.uint8),
        depth_mm=np.array(depth).clip(0, 65535).astype(np.uint16),
        ranges=np.zeros((count, 1, 1), np.float16),
        colours=np.zeros((count, 1, 1, 3), np.uint8),
        views=np.array(views),
        T_map_camera=np.array(poses),
        street=np.array(places, np.int64) // 5,
        camera=CAMERA,
    )


@pytest.fixture(scope="session")
def street_frames() -> Callable[[int], Frames]:
    return frames_of


@pytest.fixture(scope="session")
def street_pairs() -> Callable[[list[int], list[float]], Pairs]:
    return pairs_of
