"""Triangles with colour and material, built from boxes, cones, blobs and leaves."""

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

_CORNERS = np.array(
    [
        [-0.5, -0.5, 0],
        [0.5, -0.5, 0],
        [0.5, 0.5, 0],
        [-0.5, 0.5, 0],
        [-0.5, -0.5, 1],
        [0.5, -0.5, 1],
        [0.5, 0.5, 1],
        [-0.5, 0.5, 1],
    ]
)
_FACES = np.array(
    [[4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]]
)


class Material(IntEnum):
    """Optical class of a surface. The tables in ``shading`` and ``lidar`` use its order."""

    GROUND = 0  # its colour comes from ``GroundPicture``: asphalt, paving, markings, grass
    MATTE = 1
    BRICK = 2
    GLASS = 3
    FOLIAGE = 4
    METAL = 5


@dataclass
class Mesh:
    """A triangle mesh.

    Attributes:
        triangles: corners (n, 3, 3), map frame, metres.
        albedo: linear albedo (n, 3), 0 to 1.
        material: ``Material`` of each triangle (n,).
    """

    triangles: NDArray[np.float32]
    albedo: NDArray[np.float32]
    material: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.triangles)


@dataclass
class MeshBuilder:
    """Collect the parts of a mesh; ``mesh()`` joins them."""

    _triangles: list[NDArray[np.float32]] = field(default_factory=list)
    _albedo: list[NDArray[np.float32]] = field(default_factory=list)
    _material: list[NDArray[np.uint8]] = field(default_factory=list)
    _boxes: list[tuple[float, ...]] = field(default_factory=list)

    def triangles(self, triangles: Vector, albedo: Vector, material: Material) -> None:
        """Add triangles.

        Args:
            triangles: corners (n, 3, 3), map frame, metres.
            albedo: linear albedo of all triangles (3,), or of each (n, 3).
            material: material of all triangles.
        """
        n = len(triangles)
        self._triangles.append(triangles.astype(np.float32))
        self._albedo.append(np.broadcast_to(albedo, (n, 3)).astype(np.float32))
        self._material.append(np.full(n, int(material), np.uint8))

    def box(
        self, centre: Vector, size: tuple[float, float, float], yaw_rad: float, albedo: Vector, material: Material
    ) -> None:
        """Add a box that stands on z = ``centre[2]``. It has no bottom face.

        Args:
            centre: centre of the bottom (3,), map frame, metres.
            size: length along the heading, width and height, metres.
            yaw_rad: heading, radians, counter-clockwise from x.
            albedo: linear albedo (3,).
            material: material of all faces.
        """
        self._boxes.append((*centre, *size, yaw_rad, *albedo, float(material)))

    def mesh(self) -> Mesh:
        """Return all parts as one mesh."""
        triangles, albedo, material = list(self._triangles), list(self._albedo), list(self._material)
        if self._boxes:
            boxes = np.array(self._boxes)
            corners = _CORNERS[None] * boxes[:, None, 3:6]
            cosine, sine = np.cos(boxes[:, 6])[:, None], np.sin(boxes[:, 6])[:, None]
            x = corners[..., 0] * cosine - corners[..., 1] * sine + boxes[:, None, 0]
            y = corners[..., 0] * sine + corners[..., 1] * cosine + boxes[:, None, 1]
            z = corners[..., 2] + boxes[:, None, 2]
            faces = np.stack([x, y, z], axis=-1)[:, _FACES].reshape(-1, 3, 3)
            triangles.append(faces.astype(np.float32))
            albedo.append(np.repeat(boxes[:, 7:10], len(_FACES), axis=0).astype(np.float32))
            material.append(np.repeat(boxes[:, 10], len(_FACES)).astype(np.uint8))
        if not triangles:
            return Mesh(np.zeros((0, 3, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.uint8))
        return Mesh(np.concatenate(triangles), np.concatenate(albedo), np.concatenate(material))


def joined(meshes: list[Mesh]) -> Mesh:
    """Join several meshes to one.

    Args:
        meshes: at least one mesh, all in the same frame.
    """
    return Mesh(
        np.concatenate([m.triangles for m in meshes]),
        np.concatenate([m.albedo for m in meshes]),
        np.concatenate([m.material for m in meshes]),
    )


def cone(base: Vector, radius_m: float, height_m: float, sides: int = 8) -> Vector:
    """Return the triangles (sides, 3, 3) of a cone's side, metres.

    Args:
        base: centre of the base (3,), metres.
        radius_m: radius of the base, metres.
        height_m: height, metres.
        sides: number of triangles.
    """
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    ring = base + radius_m * np.stack([np.cos(angle), np.sin(angle), np.zeros(sides + 1)], axis=1)
    apex = np.broadcast_to(base + [0.0, 0.0, height_m], (sides, 3))
    return np.stack([ring[:-1], ring[1:], apex], axis=1)


def leaves(points: Vector, size_m: float, rng: np.random.Generator) -> Vector:
    """Return one small, randomly oriented triangle per point (n, 3, 3), metres.

    Args:
        points: centres (n, 3), metres.
        size_m: standard deviation of the corners around the point, metres.
        rng: random generator.
    """
    return points[:, None, :] + rng.normal(0, size_m, (len(points), 3, 3))


def blob(centre: Vector, radii: Vector, rng: np.random.Generator) -> Vector:
    """Return a lumpy closed body of 80 triangles (80, 3, 3), metres: an icosphere with displaced vertices.

    Args:
        centre: centre (3,), metres.
        radii: radii along x, y and z (3,), metres.
        rng: random generator.
    """
    lumpy = _ICOSPHERE[0] * radii * rng.uniform(0.75, 1.15, (len(_ICOSPHERE[0]), 1)) + centre
    body: Vector = lumpy[_ICOSPHERE[1]]
    return body


def _icosphere() -> tuple[Vector, NDArray[np.int64]]:
    """Return the vertices (42, 3) and faces (80, 3) of an icosahedron that is subdivided once, on the unit sphere."""
    golden = (1 + 5**0.5) / 2
    vertices = [[-1, golden, 0], [1, golden, 0], [-1, -golden, 0], [1, -golden, 0], [0, -1, golden], [0, 1, golden],
                [0, -1, -golden], [0, 1, -golden], [golden, 0, -1], [golden, 0, 1], [-golden, 0, -1], [-golden, 0, 1]]  # fmt: skip
    faces = [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2], [10, 7, 6], [7, 1, 8],
             [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5], [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1]]  # fmt: skip
    points = [np.array(v, float) / np.linalg.norm(v) for v in vertices]
    middles: dict[tuple[int, int], int] = {}

    def middle(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in middles:
            point = points[a] + points[b]
            points.append(point / np.linalg.norm(point))
            middles[key] = len(points) - 1
        return middles[key]

    split = []
    for a, b, c in faces:
        ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
        split += [[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]
    return np.array(points), np.array(split)


_ICOSPHERE = _icosphere()
