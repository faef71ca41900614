"""From similar views to the poses that registration starts from: distinct in place and heading."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.localization.search import ViewMatches
from service.registration.register import Start


@dataclass(frozen=True, slots=True, kw_only=True)
class StartSettings:
    """How many starts, and how far apart. Ours, November 2026.

    Attributes:
        most: so many at most; the best few of them are refined.
        apart_m: of two starts of one heading.
        apart_rad: of two starts of one place.
    """

    most: int = 8
    apart_m: float = 2.2
    apart_rad: float = float(np.deg2rad(20.0))


def starts_from(
    matches: ViewMatches, *, height_m: float, lidar_height_m: float, settings: StartSettings
) -> tuple[list[Start], Float64[NDArray[np.float64], " n"]]:
    """Level poses of the camera at the most similar views that are distinct, and their similarities.

    Args:
        matches: the best first.
        height_m: of the camera above the ground.
        lidar_height_m: of the places above theirs.
        settings: how many.
    """
    xy, heading = matches.T_map_place[:, :2, 3], matches.heading_rad
    kept: list[int] = []
    for row in range(len(matches)):
        near = np.hypot(*(xy[kept] - xy[row]).T) < settings.apart_m
        alike = np.cos(heading[kept] - heading[row]) > np.cos(settings.apart_rad)
        if not (near & alike).any():
            kept.append(row)
            if len(kept) == settings.most:
                break
    starts = [_start(matches, row, number, height_m - lidar_height_m) for number, row in enumerate(kept)]
    return starts, matches.similarity[kept]


def _start(matches: ViewMatches, row: int, number: int, above_lidar_m: float) -> Start:
    T, heading = matches.T_map_place[row], float(matches.heading_rad[row])
    up = T[:3, 2]
    x = np.array([np.cos(heading), np.sin(heading), 0.0])
    x = x - up * (x @ up)
    x = x / np.linalg.norm(x)
    return Start(np.stack([x, np.cross(up, x), up], axis=1), T[:3, 3] + above_lidar_m * up, number)
