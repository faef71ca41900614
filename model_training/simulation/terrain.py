"""The ground: gentle slopes, and an image of its cover."""

from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from model_training.simulation.meshes import Material, MeshBuilder
from model_training.simulation.streets import Street

#: Side of a cell of the ground mesh, metres.
CELL_M = 3.0
#: Side of a pixel of the ground image, metres.
PIXEL_M = 0.125
#: Width of the ground around the city, metres.
MARGIN_M = 90.0


class Cover(IntEnum):
    """Cover of the ground."""

    GRASS = 0
    ASPHALT = 1
    PAVING = 2
    MARKING = 3
    SOIL = 4


@dataclass(frozen=True)
class Terrain:
    """Ground height as a sum of sine waves.

    Attributes:
        waves: one row per wave (n, 4): wave numbers kx and ky (rad/m), phase (rad), amplitude (m).
    """

    waves: NDArray[np.float64]

    @staticmethod
    def random(rng: np.random.Generator) -> "Terrain":
        """Draw three waves of 130 to 320 m. The slope of each is at most 0.022, so the sum stays below 3.8 degrees.

        Args:
            rng: random generator.
        """
        waves = []
        for length, slope in zip(rng.uniform(130, 320, 3), rng.uniform(0.006, 0.022, 3), strict=True):
            k = 2 * np.pi / length
            angle = rng.uniform(0, 2 * np.pi)
            waves.append([k * np.cos(angle), k * np.sin(angle), rng.uniform(0, 2 * np.pi), slope / k])
        return Terrain(np.array(waves))

    def height(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height (...) at points, metres.

        Args:
            xy: positions (..., 2), for example (n, 2), map frame, metres.
        """
        phase = xy @ self.waves[:, :2].T + self.waves[:, 2]
        total: NDArray[np.float64] = (np.sin(phase) * self.waves[:, 3]).sum(axis=-1)
        return total

    def normal(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the unit normal (3,) at one point, map frame.

        Args:
            xy: position (2,), map frame, metres.
        """
        slope = (np.cos(xy @ self.waves[:, :2].T + self.waves[:, 2]) * self.waves[:, 3]) @ self.waves[:, :2]
        normal = np.array([-slope[0], -slope[1], 1.0])
        unit: NDArray[np.float64] = normal / np.linalg.norm(normal)
        return unit

    def add_to(self, builder: MeshBuilder, half_size_m: tuple[float, float]) -> None:
        """Add the ground as triangles, including a margin around the city.

        Args:
            builder: receives the triangles.
            half_size_m: half the extent of the city in x and y, metres.
        """
        axes = [np.arange(-h - MARGIN_M, h + MARGIN_M + CELL_M, CELL_M) for h in half_size_m]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        points = np.concatenate([grid, self.height(grid)[..., None]], axis=-1)
        a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
        faces = np.concatenate([np.stack([a, b, c], 2).reshape(-1, 3, 3), np.stack([a, c, d], 2).reshape(-1, 3, 3)])
        builder.triangles(faces, np.array([0.3, 0.3, 0.3]), Material.GROUND)


@dataclass(frozen=True)
class GroundPicture:
    """Image of the ground cover. A pixel has a side of ``PIXEL_M``; row 0 is at the smallest y.

    Attributes:
        cover: ``Cover`` of each pixel (rows, columns).
        origin: x and y of the corner of pixel (0, 0), map frame, metres.
    """

    cover: NDArray[np.uint8]
    origin: tuple[float, float]

    @staticmethod
    def of(streets: list[Street], half_size_m: tuple[float, float]) -> "GroundPicture":
        """Draw carriageways, pavements and broken centre lines on grass.

        Args:
            streets: the street network.
            half_size_m: half the extent of the city in x and y, metres.
        """
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
        """Return the ``Cover`` (n,) at points; outside the image, that of the nearest pixel.

        Args:
            xy: positions (n, 2), map frame, metres.
        """
        column = ((xy[:, 0] - self.origin[0]) / PIXEL_M).astype(np.int64).clip(0, self.cover.shape[1] - 1)
        row = ((xy[:, 1] - self.origin[1]) / PIXEL_M).astype(np.int64).clip(0, self.cover.shape[0] - 1)
        found: NDArray[np.uint8] = self.cover[row, column]
        return found
