"""The ground: gentle slopes, and a picture of what covers it."""

from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from model_training.simulation.meshes import Material, MeshBuilder
from model_training.simulation.streets import Street

CELL_M = 3.0
PIXEL_M = 0.125
MARGIN_M = 90.0


class Cover(IntEnum):
    """What the ground is covered with."""

    GRASS = 0
    ASPHALT = 1
    PAVING = 2
    MARKING = 3
    SOIL = 4


@dataclass(frozen=True)
class Terrain:
    """Height as a sum of three waves; slopes stay under about 3.5 degrees."""

    waves: NDArray[np.float64]  # (n, 4): kx, ky (rad/m), phase, amplitude (m)

    @staticmethod
    def random(rng: np.random.Generator) -> "Terrain":
        """Draw waves of 130 to 320 m."""
        waves = []
        for length, slope in zip(rng.uniform(130, 320, 3), rng.uniform(0.006, 0.022, 3), strict=True):
            k = 2 * np.pi / length
            angle = rng.uniform(0, 2 * np.pi)
            waves.append([k * np.cos(angle), k * np.sin(angle), rng.uniform(0, 2 * np.pi), slope / k])
        return Terrain(np.array(waves))

    def height(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height (m) at points (..., 2)."""
        phase = xy @ self.waves[:, :2].T + self.waves[:, 2]
        total: NDArray[np.float64] = (np.sin(phase) * self.waves[:, 3]).sum(axis=-1)
        return total

    def normal(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit normal at one point (2,)."""
        slope = (np.cos(xy @ self.waves[:, :2].T + self.waves[:, 2]) * self.waves[:, 3]) @ self.waves[:, :2]
        normal = np.array([-slope[0], -slope[1], 1.0])
        unit: NDArray[np.float64] = normal / np.linalg.norm(normal)
        return unit

    def add_to(self, builder: MeshBuilder, half_size_m: tuple[float, float]) -> None:
        """The ground as triangles, out to the margin."""
        axes = [np.arange(-h - MARGIN_M, h + MARGIN_M + CELL_M, CELL_M) for h in half_size_m]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        points = np.concatenate([grid, self.height(grid)[..., None]], axis=-1)
        a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
        faces = np.concatenate([np.stack([a, b, c], 2).reshape(-1, 3, 3), np.stack([a, c, d], 2).reshape(-1, 3, 3)])
        builder.triangles(faces, np.array([0.3, 0.3, 0.3]), Material.GROUND)


@dataclass(frozen=True)
class GroundPicture:
    """Cover of the ground, ``PIXEL_M`` a pixel, row 0 at the smallest y."""

    cover: NDArray[np.uint8]
    origin: tuple[float, float]

    @staticmethod
    def of(streets: list[Street], half_size_m: tuple[float, float]) -> "GroundPicture":
        """Draw carriageways, pavements, kerbs' edges and broken centre lines."""
        origin = (-half_size_m[0] - MARGIN_M, -half_size_m[1] - MARGIN_M)
        shape = [round(2 * (h + MARGIN_M) / PIXEL_M) for h in half_size_m]
        cover = np.full((shape[1], shape[0]), int(Cover.GRASS), np.uint8)

        def draw(line: NDArray[np.float64], width_m: float, value: Cover) -> None:
            pixels = np.rint((line - origin) / PIXEL_M * 16).astype(np.int32)
            cv2.polylines(cover, [pixels], False, int(value), max(1, round(width_m / PIXEL_M)), cv2.LINE_8, 4)

        for street in streets:
            for line in street.lines:
                draw(line, 2 * street.half_width_m + 5.6, Cover.PAVING)
        for street in streets:
            for line in street.lines:
                draw(line, 2 * street.half_width_m, Cover.ASPHALT)
        for street in streets:
            for line in street.lines:
                for k in range(2, len(line) - 3, 3):
                    draw(line[k : k + 2], 0.15, Cover.MARKING)
        return GroundPicture(cover, origin)

    def at(self, xy: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Cover at points (n, 2)."""
        column = ((xy[:, 0] - self.origin[0]) / PIXEL_M).astype(np.int64).clip(0, self.cover.shape[1] - 1)
        row = ((xy[:, 1] - self.origin[1]) / PIXEL_M).astype(np.int64).clip(0, self.cover.shape[0] - 1)
        found: NDArray[np.uint8] = self.cover[row, column]
        return found
