import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from benchmarks.native.plain import surfels_of_cells
from service.errors import StreetfixError
from service.registration import kernel
from service.registration.kernel import BLOCK, PACKED_SURFEL, REGION, SURFEL, Piece, packed_map

#: Shares of a random map: surfels in one heap, in two heaps a region apart, and in two towns 60 km apart.
APART_M = [0.0, 30.0, 60_000.0]


def surfels_at(xyz):
    surfels = np.zeros(len(xyz), SURFEL)
    surfels["xyz"], surfels["normal"] = xyz, [0, 0, 1]
    return surfels


def mapped(surfels, *, cell_m, reach_m):
    """Return the grid of a map and the positions of its surfels, in the order of the map."""
    grid, packed, _ = packed_map(surfels, cell_m=cell_m, reach_m=reach_m)
    return grid, grid.unpacked(packed, np.arange(len(packed)))


def held_at(grid, positions):
    return kernel.surfels_at((Piece(grid, np.zeros(0, PACKED_SURFEL)),), positions)


def filled_cells(grid):
    return int(np.bitwise_count(grid.blocks["filled"]).sum())


def cells_around(grid, surfels, reach_m):
    """Return all cells of the box around each surfel, one cell wider than its reach, each once (n, 3)."""
    half = int(np.ceil(reach_m / grid.cell_m)) + 1
    steps = np.stack(np.meshgrid(*[np.arange(-half, half + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    own = np.floor((surfels["xyz"].astype(np.float64) - grid.origin_m) / grid.cell_m).astype(np.int64)
    return np.unique((np.unique(own, axis=0)[:, None] + steps).reshape(-1, 3), axis=0)


def dense_grid(surfels, cells, grid, reach_m):
    """Return the surfel of each cell by brute force, with the rounding of the dense grid of format 3."""
    centres = grid.origin_m + (cells + 0.5) * grid.cell_m
    offset = centres[:, None] - surfels["xyz"].astype(np.float64)
    distance2 = (offset[..., 0] ** 2 + offset[..., 1] ** 2 + offset[..., 2] ** 2).astype(np.float32)
    distance2[distance2.astype(np.float64) > reach_m * reach_m] = np.inf
    nearest = distance2.argmin(axis=1)  # the first of two equally near surfels
    return np.where(np.isfinite(distance2[np.arange(len(cells)), nearest]), nearest, -1)


random_maps = given(
    seed=st.integers(0, 10**6),
    count=st.integers(1, 60),
    cell_m=st.sampled_from([0.3, 0.4, 0.9]),
    reach_m=st.sampled_from([0.5, 1.2, 2.0]),
    extent_m=st.sampled_from([0.0, 1.0, 5.0]),
    apart_m=st.sampled_from(APART_M),
)


def random_surfels(seed, count, extent_m, apart_m):
    rng = np.random.default_rng(seed)
    towns = rng.integers(0, 2, (count, 1)) * [0.8 * apart_m, -0.6 * apart_m, 0]
    return surfels_at(rng.uniform(-500, 500, 3) + towns + rng.uniform(0, extent_m, (count, 3)))


@random_maps
@settings(max_examples=30, deadline=None)
def test_every_cell_holds_the_surfel_that_a_dense_grid_holds(seed, count, cell_m, reach_m, extent_m, apart_m):
    surfels = random_surfels(seed, count, extent_m, apart_m)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernel, "_CHUNK", 7)  # several chunks, as in a large map
        grid, surfels = mapped(surfels, cell_m=cell_m, reach_m=reach_m)
    cells = cells_around(grid, surfels, reach_m)
    expected = dense_grid(surfels, cells, grid, reach_m)
    centres = grid.origin_m + (cells + 0.5) * cell_m
    np.testing.assert_array_equal(held_at(grid, centres), expected)
    np.testing.assert_array_equal(surfels_of_cells(grid, cells), expected)
    assert filled_cells(grid) == (expected >= 0).sum()  # and no cell outside these boxes is filled


#: Uppermost bit of ``before``: the block is wide.
WIDE = np.uint64(1 << 63)


@pytest.mark.parametrize(
    ("count", "extent_m", "wide"), [(150, 3.0, False), (500, 6.0, False), (1500, 3.0, True), (400, 1.0, True)]
)
def test_blocks_with_few_and_with_many_surfels_hold_the_nearest(count, extent_m, wide):
    """The cells of a block that has or refers to too many surfels for one byte take three bytes each."""
    surfels = surfels_at(np.random.default_rng(count).uniform(0, extent_m, (count, 3)))
    grid, surfels = mapped(surfels, cell_m=0.4, reach_m=1.2)
    cells = cells_around(grid, surfels, 1.2)
    expected = dense_grid(surfels, cells, grid, 1.2)
    np.testing.assert_array_equal(held_at(grid, grid.origin_m + (cells + 0.5) * 0.4), expected)
    np.testing.assert_array_equal(surfels_of_cells(grid, cells), expected)
    assert grid.cells_defect() is None
    assert (grid.blocks["before"] & WIDE > 0).any() == wide


def test_the_bytes_of_the_cells_are_as_the_format_says():
    """Cells of 1 m in blocks of 8 m, worked out by hand. The first surfel is nearest to a cell on each side of the border of its block."""
    surfels = surfels_at([[9.5, 4.5, 4.5], [7.9, 4.5, 4.5]])
    packed, order = kernel.packed_surfels(surfels, cell_m=1.0, reach_m=0.7, lattice_m=np.zeros(3))
    grid = kernel.nearest_grid(packed)
    np.testing.assert_array_equal(grid.origin_m, 0)
    np.testing.assert_array_equal(order, [1, 0])  # the surfel of the first block first
    np.testing.assert_array_equal(grid.cells, [0, 0, 0, 1, 0])  # own; list: number 0; first foreign one, own
    np.testing.assert_array_equal(grid.blocks["first"], [0, 3])
    np.testing.assert_array_equal(grid.blocks["own"], [0 << 8 | 1, 1 << 8 | 1])
    np.testing.assert_array_equal(grid.blocks["before"], [0, sum(2 << 9 * (part - 1) for part in (4, 5, 6, 7))])
    np.testing.assert_array_equal(np.argwhere(grid.blocks["filled"]), [[0, 7], [1, 3]])
    assert grid.blocks["filled"][0, 7] == 1 << 48  # the cell 3, 0, 0 of the part
    assert grid.blocks["filled"][1, 3] == 1 << 0 | 1 << 16


@random_maps
@settings(max_examples=30, deadline=None)
def test_every_cell_within_reach_holds_its_nearest_surfel_and_every_other_none(
    seed, count, cell_m, reach_m, extent_m, apart_m
):
    surfels = random_surfels(seed, count, extent_m, apart_m)
    grid, surfels = mapped(surfels, cell_m=cell_m, reach_m=reach_m)
    cells = cells_around(grid, surfels, reach_m)
    centres = grid.origin_m + (cells + 0.5) * cell_m
    found = held_at(grid, centres)
    xyz = surfels["xyz"].astype(np.float64)
    tree: Any = cKDTree(xyz)
    distance, _ = tree.query(centres)
    held = found >= 0
    assert held[distance < reach_m - 1e-4].all()
    assert not held[distance > reach_m + 1e-4].any()
    np.testing.assert_allclose(np.linalg.norm(centres - xyz[found], axis=1)[held], distance[held], atol=1e-4)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30, -1e30, 1e9, -0.5, 6.8e6])
def test_a_position_outside_the_grid_has_no_surfel(value):
    surfels = surfels_at(np.random.default_rng(1).uniform(0, 3, (40, 3)))
    grid, surfels = mapped(surfels, cell_m=0.4, reach_m=1.2)
    inside = np.tile(surfels["xyz"][:1].astype(np.float64), (3, 1))
    assert (held_at(grid, inside) >= 0).all()
    np.fill_diagonal(inside, grid.origin_m + value)
    np.testing.assert_array_equal(held_at(grid, inside), -1)


def test_positions_of_many_regions_alternate():
    """The kernel remembers the last regions; two regions that are 8 regions apart share an entry."""
    step = 8 * REGION * BLOCK * 0.5
    surfels = surfels_at([[k * step, 0, 0] for k in range(5)])
    grid, _ = mapped(surfels, cell_m=0.5, reach_m=1.0)
    order = np.random.default_rng(0).integers(-1, 6, 1000)
    expected = np.where((order >= 0) & (order < 5), order, -1)
    np.testing.assert_array_equal(held_at(grid, np.c_[order * step, np.zeros((1000, 2))]), expected)


def bytes_of(grid):
    return sum(each.nbytes for each in (grid.slots, grid.regions, grid.blocks, grid.cells, grid.others))


def test_two_towns_60_km_apart_take_what_both_take():
    """Also while the grid is built: nothing covers the ground between them."""
    town = np.random.default_rng(1).uniform(0, [60, 60, 6], (20_000, 3))
    parts = [town, town + [45_000.0, 40_000.0, 300.0]]

    def cost(xyz):
        surfels = surfels_at(xyz)
        packed_map(surfels[:10], cell_m=0.4, reach_m=1.2)  # what the first call loads does not count
        tracemalloc.start()
        grid, packed, _ = packed_map(surfels, cell_m=0.4, reach_m=1.2)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return bytes_of(grid) + packed.nbytes, peak

    one, other, both = (cost(xyz) for xyz in (*parts, np.concatenate(parts)))
    for alone, together in zip(np.add(one, other), both, strict=True):
        assert together < 1.05 * alone


def test_blocks_far_from_every_surfel_take_no_space():
    surfels = surfels_at([[0.0, 0, 0], [100, 0, 0]])
    grid, _ = mapped(surfels, cell_m=0.5, reach_m=1.0)
    assert 2 <= len(grid.regions) <= 16
    assert len(grid.blocks) == np.bitwise_count(grid.regions["has"]).sum() <= 16
    assert filled_cells(grid) <= 2 * 5**3
    assert len(grid.cells) == filled_cells(grid)  # one byte each: no cell refers to a surfel of another block


def test_surfels_beyond_the_numbers_of_the_regions_are_refused():
    surfels = surfels_at([[0.0, 0, 0], [0, 7e6, 0]])
    with pytest.raises(StreetfixError, match=r"extends over 7,000 km, .* of 0\.4 m reaches 6,711 km; build a map of"):
        packed_map(surfels, cell_m=0.4, reach_m=1.2)


def test_a_missing_library_says_what_to_do(monkeypatch, tmp_path):
    kernel._library.cache_clear()
    monkeypatch.setattr(kernel, "LIBRARY", tmp_path / "_kernel.so")
    with pytest.raises(StreetfixError, match=r"_kernel\.so is missing .* install the package again"):
        packed_map(surfels_at([[0.0, 0, 0]]), cell_m=0.5, reach_m=1.0)
