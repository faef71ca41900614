"""Scan Context (Kim and Kim, IROS 2018): the surroundings of a sensor in polar bins, without learning.

Each bin of rings x sectors holds the height of its highest point above the ground. Two contexts are compared sector by
sector, by the mean cosine of the columns. The heading is unknown, so all shifts of the sectors are compared. A depth
image fills only a quarter of the sectors, so the mean uses the sectors that the query fills. The publication's mean
over all sectors would mostly measure the camera's narrow view. Its ring key, the filled share of each ring, is just as
uninformative for a quarter of a ring. So there is no search for candidates, and every place is compared at every shift.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from research.baselines.answers import PlaceAnswers
from research.baselines.gallery import answers_of, thinned
from research.baselines.paper_data.frames import Frames
from research.baselines.paper_data.pairs import Pairs
from service.geometry.camera import PinholeCamera
from service.imaging.level import level_camera
from service.imaging.view_grid import ViewGrid

SPACING_M = 1.0
CAMERA_HEIGHT_M = 1.5  # usual height, for levelling
Report = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class ContextSettings:
    """Bins and their content.

    The settings were chosen on a simulated city of 300 x 300 m (seed 2001, 1,868 places). The table gives the share of
    queries whose nearest place lies within 5 m, for 150 images on the survey's track and 150 of another traversal:

    ==================================================  =========  ===========
    rings x sectors, floor, height; all else as below   on track   other trav.
    ==================================================  =========  ===========
    20 x 60 (the publication's), 0 m, highest           0.953      0.613
    the same, of all that the camera sees               0.753      0.433
    the same, reach 30 m                                0.887      0.507
    20 x 60, 0 m, mean                                  0.867      0.467
    20 x 60, 0.3 m, highest                             0.973      0.607
    20 x 120, 0 m, highest                              0.980      0.713
    20 x 180, 0 m, highest                              0.987      0.793
    40 x 120, 0 m, highest                              0.980      0.753
    **40 x 180, 0.3 m, highest**                        **1.000**  **0.800**
    40 x 180, 0.3 m, mean                               0.987      0.780
    60 x 180, 0.3 m, highest                            1.000      0.773
    30 x 240, 0.3 m, highest                            0.993      0.800
    ==================================================  =========  ===========

    Attributes:
        rings: number of rings.
        sectors: number of sectors.
        reach_m: radius of the outer ring, metres.
        value: content of a bin: height of the highest point, or mean height.
        floor_m: points below this height above the ground are left out, metres.
        lidar_field: use of a depth image only the elevations that a LiDAR of the view grid sees.
    """

    rings: int = 40
    sectors: int = 180
    reach_m: float = 40.0
    value: Literal["highest", "mean"] = "highest"
    floor_m: float = 0.3
    lidar_field: bool = True


def context_of(points: NDArray[np.floating], settings: ContextSettings) -> NDArray[np.float32]:
    """Compute the bins (rings, sectors) of points; empty bins are 0.

    Ring 0 is the nearest. Sector 0 begins at the heading, and the sectors go counter-clockwise.

    Args:
        points: points (N, 3), metres: level, x along the heading, z above the ground.
        settings: bins and their content.
    """
    x, y, z = np.asarray(points, np.float32).T
    ring = np.floor(np.hypot(x, y) * np.float32(settings.rings / settings.reach_m)).astype(np.int64)
    sector = np.floor(np.arctan2(y, x) % (2 * np.pi) * (settings.sectors / (2 * np.pi))).astype(np.int64)
    inside = (ring < settings.rings) & (z > settings.floor_m)
    cell = (ring * settings.sectors + np.minimum(sector, settings.sectors - 1))[inside]
    bins = np.zeros(settings.rings * settings.sectors, np.float32)
    if settings.value == "highest":
        np.maximum.at(bins, cell, z[inside])
    else:
        count = np.bincount(cell, minlength=len(bins))
        bins = (np.bincount(cell, z[inside].astype(np.float64), len(bins)) / np.maximum(count, 1)).astype(np.float32)
    return bins.reshape(settings.rings, settings.sectors)


def context_of_panorama(
    ranges: NDArray[np.floating], height_m: float, settings: ContextSettings, grid: ViewGrid | None = None
) -> NDArray[np.float32]:
    """Compute the context (rings, sectors) of a levelled LiDAR panorama.

    Args:
        ranges: ranges (rows, around), metres, 0 for no measurement.
        height_m: height of the LiDAR above the ground, metres.
        settings: bins and their content.
        grid: grid of the panorama; None for the default.
    """
    grid = grid or ViewGrid()
    azimuth = (np.arange(grid.around) * (2 * np.pi / grid.around) - np.pi)[None]
    elevation = grid.elevations_rad[:, None]
    flat = np.cos(elevation)
    rays = np.stack(np.broadcast_arrays(flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), axis=-1)
    measured = ranges > 0
    points = rays[measured] * np.asarray(ranges, np.float64)[measured][:, None]
    return context_of(points + np.array([0.0, 0.0, height_m]), settings)


def context_of_depth(
    depth_m: NDArray[np.float32], camera: PinholeCamera, settings: ContextSettings
) -> NDArray[np.float32]:
    """Compute the context (rings, sectors) of a depth image, back-projected and levelled.

    Args:
        depth_m: z (H, W), metres, 0 for no measurement.
        camera: camera of the depth image.
        settings: bins and their content.
    """
    level = level_camera(depth_m, camera, down_camera=None, nominal_height_m=CAMERA_HEIGHT_M)
    measured = depth_m > 0
    points = (camera.rays_of_pixels()[measured] * depth_m[measured][:, None]) @ level.R_level_camera.T
    if settings.lidar_field:
        grid = ViewGrid()
        slope = np.rad2deg(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
        points = points[(slope <= grid.elevation_top_deg) & (slope >= grid.elevation_bottom_deg)]
    return context_of(points + np.array([0.0, 0.0, level.height_m]), settings)


def similarities(queries: NDArray[np.float32], places: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute one minus the distance of contexts (Q, P) at the best shift.

    A sector that the query fills and the place does not has a cosine of 0. A query without any point gets -inf for all
    places.

    Args:
        queries: contexts (Q, rings, sectors).
        places: contexts (P, rings, sectors).
    """
    asked, known = _unit_columns(queries), _unit_columns(places)
    sectors = asked.shape[2]
    fills = (asked != 0).any(axis=1)
    filled, used = fills.sum(axis=1), np.flatnonzero(fills.any(axis=0))
    flat = asked[:, :, used].reshape(len(asked), -1)
    best = np.full((len(asked), len(known)), -np.inf, np.float32)
    for shift in range(sectors):
        turned = known[:, :, (used - shift) % sectors].reshape(len(known), -1)
        np.maximum(best, flat @ turned.T, out=best)
    best /= np.maximum(filled, 1).astype(np.float32)[:, None]
    best[filled == 0] = -np.inf
    return best


def locate(
    frames: Frames, test: Pairs, *, report: Report = lambda *_: None, settings: ContextSettings | None = None
) -> PlaceAnswers:
    """Answer every query by the frame with the nearest context, and its street by the five nearest.

    Args:
        frames: LiDAR frames, thinned here to one place per metre.
        test: queries; only their depth is used.
        report: receives a label, the number of contexts done and their total.
        settings: bins and their content; None for the best known.
    """
    settings, grid = settings or ContextSettings(), ViewGrid()
    rows = thinned(frames.places[:, :2], SPACING_M)
    total = len(rows) + len(test)
    places = []
    for row in rows:
        places.append(context_of_panorama(frames.panoramas[row], float(frames.places[row, 3]), settings, grid))
        report("Scan Context", len(places), total)
    queries = []
    for depth_mm in test.depth_mm:
        depth_m = np.asarray(depth_mm, np.float32) / np.float32(1000)
        queries.append(context_of_depth(depth_m, test.camera, settings))
        report("Scan Context", len(places) + len(queries), total)
    similarity = np.concatenate(
        [
            similarities(np.stack(queries[a:b]), np.stack(places))
            for a, b in pairwise([*range(0, len(queries), 512), len(queries)])
        ]
    )
    return answers_of(similarity, frames.places[rows, :2], frames.street[rows])


def _unit_columns(contexts: NDArray[np.float32]) -> NDArray[np.float32]:
    length = np.linalg.norm(contexts, axis=1, keepdims=True)
    unit: NDArray[np.float32] = contexts / np.maximum(length, np.float32(1e-6))
    return unit
