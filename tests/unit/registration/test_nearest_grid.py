from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from service.errors import StreetfixError
from service.registration import kernel
from service.registration.kernel import BLOCK, SURFEL, nearest_grid


def surfels_at(xyz):
    surfels = np.zeros(len(xyz), SURFEL)
    surfels["xyz"], surfels["normal"] = xyz, [0, 0, 1]
    return surfels


def cells_of(grid):
    """Return centre and surfel of every cell of every block, filled or not; -1 for none."""
    size = np.array(grid.block.shape) * BLOCK
    cell = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), axis=-1).reshape(-1, 3)
    block = grid.block[tuple(cell.T // BLOCK)]
    inside = cell % BLOCK @ [BLOCK * BLOCK, BLOCK, 1]
    return grid.origin_m + (cell + 0.5) * grid.cell_m, np.where(block < 0, -1, grid.nearest[block, inside])


@given(
    seed=st.integers(0, 10**6),
    count=st.integers(1, 60),
    cell_m=st.sampled_from([0.3, 0.4, 0.9]),
    reach_m=st.sampled_from([0.5, 1.2, 2.0]),
    extent_m=st.sampled_from([0.0, 1.0, 5.0]),
)
@settings(max_examples=30)
def test_every_cell_within_reach_holds_its_nearest_surfel_and_every_other_none(seed, count, cell_m, reach_m, extent_m):
    rng = np.random.default_rng(seed)
    surfels = surfels_at(rng.uniform(-500, 500, 3) + rng.uniform(0, extent_m, (count, 3)))
    centres, found = cells_of(nearest_grid(surfels, cell_m=cell_m, reach_m=reach_m))
    xyz = surfels["xyz"].astype(np.float64)
    tree: Any = cKDTree(xyz)
    distance, _ = tree.query(centres)
    held = found >= 0
    assert held[distance < reach_m - 1e-4].all()
    assert not held[distance > reach_m + 1e-4].any()
    np.testing.assert_allclose(np.linalg.norm(centres - xyz[found], axis=1)[held], distance[held], atol=1e-4)


def test_no_cell_within_reach_lies_outside_the_grid():
    surfels = surfels_at(np.random.default_rng(1).uniform(0, 3, (40, 3)))
    grid = nearest_grid(surfels, cell_m=0.4, reach_m=1.2)
    low, high = grid.origin_m, grid.origin_m + np.array(grid.block.shape) * BLOCK * grid.cell_m
    assert (low < surfels["xyz"].min(axis=0) - 1.2).all()
    assert (high > surfels["xyz"].max(axis=0) + 1.2).all()


def test_blocks_far_from_every_surfel_take_no_space():
    surfels = surfels_at([[0.0, 0, 0], [100, 0, 0]])
    grid = nearest_grid(surfels, cell_m=0.5, reach_m=1.0)
    assert grid.block.size > 25
    assert len(grid.nearest) == (grid.block >= 0).sum() <= 16
    np.testing.assert_array_equal(np.sort(grid.block[grid.block >= 0]), np.arange(len(grid.nearest)))


def test_a_missing_library_says_what_to_do(monkeypatch, tmp_path):
    kernel._library.cache_clear()
    monkeypatch.setattr(kernel, "LIBRARY", tmp_path / "_kernel.so")
    with pytest.raises(StreetfixError, match=r"_kernel\.so is missing .* install the package again"):
        nearest_grid(surfels_at([[0.0, 0, 0]]), cell_m=0.5, reach_m=1.0)
