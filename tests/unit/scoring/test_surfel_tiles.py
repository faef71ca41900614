"""Scores on the clouds of two tiles equal those on one cloud, although each tile has only the surfels around its square."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from service.geometry.camera import PinholeCamera
from service.registration.points import PointSettings
from service.registration.rays import RaySettings
from service.registration.register import Registered
from service.registration.surfel_map import SurfelMap
from service.registration.surfel_tiles import SurfelTiles
from service.registration.visibility import Raycasters
from service.scoring.measured import measure
from service.scoring.photometry import BrightnessScorer, PhotometrySettings
from service.scoring.rendered_depth import RenderedDepthScorer
from service.scoring.structure import StructureScorer, StructureWeights

#: Distance of the frames, border of the tiles, and how far their clouds reach beyond it, m.
APART_M, BORDER_M, MARGIN_M = 60.0, 70.0, 50.0


def clipped(cloud: SurfelMap, low_x: float, high_x: float) -> SurfelMap:
    """Return the surfels between two planes, map frame."""
    surfels = cloud.unpacked(np.s_[:])
    x = surfels["xyz"][:, 0] + cloud.origin_m[0]
    rows = np.flatnonzero((x >= low_x) & (x < high_x))
    brightness = None if cloud.brightness is None else cloud.brightness[rows].astype(np.float32)
    return SurfelMap.prepare(cloud.origin_m, surfels[rows], brightness)


@pytest.fixture(scope="module")
def clouds(street_map):
    """Four copies of the street, 40 m apart, and the same in two tiles that meet at x = 70 m."""
    surfels = []
    for copy in range(4):
        moved = street_map.unpacked(np.s_[:])
        moved["xyz"][:, 0] += 40.0 * copy
        surfels.append(moved)
    joined = np.concatenate(surfels)
    whole = SurfelMap.prepare(np.zeros(3), joined, np.linspace(1, 2, len(joined), dtype=np.float32))
    parts = (clipped(whole, -np.inf, BORDER_M + MARGIN_M), clipped(whole, BORDER_M - MARGIN_M, np.inf))
    squares_m = np.array([[-1e4, -1e4, BORDER_M, 1e4], [BORDER_M, -1e4, 1e4, 1e4]])
    return whole, SurfelTiles(squares_m, parts.__getitem__, np.zeros(3), True, lambda: range(2))


@pytest.mark.parametrize("score", ["depth", "structure", "brightness"])
def test_each_frame_is_scored_on_the_cloud_at_its_own_position(clouds, frame_with, matches_at, score):
    """The reference is just behind the border. The cloud of its tile begins 8 m before the other frame's view ends."""
    rng, camera = np.random.default_rng(0), PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)
    behind = np.eye(4)
    behind[2, 3] = -APART_M  # the camera looks along z
    frames = [
        frame_with(
            matches_at([(0, 0, 2)], [0], [0.9]),
            depth_m=rng.uniform(3, 15, (48, 64)).astype(np.float32),
            camera=camera,
            T_reference_camera=T,
        )
        for T in (np.eye(4), behind)
    ]
    rgb = rng.integers(0, 255, (48, 64, 3), np.uint8)
    frames = [replace(frame, query=replace(frame.query, rgb=rgb)) for frame in frames]
    measured = measure(tuple(frames), PointSettings(), focal_baseline_px_m=80.0, is_rig=False)
    at = Registered(np.eye(3), np.array([BORDER_M + 2.0, 0.0, 1.5]), 1.0, 0.0, 0.5, np.eye(8), 0)
    makers: dict[str, Any] = {
        "depth": lambda cloud: RenderedDepthScorer(cloud, measured),
        "structure": lambda cloud: StructureScorer(cloud, measured, StructureWeights()),
        "brightness": lambda cloud: BrightnessScorer(Raycasters(cloud, RaySettings()), measured, PhotometrySettings()),
    }
    whole, tiles = clouds
    expected, found, wrong = (makers[score](cloud).score((at,)).values for cloud in (whole, tiles, tiles.cloud_of(1)))
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert abs(wrong[0] - expected[0]) > 1e-6  # the cloud of the reference alone does not suffice
