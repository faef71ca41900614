"""Render out-of-map queries that no simulated city has: plain walls at close range, and rooms. Both consist of boxes.

Other out-of-map queries (another city, streets that the map lacks) are as rich in shape as the queries in the map. A flat wall fits many
facades of a city. So the calibration needs walls of its own (decision 0084). The evaluation has other walls and rooms (``benchmarks``).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.depth_noise import DepthModel, measured_depth
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import rotation_x, rotation_z
from service.retrieval.query import Query

#: Distance that counts as infinite, metres.
_FAR = 80.0


@dataclass(frozen=True)
class Box:
    """An upright solid box, in the level frame of the camera: x right, y down, z forward, the camera at the origin.

    Attributes:
        low: corner with the smallest coordinates, metres, in the frame of the camera turned by ``yaw_rad`` about the vertical.
        high: the opposite corner, metres, same frame.
        yaw_rad: turn to the right, radians.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    yaw_rad: float = 0.0

    def entered(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """Intersect rays from the camera with the box (slab method); return multiples of the ray (H, W), infinite without intersection.

        Args:
            rays: directions of the rays, level frame (H, W, 3).
        """
        sine, cosine = np.sin(self.yaw_rad), np.cos(self.yaw_rad)
        x, z = rays[..., 0] * cosine - rays[..., 2] * sine, rays[..., 0] * sine + rays[..., 2] * cosine
        near, far = np.full(x.shape, -np.inf), np.full(x.shape, np.inf)
        for axis, direction in enumerate((x, rays[..., 1], z)):
            slope = np.where(np.abs(direction) < 1e-9, 1e-9, direction)
            first, second = self.low[axis] / slope, self.high[axis] / slope
            near, far = np.maximum(near, np.minimum(first, second)), np.minimum(far, np.maximum(first, second))
        return np.where((near < far) & (near > 0), near, np.inf)


def wall(rng: np.random.Generator) -> list[Box]:
    """Draw a wall close to the camera, often bare, sometimes with another wall beside it.

    Args:
        rng: random generator.
    """
    distance, yaw = float(rng.uniform(0.7, 12.0)), float(np.deg2rad(rng.uniform(-50, 50)))
    height = _FAR if rng.random() < 0.5 else float(rng.uniform(2.0, 9.0))
    ground = _ground(rng)
    top = ground - height
    boxes = [
        Box((-_FAR, ground, -_FAR), (_FAR, ground + 1, _FAR)),
        Box((-_FAR, top, distance), (_FAR, ground, distance + 1), yaw),
    ]
    if rng.random() < 0.3:
        side = float(rng.uniform(1.0, 8.0))
        low, high = (side, side + 1) if rng.random() < 0.5 else (-side - 1, -side)
        boxes.append(Box((low, top, -_FAR), (high, ground, _FAR), yaw))
    for _ in range(int(rng.integers(0, 6)) if rng.random() < 0.5 else 0):
        left, foot = float(rng.uniform(-6, 6)), ground - float(rng.uniform(0, 2))
        wide, tall, deep = (float(value) for value in rng.uniform((0.2, 0.5, 0.03), (2.0, 3.0, 0.4)))
        boxes.append(Box((left, foot - tall, distance - deep), (left + wide, foot, distance), yaw))
    return boxes


def room(rng: np.random.Generator) -> list[Box]:
    """Draw the inside of a room, a corridor or a hall with objects in it; one wall may be missing.

    Args:
        rng: random generator.
    """
    yaw, ground = float(rng.uniform(-np.pi, np.pi)), _ground(rng)
    ceiling = ground - float(rng.uniform(2.2, 5.0))
    left, back, right, front = (float(value) for value in np.exp(rng.uniform(np.log(0.8), np.log(14.0), 4)))
    sides = [
        ((-left - 1, -_FAR), (-left, _FAR)), ((right, -_FAR), (right + 1, _FAR)),
        ((-_FAR, -back - 1), (_FAR, -back)), ((-_FAR, front), (_FAR, front + 1)),
    ]  # fmt: skip
    if rng.random() < 0.3:
        sides.pop(int(rng.integers(4)))
    boxes = [Box((-_FAR, ground, -_FAR), (_FAR, ground + 1, _FAR)), Box((-_FAR, ceiling - 1, -_FAR), (_FAR, ceiling, _FAR))]  # fmt: skip
    boxes += [Box((low[0], ceiling, low[1]), (high[0], ground, high[1]), yaw) for low, high in sides]
    for _ in range(int(rng.integers(0, 9))):
        x, z = float(rng.uniform(-left, right)), float(rng.uniform(-back, front))
        wide, deep, tall = (float(value) for value in rng.uniform(0.2, (1.6, 1.6, 2.2)))
        if max(abs(x) - wide, abs(z) - deep) > 0.4:  # keep the camera outside of the object
            boxes.append(Box((x, ground - tall, z), (x + wide, ground, z + deep), yaw))
    return boxes


def _ground(rng: np.random.Generator) -> float:
    """Draw the height of the camera above the ground, metres."""
    return float(rng.uniform(0.4, 2.2))


#: Functions that draw a scene, by the name of its kind in the calibration.
KINDS: dict[str, Callable[[np.random.Generator], list[Box]]] = {"wall": wall, "room": room}


def out_of_map_queries(
    kind: str, camera: PinholeCamera, model: DepthModel, count: int, rng: np.random.Generator
) -> Iterator[Query]:
    """Yield out-of-map queries of one kind, with the errors of a depth camera, tilted by a few degrees like a robot's camera.

    Args:
        kind: one of ``KINDS``.
        camera: camera of the RGB and the depth image.
        model: the depth camera.
        count: number of queries.
        rng: random generator.
    """
    for _ in range(count):
        yield _picture(KINDS[kind](rng), camera, model, rng)


def _picture(boxes: list[Box], camera: PinholeCamera, model: DepthModel, rng: np.random.Generator) -> Query:
    pitch, roll = np.deg2rad(rng.normal(0, 2.0, 2))
    rays = camera.rays_of_pixels() @ (rotation_x(pitch) @ rotation_z(roll)).T
    depths = np.stack([box.entered(rays) for box in boxes])
    seen = depths.argmin(axis=0)
    depth = depths.min(axis=0)
    is_hit = depth < _FAR
    bare = rng.random(len(boxes)) < 0.5  # without texture, so stereo matching returns wrong depth there
    measured = measured_depth(
        np.where(is_hit, depth, 0).astype(np.float32), bare[seen] & is_hit, model, CONDITIONS["clear"], rng
    )
    colours = rng.uniform(40, 210, (len(boxes), 1)) + rng.normal(0, 15, (len(boxes), 3))
    light = np.where(is_hit[..., None], colours[seen], 235.0) + rng.normal(0, 4, (*seen.shape, 1))
    return Query(rgb=np.clip(light, 0, 255).astype(np.uint8), depth_m=measured, camera=camera)
