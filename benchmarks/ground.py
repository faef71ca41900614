"""Ground that is not a plane below the camera: ramps, kerbs, no ground in view, and a camera that looks down steeply.

The queries of a level camera are changed where the simulator has no such ground. Only their depth changes. The camera's pose stays true.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from benchmarks.plans import GROUND_CAMERA_M, RAMP_DEG, STEEP_DEG, ground_plan, height_plan
from benchmarks.report import Report
from benchmarks.runs import Runs, accepted_within, within
from service.geometry.camera import PinholeCamera
from service.imaging.level import level_query
from service.retrieval.query import Query

#: Height of a kerb, and the distance of its edge from the camera, metres.
KERB_M, KERB_ASIDE_M = 0.15, 0.8
#: Depth of points lower than this above the ground is missing, metres.
MISSING_M = 0.3
#: A point counts as ground within this distance of the ground plane, metres.
_GROUND_M = 0.12
#: Length of the ramp that the vehicle stands on, metres. Its slope is the pitch of the queries ``ramp`` (``ground_plan``).
RAMP_M = 6.0


def on_a_ramp(query: Query, *, height_m: float) -> Query:
    """Return the query of a vehicle that stands on a ramp, with its camera parallel to the ramp.

    The ground nearer than the ramp's end is the plane of the wheels. What lies beyond is unchanged.

    Args:
        query: query whose camera looks up by the slope of the ramp.
        height_m: height of the camera above the ramp, metres.
    """
    rays = _rays(query)
    with np.errstate(divide="ignore"):
        ramp = np.where(rays[..., 1] > 0, height_m / rays[..., 1], np.inf)
    hides = (ramp <= RAMP_M) & ((query.depth_m == 0) | (ramp < query.depth_m))
    return replace(query, depth_m=np.where(hides, ramp, query.depth_m).astype(np.float32))


def at_a_kerb(query: Query) -> Query:
    """Return the query of a robot on a pavement, with the road to its left a kerb lower.

    Args:
        query: query of a camera on level ground.
    """
    left_m, above_m, height_m = _over_ground(query)
    is_road = (np.abs(above_m) < _GROUND_M) & (left_m > KERB_ASIDE_M)
    lower = query.depth_m * np.float32((height_m + KERB_M) / height_m)
    return replace(query, depth_m=np.where(is_road, lower, query.depth_m))


def without_ground(query: Query) -> Query:
    """Return the query of a camera that measures no ground, as on wet asphalt.

    Args:
        query: query of a camera on level ground.
    """
    _, above_m, _ = _over_ground(query)
    return replace(query, depth_m=np.where(above_m < MISSING_M, np.float32(0), query.depth_m))


def _camera(query: Query) -> PinholeCamera:
    """Return the camera at the size of the depth image."""
    height, width = query.depth_m.shape
    return query.camera.scaled_to(width, height)


def _rays(query: Query) -> Float64[NDArray[np.float64], "H W 3"]:
    return _camera(query).rays_of_pixels()


def _over_ground(
    query: Query,
) -> tuple[Float64[NDArray[np.float64], "H W"], Float64[NDArray[np.float64], "H W"], float]:
    """Return each point's distance to the left of the camera and its height above the ground, and the height of the camera, metres."""
    level, _ = level_query(query.depth_m, _camera(query))
    points = (query.depth_m[..., None] * _rays(query)) @ level.R_level_camera.T
    return points[..., 1], points[..., 2] + level.height_m, level.height_m


def ground_rows(report: Report, runs: Runs) -> None:
    """Add the rows of unusual ground: each with the share that is accepted and right, right when forced, and accepted and wrong.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    bundle, dataset = runs.bundle(runs.dataset(height_plan(GROUND_CAMERA_M))), runs.dataset(ground_plan())
    cases: dict[str, tuple[str, Callable[[Query], Query] | None]] = {
        "level": ("level_precise", None),
        f"pitched_{STEEP_DEG:g}_deg": ("steep_precise", None),
        f"ramp_{RAMP_DEG:g}_deg": ("ramp_precise", lambda query: on_a_ramp(query, height_m=GROUND_CAMERA_M)),
        "kerb": ("level_precise", at_a_kerb),
        "missing": ("level_precise", without_ground),
    }
    for name, (queries, changed) in cases.items():
        found = runs.predictions(bundle, dataset, queries, rig=None if changed is None else (name, changed))
        right = within(found, 1.0)
        report.share(f"ground.{name}.within_1_m", accepted_within(found, 1.0))
        report.share(f"ground.{name}.forced_within_1_m", right)
        report.share(f"ground.{name}.wrong_and_accepted", found.localized & ~right, better="lower")
