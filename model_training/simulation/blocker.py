"""Vehicles that frames are drawn over: one right in front of the camera, or one that drives ahead."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model_training.simulation.meshes import Material, MeshBuilder
from model_training.simulation.scene import Hits, Scene

VIEW_SPAN_RAD = np.pi / 2  # the share is of the view grid's 90 degrees
AHEAD_M, SWING_M, SWING_EVERY_M = 14.0, 6.0, 250.0  # how far ahead a vehicle drives, and how that changes along the way


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
        return _body(np.array([*centre, ground_z]), (depth, face, height), heading, colour)

    @staticmethod
    def driving_ahead(
        place: NDArray[np.float64], heading: float, along_m: float, share: float, rng: np.random.Generator
    ) -> "Blocker | None":
        """A vehicle that drives ahead of a drive for a share of its way; None elsewhere.

        Args:
            place: ground below the drive's vehicle (3,), metres; the other one stands on its level.
            heading: of the drive, radians.
            along_m: of the drive's way, from where it began.
            share: of the way that it is ahead.
            rng: of the drive, so that it is the same vehicle at every place.
        """
        size = rng.uniform(3.8, 6.5), rng.uniform(1.7, 2.2), rng.uniform(1.4, 2.8)
        colour = np.clip(rng.uniform(0.15, 0.8) + rng.normal(0, 0.12, 3), 0.05, 0.9)
        swing, turn = rng.uniform(0, 2 * np.pi, 2)
        # A wave that is above this level for the share of its length
        if share <= 0 or np.sin(2 * np.pi * along_m / (3 * SWING_EVERY_M) + turn) < np.cos(np.pi * share):
            return None
        distance_m = AHEAD_M + SWING_M * np.sin(2 * np.pi * along_m / SWING_EVERY_M + swing)
        ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
        return _body(place + ahead * (distance_m + size[0] / 2), size, heading, colour)

    def over(
        self, origin: NDArray[np.float64], rays: NDArray[np.float32], hits: Hits
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32], NDArray[np.float32]]:
        """Which rays it stops, at what distance (m), and its albedo there, lit from the sky alone: (n), (n), (n, 3)."""
        own = self.scene.hits(origin, rays)
        nearer = (own.primitive >= 0) & ((hits.primitive < 0) | (own.distance < hits.distance))
        primitive = np.maximum(own.primitive, 0)
        facing = np.abs(np.einsum("ij,ij->i", own.normal, rays)) / np.maximum(np.linalg.norm(own.normal, axis=1), 1e-9)
        return nearer, own.distance, self.scene.mesh.albedo[primitive] * (0.55 + 0.35 * facing)[:, None]


def _body(
    foot: NDArray[np.float64], size: tuple[float, float, float], heading: float, colour: NDArray[np.float64]
) -> Blocker:
    """Length, width and height of a body on wheels that show dark below it."""
    length, width, height = size
    builder = MeshBuilder()
    builder.box(foot + [0, 0, 0.45], (length, width, height - 0.45), heading, colour, Material.METAL)
    builder.box(foot, (length, width * 0.9, 0.6), heading, np.full(3, 0.03), Material.MATTE)
    return Blocker(Scene(builder.mesh()))
