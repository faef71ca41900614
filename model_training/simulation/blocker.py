"""A lorry or van right in front of the camera, over a wanted share of the view's columns."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model_training.simulation.meshes import Material, MeshBuilder
from model_training.simulation.scene import Hits, Scene

VIEW_SPAN_RAD = np.pi / 2  # the share is of the view grid's 90 degrees


@dataclass(frozen=True)
class Blocker:
    """A vehicle's body as a scene of its own, which frames are drawn over."""

    scene: Scene

    @staticmethod
    def before(T_map_camera: NDArray[np.float64], ground_z: float, share: float, rng: np.random.Generator) -> "Blocker":
        """Stand a body 3 to 8 m away, wholly inside the view's columns, its face as wide as the share wants.

        Args:
            T_map_camera: pose of the camera.
            ground_z: height of the ground there, metres.
            share: of the 90 degrees that the view grid spans.
            rng: of the frame.
        """
        distance, width_rad = rng.uniform(3.0, 8.0), share * VIEW_SPAN_RAD
        azimuth = rng.uniform(-1, 1) * (VIEW_SPAN_RAD - width_rad) / 2
        heading = float(np.arctan2(T_map_camera[1, 2], T_map_camera[0, 2])) + azimuth
        face, depth, height = 2 * distance * np.tan(width_rad / 2), rng.uniform(2.0, 6.0), rng.uniform(2.2, 3.8)
        # The far edges may not show beside the near face, or the share would grow: the body stands head-on.
        away = np.array([np.cos(heading), np.sin(heading)])
        centre = T_map_camera[:2, 3] + away * (distance + depth / 2)
        colour = np.clip(rng.uniform(0.15, 0.8) + rng.normal(0, 0.12, 3), 0.05, 0.9)
        builder = MeshBuilder()
        builder.box(np.array([*centre, ground_z + 0.45]), (depth, face, height - 0.45), heading, colour, Material.METAL)
        builder.box(np.array([*centre, ground_z]), (depth, face * 0.9, 0.6), heading, np.full(3, 0.03), Material.MATTE)
        return Blocker(Scene(builder.mesh()))

    def over(
        self, origin: NDArray[np.float64], rays: NDArray[np.float32], hits: Hits
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32], NDArray[np.float32]]:
        """Which rays it stops, at what distance (m), and its albedo there, lit from the sky alone: (n), (n), (n, 3)."""
        own = self.scene.hits(origin, rays)
        nearer = (own.primitive >= 0) & ((hits.primitive < 0) | (own.distance < hits.distance))
        primitive = np.maximum(own.primitive, 0)
        facing = np.abs(np.einsum("ij,ij->i", own.normal, rays)) / np.maximum(np.linalg.norm(own.normal, axis=1), 1e-9)
        return nearer, own.distance, self.scene.mesh.albedo[primitive] * (0.55 + 0.35 * facing)[:, None]
