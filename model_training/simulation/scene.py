"""Ray casting with Embree. Embree computes in float32, so coordinates must stay near the city's origin."""

import os
from dataclasses import dataclass
from functools import cache

import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from numpy.typing import NDArray

from model_training.simulation.meshes import Mesh

#: Distances from this value on mean no intersection; Embree returns 1e37, metres.
NO_HIT = np.float32(1e30)


@dataclass(frozen=True)
class Hits:
    """Intersections of rays with a mesh.

    Attributes:
        distance: distance along each ray (n,), metres; 0 without an intersection.
        primitive: index of the triangle (n,); -1 without an intersection.
        normal: normal of the triangle (n, 3), not normalised.
    """

    distance: NDArray[np.float32]
    primitive: NDArray[np.int32]
    normal: NDArray[np.float32]

    def of(self, rays: NDArray[np.bool_] | NDArray[np.int64]) -> "Hits":
        """Return the intersections of some of the rays.

        Args:
            rays: mask (n,) or indices (k,) of the rays.
        """
        return Hits(self.distance[rays], self.primitive[rays], self.normal[rays])


class Scene:
    """A mesh that is ready for ray casting.

    Args:
        mesh: triangles, map frame.
    """

    def __init__(self, mesh: Mesh) -> None:
        _keep_embree_in_the_calling_thread()
        self.mesh = mesh
        self._scene = rtcore_scene.EmbreeScene()
        TriangleMesh(self._scene, mesh.triangles)

    def distances(self, origin: NDArray[np.float64], directions: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the distance to the first surface along each ray (n,), metres; 0 if there is none.

        Args:
            origin: origin of the rays (3,), or one origin per ray (n, 3), map frame, metres.
            directions: unit directions (n, 3), map frame.
        """
        rays = np.ascontiguousarray(directions, np.float32)
        starts = np.broadcast_to(origin.astype(np.float32), rays.shape).copy()
        distance = np.asarray(self._scene.run(starts, rays, query="DISTANCE"))
        return np.where(distance < NO_HIT, distance, np.float32(0))

    def hits(self, origin: NDArray[np.float64], directions: NDArray[np.floating]) -> Hits:
        """Return the first intersection of each ray, with triangle and normal.

        Args:
            origin: origin of the rays (3,), or one origin per ray (n, 3), map frame, metres.
            directions: unit directions (n, 3), map frame.
        """
        rays = np.ascontiguousarray(directions, np.float32)
        starts = np.broadcast_to(origin.astype(np.float32), rays.shape).copy()
        found = self._scene.run(starts, rays, output=True)
        primitive = found["primID"].astype(np.int32)
        distance = np.where(primitive >= 0, found["tfar"], np.float32(0))
        return Hits(distance, primitive, found["Ng"])

    def lit(self, points: NDArray[np.float32], toward: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether each point (n,) sees the light.

        Args:
            points: positions (n, 3), map frame, metres.
            toward: direction to the light (3,), map frame.
        """
        rays = np.broadcast_to(toward.astype(np.float32), points.shape).copy()
        blocked = self._scene.run(np.ascontiguousarray(points), rays, query="OCCLUDED")
        free: NDArray[np.bool_] = np.asarray(blocked) < 0
        return free


@cache
def _keep_embree_in_the_calling_thread() -> None:
    """Make Embree build all scenes of this process in the calling thread, on systems where a process can choose its processors.

    Workers of the simulator are forked, so that they share the scene. At that moment a thread of Embree's TBB may hold a lock. In the
    worker this thread does not exist, so the lock stays closed, and the worker waits for ever when it builds a scene itself. TBB takes
    the number of its threads once, from the processors that the process may use.
    """
    if not hasattr(os, "sched_setaffinity"):
        return
    process = os.getpid()
    allowed = os.sched_getaffinity(process)
    os.sched_setaffinity(process, {min(allowed)})
    try:
        triangle = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], np.float32)
        scene = rtcore_scene.EmbreeScene()
        TriangleMesh(scene, triangle)
        scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))  # the first ray builds the scene
    finally:
        os.sched_setaffinity(process, allowed)
