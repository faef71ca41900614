"""Vehicles that occlude a part of a frame: one close to the camera, or one that drives ahead."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model_training.simulation.meshes import Material, MeshBuilder
from model_training.simulation.scene import Hits, Scene

#: Horizontal span of the view grid, 90 degrees. The share that a body covers refers to it.
VIEW_SPAN_RAD = np.pi / 2
#: Mean distance to the vehicle ahead, the amplitude of its variation, and the wavelength of the variation along the way, metres.
AHEAD_M, SWING_M, SWING_EVERY_M = 14.0, 6.0, 250.0


@dataclass(frozen=True)
class Blocker:
    """A vehicle body that occludes a part of a frame.

    Attributes:
        scene: the body alone, ready for ray casting, in the map frame.
    """

    scene: Scene

    @staticmethod
    def before(T_map_camera: NDArray[np.float64], ground_z: float, share: float, rng: np.random.Generator) -> "Blocker":
        """Place a body 3 to 8 m from the camera so that its front face covers the wanted share of the view.

        The whole face lies within the 90 degrees of the view grid.

        Args:
            T_map_camera: camera pose (4, 4), optical frame to map frame, metres.
            ground_z: height of the ground below the camera in the map frame, metres.
            share: covered share of the 90 degrees that the view grid spans.
            rng: random generator of the frame.
        """
        distance, width_rad = rng.uniform(3.0, 8.0), share * VIEW_SPAN_RAD
        azimuth = rng.uniform(-1, 1) * (VIEW_SPAN_RAD - width_rad) / 2
        heading = float(np.arctan2(T_map_camera[1, 2], T_map_camera[0, 2])) + azimuth
        face, depth, height = 2 * distance * np.tan(width_rad / 2), rng.uniform(2.0, 6.0), rng.uniform(2.2, 3.8)
        # The body faces the camera. Otherwise its sides would show beside the face and the share would grow.
        away = np.array([np.cos(heading), np.sin(heading)])
        centre = T_map_camera[:2, 3] + away * (distance + depth / 2)
        colour = np.clip(rng.uniform(0.15, 0.8) + rng.normal(0, 0.12, 3), 0.05, 0.9)
        return _body(np.array([*centre, ground_z]), (depth, face, height), heading, colour)

    @staticmethod
    def driving_ahead(
        place: NDArray[np.float64], heading: float, along_m: float, share: float, rng: np.random.Generator
    ) -> "Blocker | None":
        """Return a vehicle that drives ahead of a traversal on a share of its way; None on the rest of the way.

        Its rear is 8 to 20 m ahead. The distance varies as a sine of the travelled distance.

        Args:
            place: ground point (3,) below the following vehicle, map frame, metres. The vehicle ahead stands at the same height.
            heading: heading of the traversal, radians, counter-clockwise from x.
            along_m: distance travelled since the start of the traversal, metres.
            share: share of the way on which a vehicle drives ahead.
            rng: random generator of the traversal. The same seed at each call gives the same vehicle.
        """
        size = rng.uniform(3.8, 6.5), rng.uniform(1.7, 2.2), rng.uniform(1.4, 2.8)
        colour = np.clip(rng.uniform(0.15, 0.8) + rng.normal(0, 0.12, 3), 0.05, 0.9)
        swing, turn = rng.uniform(0, 2 * np.pi, 2)
        # sin(x) >= cos(pi * share) holds on exactly this share of each period.
        if share <= 0 or np.sin(2 * np.pi * along_m / (3 * SWING_EVERY_M) + turn) < np.cos(np.pi * share):
            return None
        distance_m = AHEAD_M + SWING_M * np.sin(2 * np.pi * along_m / SWING_EVERY_M + swing)
        ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
        return _body(place + ahead * (distance_m + size[0] / 2), size, heading, colour)

    def over(
        self, origin: NDArray[np.float64], rays: NDArray[np.float32], hits: Hits
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32], NDArray[np.float32]]:
        """Find the rays that the body stops before the scene does.

        The body's colour counts sky light only, no sun.

        Args:
            origin: origin of the rays (3,), or one origin per ray (n, 3), map frame, metres.
            rays: unit directions (n, 3), map frame.
            hits: intersections of the same rays with the scene.

        Returns:
            Whether the body stops each ray (n,), the distance to the body (n,) in metres, and its shaded albedo (n, 3). Distance and
            albedo are valid only where the body stops the ray.
        """
        own = self.scene.hits(origin, rays)
        nearer = (own.primitive >= 0) & ((hits.primitive < 0) | (own.distance < hits.distance))
        primitive = np.maximum(own.primitive, 0)
        facing = np.abs(np.einsum("ij,ij->i", own.normal, rays)) / np.maximum(np.linalg.norm(own.normal, axis=1), 1e-9)
        return nearer, own.distance, self.scene.mesh.albedo[primitive] * (0.55 + 0.35 * facing)[:, None]


def _body(
    foot: NDArray[np.float64], size: tuple[float, float, float], heading: float, colour: NDArray[np.float64]
) -> Blocker:
    """Build a body of a length, width and height (m) that stands on dark wheels."""
    length, width, height = size
    builder = MeshBuilder()
    builder.box(foot + [0, 0, 0.45], (length, width, height - 0.45), heading, colour, Material.METAL)
    builder.box(foot, (length, width * 0.9, 0.6), heading, np.full(3, 0.03), Material.MATTE)
    return Blocker(Scene(builder.mesh()))
