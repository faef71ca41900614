"""Scores on the clouds of tiles equal those on one cloud, although each tile has only the surfels of its square."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from model_training.mapping.tile_area import Square, TileArea, cloud_of_tile
from service.geometry.camera import PinholeCamera
from service.registration.points import PointSettings
from service.registration.rays import RaySettings
from service.registration.register import Registered
from service.registration.surfel_map import SurfelMap
from service.registration.surfel_tiles import JoinedSurfels, SurfelTiles, columns_of_regions, numbers_in_map
from service.registration.visibility import Raycasters
from service.scoring.measured import measure
from service.scoring.photometry import BrightnessScorer, PhotometrySettings
from service.scoring.rendered_depth import RenderedDepthScorer
from service.scoring.structure import StructureScorer, StructureWeights
from tests.unit.lattice import on_lattice

#: Distance of the frames, and edge of the tiles, m.
APART_M, TILE_M = 60.0, 70.0


@pytest.fixture(scope="module")
def clouds(street_map):
    """Four copies of the street, 40 m apart, and the same in tiles. The first two meet at x = 70 m."""
    surfels = []
    for copy in range(4):
        moved = street_map.unpacked(np.s_[:])
        moved["xyz"][:, 0] += 40.0 * copy
        surfels.append(moved)
    joined = np.concatenate(surfels)
    whole = on_lattice(SurfelMap.prepare(np.zeros(3), joined, np.linspace(1, 2, len(joined), dtype=np.float32)))
    squares = [(column, row) for column in range(3) for row in (-1, 0)]
    tiles = [cloud_of_tile(whole, TileArea(Square(*square, TILE_M), set(squares), 0.3)) for square in squares]

    def near(xy_m):
        own = [squares.index((int(x), int(y))) for x, y in np.floor(xy_m / TILE_M)]
        return [(first, *(number for number in range(len(tiles)) if number != first)) for first in own]

    def surfels_of(numbers):
        if len(numbers) == 1:
            return tiles[numbers[0]]
        ranks = []
        for number in numbers:
            owners = columns_of_regions(numbers_in_map(tiles[number])[:, :2], TILE_M)
            ranks.append((owners == squares[number]).all(axis=1).astype(np.int8))
        return JoinedSurfels.of([tiles[number] for number in numbers], ranks)

    return whole, SurfelTiles(near, surfels_of, np.zeros(3), True, lambda: range(len(tiles)))


@pytest.mark.parametrize("score", ["depth", "structure", "brightness"])
def test_each_frame_is_scored_on_the_cloud_at_its_own_position(clouds, frame_with, matches_at, score):
    """The reference is just behind the border of two tiles, and the other frame looks at it from behind."""
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
    at = Registered(np.eye(3), np.array([TILE_M + 2.0, 1.0, 1.5]), 1.0, 0.0, 0.5, np.eye(8), 0)
    makers: dict[str, Any] = {
        "depth": lambda cloud: RenderedDepthScorer(cloud, measured),
        "structure": lambda cloud: StructureScorer(cloud, measured, StructureWeights()),
        "brightness": lambda cloud: BrightnessScorer(Raycasters(cloud, RaySettings()), measured, PhotometrySettings()),
    }
    whole, tiles = clouds
    expected, found, wrong = (
        makers[score](cloud).score((at,)).values for cloud in (whole, tiles, tiles.surfels_of((3,)))
    )
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert abs(wrong[0] - expected[0]) > 1e-6  # the cloud of the reference alone does not suffice
