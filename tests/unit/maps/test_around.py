"""Which tiles are around a position, and which of them gives a region of the cloud."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model_training.mapping.tile_area import Square, TileArea, cloud_of_tile
from service.maps.around import nearest_square, ranks_of_regions, tiles_around
from service.maps.manifest import Counts, Tile
from service.registration.kernel import SURFEL, surfels_at
from service.registration.surfel_map import REGION_M, SurfelMap
from service.registration.surfel_tiles import JoinedSurfels, columns_of_regions, first_region, lies_on_lattice
from tests.unit.lattice import on_lattice

#: Numbers of nine squares: columns 0 to 2, each with rows 0 to 2.
NINE = {(column, row): 3 * column + row for column in range(3) for row in range(3)}


def tile_at(column: int, row: int) -> Tile:
    counts = Counts(places=1, views=1, descriptor_size=1, cloud_points=1, streets=0)
    return Tile(column=column, row=row, version="0" * 16, size=1, counts=counts)


def ground(low: float, high: float, step: float = 0.5) -> SurfelMap:
    """Return a flat ground of high - low metres along both axes. Each surfel has another brightness."""
    x, y = np.meshgrid(np.arange(low, high, step), np.arange(low, high, step))
    surfels = np.zeros(x.size, SURFEL)
    surfels["xyz"], surfels["normal"] = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1), [0, 0, 1]
    return on_lattice(SurfelMap.prepare(np.zeros(3), surfels, np.linspace(1, 100, x.size, dtype=np.float32)))


def test_the_nearest_square_of_a_position() -> None:
    squares_m = np.array([[0.0, 0.0, 50.0, 50.0], [50.0, 0.0, 100.0, 50.0]])
    xy = np.array([[10.0, 10.0], [60.0, 49.0], [-5.0, 200.0], [120.0, -7.0]])
    assert nearest_square(squares_m, xy).tolist() == [0, 1, 0, 1]


@pytest.mark.parametrize(
    ("xy_m", "numbers"),
    [
        ((750.0, 750.0), (4,)),
        # Region 39 from 998.4 to 1,024 m is the first one of column 2.
        ((948.0, 750.0), (4,)),
        ((949.0, 750.0), (4, 7)),
        # Region 19 from 486.4 to 512 m is the last one of column 0, because its centre is at 499.2 m.
        ((561.9, 750.0), (4, 1)),
        ((562.1, 750.0), (4,)),
        ((960.0, 550.0), (4, 3, 6, 7)),
        ((-300.0, 250.0), (4,)),  # the tile that comes first is far away
        ((10.0, 250.0), (4, 0)),
    ],
)
def test_the_tiles_around_a_position(xy_m: tuple[float, float], numbers: tuple[int, ...]) -> None:
    assert tiles_around(NINE, 500.0, np.array([xy_m]), np.array([4])) == [numbers]


def test_each_position_has_its_own_tiles() -> None:
    xy_m = np.array([[750.0, 750.0], [960.0, 750.0], [750.0, 750.0]])
    assert tiles_around(NINE, 500.0, xy_m, np.array([4, 7, 5])) == [(4,), (7, 4), (5, 4)]


@given(st.integers(-10_000, 10_000), st.floats(50.0, 10_000.0))
def test_the_first_region_of_a_column_is_the_first_whose_centre_is_in_it(column: int, tile_m: float) -> None:
    first = first_region(column, tile_m)
    assert columns_of_regions(np.array([first - 1, first]), tile_m).tolist()[1] == column
    assert columns_of_regions(np.array([first - 1]), tile_m)[0] < column
    assert abs((first + 0.5) * REGION_M - column * tile_m) <= REGION_M * (1 + 1e-9)


def test_tiles_together_are_the_whole_cloud() -> None:
    """Nine tiles of 60 m without one in the middle. Each surfel and each cell comes from one tile."""
    whole, squares = ground(0.0, 180.0), [square for square in NINE if square != (1, 1)]
    clouds = [cloud_of_tile(whole, TileArea(Square(*square, 60.0), set(squares), 0.3)) for square in squares]
    assert all(lies_on_lattice(cloud) for cloud in clouds)
    assert sum(len(cloud.surfels) for cloud in clouds) > len(whole.surfels)
    ranks = [ranks_of_regions(cloud, tile_at(*square), 60.0) for cloud, square in zip(clouds, squares, strict=True)]
    joined = JoinedSurfels.of(clouds, ranks)
    given_cubes = np.concatenate([piece.cubes for piece in joined.pieces])
    assert given_cubes["count"].sum() == len(whole.surfels)
    corners = np.round(given_cubes["corner"] / REGION_M).astype(int)
    assert len(np.unique(corners, axis=0)) == len(corners)
    positions = np.random.default_rng(0).uniform([-2, -2, -1], [182, 182, 1], (20_000, 3))
    assert_same_surfels(whole, joined, positions)


def assert_same_surfels(whole: SurfelMap, joined: JoinedSurfels, positions: np.ndarray) -> None:
    expected, found = surfels_at(whole.pieces, positions), surfels_at(joined.pieces, positions - joined.origin_m)
    np.testing.assert_array_equal(found >= 0, expected >= 0)
    at = np.flatnonzero(found >= 0)
    one, other = whole.unpacked(expected[at]), joined.unpacked(found[at])
    np.testing.assert_allclose(other["xyz"] + joined.origin_m, one["xyz"] + whole.origin_m, atol=1e-3)
    np.testing.assert_array_equal(joined.brightness_of(found[at]), whole.brightness_of(expected[at]))


def test_a_tile_that_owns_a_region_goes_before_others_that_have_it() -> None:
    """The first tile was built when its neighbour had no tile, so it has a part of the neighbour's regions. Its surfels there are older."""
    old, new = ground(0.0, 120.0), ground(0.0, 120.0, step=0.25)
    alone = cloud_of_tile(old, TileArea(Square(0, 0, 60.0), {(0, 0)}, 0.3))
    beside = cloud_of_tile(new, TileArea(Square(1, 0, 60.0), {(0, 0), (1, 0)}, 0.3))
    ranks = [ranks_of_regions(alone, tile_at(0, 0), 60.0), ranks_of_regions(beside, tile_at(1, 0), 60.0)]
    first, second = JoinedSurfels.of([alone, beside], ranks).pieces
    border_m = first_region(1, 60.0) * REGION_M
    of_first, of_second = (piece.cubes["corner"][piece.cubes["count"] > 0] for piece in (first, second))
    in_row = [(corner[:, 1] > -1) & (corner[:, 1] < 50) for corner in (of_first, of_second)]
    assert of_first[in_row[0], 0].max() < border_m
    assert of_second[in_row[1], 0].min() == pytest.approx(border_m)
    # Without a tile that owns it, a region comes from the first tile that has it.
    first, second = JoinedSurfels.of([alone, beside], [np.minimum(each, 1) for each in ranks]).pieces
    assert first.cubes["corner"][:, 0].max() > border_m


def moved_origin(cloud: SurfelMap, area: TileArea, origin_m: np.ndarray) -> SurfelMap:
    """Return the same surfels in a frame with another origin."""
    rows = np.arange(len(cloud.surfels))
    moved = cloud.unpacked(rows)
    moved["xyz"] += (cloud.origin_m - origin_m).astype(np.float32)
    packed = SurfelMap.packed(moved, cloud.brightness_of(rows), -origin_m)
    return SurfelMap.of_packed(origin_m, *packed, lambda centres: area.has_cells(centres + origin_m))


def test_surfels_of_tiles_with_other_origins_lie_where_the_map_has_them() -> None:
    whole, squares = ground(0.0, 120.0), {(0, 0), (1, 0)}
    areas = [TileArea(Square(column, 0, 60.0), squares, 0.3) for column in range(2)]
    origins = np.array([[10.0, 20.0, 3.0], [-5.0, 7.0, -40.0]])
    clouds = [moved_origin(cloud_of_tile(whole, area), area, at) for area, at in zip(areas, origins, strict=True)]
    ranks = [ranks_of_regions(cloud, tile_at(column, 0), 60.0) for column, cloud in enumerate(clouds)]
    joined = JoinedSurfels.of(clouds, ranks)
    x, y = np.meshgrid(np.arange(0.1, 119, 0.5), np.arange(0.1, 100, 0.5))
    positions = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.05)], axis=1)
    assert_same_surfels(whole, joined, positions)


def test_a_part_without_intensities_has_unknown_brightness() -> None:
    bright = ground(0.0, 60.0)
    dark = SurfelMap(bright.origin_m, bright.surfels, bright.grid)
    rank = np.full(len(bright.grid.regions), 2, np.int8)
    joined = JoinedSurfels.of([dark, bright], [rank, rank])
    assert joined.has_brightness
    count = len(bright.surfels)
    found = joined.brightness_of(np.array([[0, count], [1, count + 1]]))
    assert found is not None
    assert np.isnan(found[:, 0]).all()
    np.testing.assert_array_equal(found[:, 1], bright.brightness_of(np.array([0, 1])))
    assert JoinedSurfels.of([dark, dark], [rank, rank]).brightness_of(np.array([0])) is None
