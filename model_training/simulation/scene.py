"""Ray casting with Embree. It works in float32: coordinates stay near the city's origin."""

from dataclasses import dataclass

import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from numpy.typing import NDArray

from model_training.simulation.meshes import Mesh

NO_HIT = np.float32(1e30)  # Embree says 1e37


@dataclass(frozen=True)
class Hits:
    """What rays met: distance (m, 0 for nothing), primitive (-1 for nothing), unnormalised normal of the triangle."""

    distance: NDArray[np.float32]
    primitive: NDArray[np.int32]
    normal: NDArray[np.float32]

    def of(self, rays: NDArray[np.bool_] | NDArray[np.int64]) -> "Hits":
        """Hits of some of the rays."""
        return Hits(self.distance[rays], self.primitive[rays], self.normal[rays])


class Scene:
    """A mesh ready for rays."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._scene = rtcore_scene.EmbreeScene()
        TriangleMesh(self._scene, mesh.triangles)

    def distances(self, origin: NDArray[np.float64], directions: NDArray[np.floating]) -> NDArray[np.float32]:
        """Distances (n,) along unit directions (n, 3) from one origin (3,), metres; 0 where nothing is met."""
        rays = np.ascontiguousarray(directions, np.float32)
        starts = np.broadcast_to(origin.astype(np.float32), rays.shape).copy()
        distance = np.asarray(self._scene.run(starts, rays, query="DISTANCE"))
        return np.where(distance < NO_HIT, distance, np.float32(0))

    def hits(self, origin: NDArray[np.float64], directions: NDArray[np.floating]) -> Hits:
        """The same with primitives and normals."""
        rays = np.ascontiguousarray(directions, np.float32)
        starts = np.broadcast_to(origin.astype(np.float32), rays.shape).copy()
        found = self._scene.run(starts, rays, output=True)
        primitive = found["primID"].astype(np.int32)
        distance = np.where(primitive >= 0, found["tfar"], np.float32(0))
        return Hits(distance, primitive, found["Ng"])

    def lit(self, points: NDArray[np.float32], toward: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether points (n, 3) see the light in direction ``toward`` (3,)."""
        rays = np.broadcast_to(toward.astype(np.float32), points.shape).copy()
        blocked = self._scene.run(np.ascontiguousarray(points), rays, query="OCCLUDED")
        free: NDArray[np.bool_] = np.asarray(blocked) < 0
        return free
