"""Check the calibrated confidence on a site with queries that are rendered from held-out scans of the survey.

Neither the index nor the cloud of the map contains a held-out scan. The check renders the scan as a camera would see it: depth and grey
values come from the beams, and noise of a stereo camera is added. Then it queries the map. All these queries lie in the map. So they can
show that the confidence is too high, but not that it is too low. The correction only lowers the confidence (decision 0030).
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model_training.mapping.rendered_query import grey_image, noisy_depth
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from
from service.imaging.view_grid import ViewGrid, panorama_from_points
from service.localization.localizer import Localizer
from service.maps.calibration import RIGHT_M, Calibration, Site, probability
from service.maps.content import BundleContent
from service.maps.reader import MapBundle
from service.maps.writer import write_bundle
from service.retrieval.query import Query

#: Largest and smallest number of held-out scans. With fewer than ``FEWEST`` there is no check.
MOST, FEWEST = 60, 20
#: One place in this many is held out, at most ``MOST``.
_EACH = 25
#: Camera of the rendered queries.
_CAMERA = PinholeCamera(320, 240, 160.0, 160.0, 159.5, 119.5)
#: Noise of disparity of the presets precise and stereo, pixels; the queries alternate between them. Focal length times baseline, px m.
_NOISE_PX, _FOCAL_BASELINE = (0.1, 0.5), 80.0
#: Largest depth of a rendered query, metres.
_LARGEST_M = 60.0
#: Standard deviation of the prior of the offset, in log odds (decision 0030).
_PRIOR_OFFSET = 1.0
#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class HeldScan:
    """A scan that was held out of the map.

    Attributes:
        points: x, y, z (metres, level frame of the LiDAR) and intensity (n, 4).
        T_map_level: pose of the levelled LiDAR (4, 4).
    """

    points: NDArray[np.float32]
    T_map_level: NDArray[np.float64]


def held_out(places: int) -> set[int]:
    """Return the indices of the held-out places, evenly spread; none if there are too few places for a check.

    Args:
        places: number of places.
    """
    count = min(MOST, places // _EACH)
    if count < FEWEST:
        return set()
    return set(np.linspace(0, places - 1, count + 2)[1:-1].astype(int).tolist())


def site_of(
    content_of: Callable[[], BundleContent],
    held: list[HeldScan],
    calibration: Calibration,
    report: Report = lambda *_: None,
) -> Site:
    """Localize the held-out scans in the map without them, and fit the offset of the confidence.

    The queries do not use the brightness of the map. Their own brightness comes from the survey and agrees better than that of any
    camera.

    Args:
        content_of: returns the map without places that a held-out scan takes part in. Its cloud must not contain the held-out scans. The
            map is written and then read from disk, so it must not stay in memory a second time.
        held: the held-out scans.
        calibration: the calibration to check.
        report: called after every query.

    Returns:
        The offset, the number of queries and of right answers, and the expected calibration error with the offset.
    """
    confidence, right = [], []
    with tempfile.TemporaryDirectory(prefix="streetfix-site-") as folder:
        write_bundle(Path(folder) / "map", _to_check(content_of()))
        bundle = MapBundle.open(Path(folder) / "map", verify=False)
        localizer = Localizer.open(bundle)
        for number, scan in enumerate(held):
            query, T_map_camera = _drawn(scan, bundle.grid, number)
            answer = localizer.localize(query)
            odds = None if answer.evidence is None else float(calibration.log_odds("right", answer.evidence))
            confidence.append(-30.0 if odds is None else odds)
            right.append(float(np.linalg.norm(answer.T_map_camera_guess[:2, 3] - T_map_camera[:2, 3])) <= RIGHT_M)
            report("site check", number + 1, len(held))
    odds_of, is_right = np.array(confidence), np.array(right)
    offset = min(0.0, _offset(odds_of, is_right))
    error = abs(float(probability(odds_of + offset).mean() - is_right.mean()))
    return Site(offset=offset, queries=len(held), right=int(is_right.sum()), expected_calibration_error=error)


def _offset(odds: NDArray[np.float64], right: NDArray[np.bool_]) -> float:
    """Return the most probable offset of the log odds under a Gaussian prior around 0 (Newton's method)."""
    offset = 0.0
    for _ in range(50):
        p = probability(odds + offset)
        gradient = float((p - right).sum()) + offset / _PRIOR_OFFSET**2
        step = gradient / (float((p * (1 - p)).sum()) + 1 / _PRIOR_OFFSET**2)
        offset -= float(np.clip(step, -1.0, 1.0))
    return offset


def _to_check(content: BundleContent) -> BundleContent:
    """Return the map without calibration, preview and the brightness of its cloud."""
    return replace(
        content,
        calibration={"calibrated": False, "why": "the calibration is being checked"},
        preview_webp=b"",
        cloud=None if content.cloud is None else replace(content.cloud, brightness=None),
    )


def _drawn(scan: HeldScan, grid: ViewGrid, number: int) -> tuple[Query, NDArray[np.float64]]:
    """Render the query of a camera at the LiDAR's position; return it with its T_map_camera."""
    rng = np.random.default_rng([2718, number])
    R_level_camera = rotation_z(rng.uniform(-np.pi, np.pi)) @ R_BODY_OPTICAL
    panorama = panorama_from_points(scan.points, grid)
    rays = _CAMERA.rays_of_pixels() @ R_level_camera.T
    azimuth, flat = np.arctan2(rays[..., 1], rays[..., 0]), np.hypot(rays[..., 0], rays[..., 1])
    top, bottom = np.deg2rad(grid.elevation_top_deg), np.deg2rad(grid.elevation_bottom_deg)
    row = np.rint((top - np.arctan2(rays[..., 2], flat)) / (top - bottom) * (grid.rows - 1)).astype(int)
    column = np.rint((azimuth + np.pi) / (2 * np.pi) * grid.around).astype(int) % grid.around
    inside = (row >= 0) & (row < grid.rows)
    cell = np.where(inside, row, 0), column
    # Half of the noise's variance differs from beam to beam, half from pixel to pixel.
    depth_m = noisy_depth(
        np.where(inside, panorama[0][cell], 0) / np.linalg.norm(rays, axis=-1),
        _NOISE_PX[number % 2] / _FOCAL_BASELINE,
        cell[0] * grid.around + cell[1],
        grid.rows * grid.around,
        rng,
        largest_m=_LARGEST_M,
    )
    rgb = grey_image(np.where(inside, panorama[1][cell], np.float32(0)))
    T_map_camera = scan.T_map_level @ transform_from(R_level_camera, np.zeros(3))
    return Query(rgb=rgb, depth_m=depth_m, camera=_CAMERA, down_camera=-R_level_camera[2]), T_map_camera
