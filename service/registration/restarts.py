"""Spread of the ray adjustment over perturbed starts: how far the pose depends on where the adjustment began.

The information of a pose describes the cost at one local minimum. It does not show that another minimum lies next to it, or that the cost
is flat along the street. An adjustment that starts half a metre away ends at another pose there. Adding this spread to the covariance
follows Brossard, Bonnabel and Barrau, A New Approach to 3D ICP Covariance Estimation, IEEE Robotics and Automation Letters 5, 2020.

The adjustments run at half the resolution, because only their differences count. Decision 0179 measures the method.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import Transform, rotation_z
from service.registration.rays import RayPicture, RaySettings, adjusted_pose
from service.registration.register import Registered
from service.registration.visibility import SurfelRaycaster


@dataclass(frozen=True, slots=True, kw_only=True)
class RestartSettings:
    """Settings of the restarts, chosen on calibration cities in November 2026 (decision 0179).

    Attributes:
        offsets_m: offsets of the starts from the pose: along its heading and across it, m.
        each: the adjustment takes every n-th row and column of the images; it divides the edge of a patch.
        rounds: rounds of each adjustment, as in ``RaySettings``.
        steps: solver steps per round.
        position_m: standard deviation of the prior of position, m. It must not hold the adjustment at its start.
        turn_rad: standard deviation of the prior of rotation, rad.
    """

    offsets_m: tuple[tuple[float, float], ...] = ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.35), (0.0, -0.35))
    each: int = 2
    rounds: int = 2
    steps: int = 3
    position_m: float = 10.0
    turn_rad: float = 0.3

    def of(self, rays: RaySettings) -> RaySettings:
        """Return the settings of a restarted adjustment.

        Args:
            rays: settings of the adjustment of the pose.
        """
        return replace(
            rays,
            rounds=self.rounds,
            steps=self.steps,
            patch=max(rays.patch // self.each, 1),
            position_m=self.position_m,
            turn_rad=self.turn_rad,
            fewest=max(rays.fewest // self.each**2, 1),
        )


def difference(T_one: Transform, T_other: Transform) -> Float64[NDArray[np.float64], "6"]:
    """Return the difference of two poses: translation (m), then the rotation (rad) that takes the other to the one, about map axes.

    Args:
        T_one: pose in the map frame.
        T_other: another pose of the same frame.
    """
    turn = cv2.Rodrigues(T_one[:3, :3] @ T_other[:3, :3].T)[0].ravel()
    return np.concatenate([T_one[:3, 3] - T_other[:3, 3], turn])


def spread_of_restarts(
    raycaster: SurfelRaycaster,
    pictures: list[RayPicture],
    found: Registered,
    heading_rad: float,
    rays: RaySettings,
    settings: RestartSettings,
) -> Float64[NDArray[np.float64], "6 6"]:
    """Return the mean outer product of the differences of restarted adjustments from a pose: translation (m), rotation (rad), map axes.

    A restart that leaves the map counts as a difference of its whole offset.

    Args:
        raycaster: ray casting on the map, with the settings ``rays``.
        pictures: images of the query, the reference's first.
        found: adjusted pose of the reference's level frame, map frame.
        heading_rad: heading of the view in the map frame, rad.
        rays: settings of the adjustment of the pose.
        settings: of the restarts.
    """
    small, restarted = [picture.thinned(settings.each) for picture in pictures], settings.of(rays)
    along_across = rotation_z(heading_rad)
    differences = np.zeros((len(settings.offsets_m), 6))
    for row, (along, across) in zip(differences, settings.offsets_m, strict=True):
        start = replace(found, camera_m=found.camera_m + along_across @ [along, across, 0.0])
        end = adjusted_pose(raycaster, small, start, restarted)
        row[:] = difference(start.T_map_level if end is None else end, found.T_map_level)
    spread: Float64[NDArray[np.float64], "6 6"] = differences.T @ differences / len(differences)
    return spread
