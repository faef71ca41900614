"""The compiled resample against the same computation in NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from service.errors import StreetfixError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z
from service.imaging import resample as module
from service.imaging.resample import FEWEST_SAMPLES, _sub_rays, resample
from service.imaging.view_grid import ViewGrid

GRID = ViewGrid(rows=5, columns=37)  # neither a whole block of cells nor a whole number of rows in one


def plain(rgb, depth_m, camera, R, grid, observed=None):
    """Compute ray by ray in float32, as the kernel does."""
    rays = _sub_rays(grid).transpose(2, 0, 1).astype(np.float64) @ R.T
    cells = len(rays)
    ranges, colour, seen = np.zeros(cells), np.zeros((cells, 3)), np.zeros(cells, bool)
    for cell in range(cells):
        found, colours = [], []
        for ray in rays[cell]:
            own = camera.scaled_to(depth_m.shape[1], depth_m.shape[0])
            if observed is not None and ray[2] > 1e-3:
                u, v = np.rint(ray[0] / ray[2] * own.fx + own.cx), np.rint(ray[1] / ray[2] * own.fy + own.cy)
                inside = 0 <= u < depth_m.shape[1] and 0 <= v < depth_m.shape[0]
                if inside and not observed[int(v), int(u)]:
                    continue
            for picture, kind in ((depth_m, "depth"), (rgb, "rgb")):
                own = camera.scaled_to(picture.shape[1], picture.shape[0])
                if ray[2] <= 1e-3:
                    continue
                u, v = np.rint(ray[0] / ray[2] * own.fx + own.cx), np.rint(ray[1] / ray[2] * own.fy + own.cy)
                if not (0 <= u < picture.shape[1] and 0 <= v < picture.shape[0]):
                    continue
                value = picture[int(v), int(u)]
                if kind == "rgb":
                    colours.append(value)
                else:
                    seen[cell] = True
                    if grid.min_range_m <= value / ray[2] <= grid.max_range_m:
                        found.append(value / ray[2])
        if len(found) >= FEWEST_SAMPLES:
            ranges[cell] = sorted(found)[(len(found) - 1) // 2]
        if colours:
            colour[cell] = np.mean(colours, axis=0)
    shape = (grid.rows, grid.columns)
    return ranges.reshape(shape), colour.reshape(*shape, 3), seen.reshape(shape)


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    turn=st.floats(-3.2, 3.2),
    tilt=st.floats(-0.4, 0.4),
    own_size=st.booleans(),
    holes=st.floats(0, 1),
    unseen=st.sampled_from([None, 0.0, 0.3, 1.0]),
)
def test_the_kernel_equals_numpy(seed, turn, tilt, own_size, holes, unseen):
    rng = np.random.default_rng(seed)
    camera = PinholeCamera(64, 48, 31.7, 31.9, 31.3, 23.1)
    rgb = rng.integers(0, 256, (48, 64, 3), np.uint8)
    depth_m = rng.uniform(0.1, 60, (48, 64) if own_size else (24, 32)).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < holes] = 0
    pitch = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    R = R_BODY_OPTICAL.T @ pitch @ rotation_z(turn)
    observed = None if unseen is None else rng.random(depth_m.shape) >= unseen
    found = resample(rgb, depth_m, camera, R, GRID, observed)
    expected = plain(rgb, depth_m, camera, R, GRID, observed)
    # A ray that falls just between two pixels may go either way: one of a thousand, here none or one cell.
    for one, other in zip(found, expected, strict=True):
        assert np.mean(~np.isclose(one, other, rtol=1e-4, atol=1e-3)) <= 2 / found[2].size
    assert found[2].dtype == np.bool_


def test_a_value_that_is_not_finite_is_no_measurement():
    camera = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)
    rgb = np.full((48, 64, 3), 255, np.uint8)
    for value in (np.nan, np.inf, -np.inf, -3.0, 0.0, 1e30):
        ranges, colour, seen = resample(rgb, np.full((48, 64), value, np.float32), camera, R_BODY_OPTICAL.T, GRID)
        assert not ranges.any()
        assert seen.any()
        np.testing.assert_array_equal(np.unique(colour[seen]), 255)


@pytest.mark.parametrize("focal", [1e-6, 1e6])
@pytest.mark.parametrize("centre", [-1e6, 1e6])
def test_absurd_intrinsics_read_no_pixel_that_is_not_there(focal, centre):
    camera = PinholeCamera(64, 48, focal, focal, centre, centre)
    ranges, _, seen = resample(
        np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), np.float32), camera, R_BODY_OPTICAL.T, GRID
    )
    assert ranges.shape == seen.shape == (GRID.rows, GRID.columns)


def test_a_cell_that_only_meets_unobserved_pixels_is_empty():
    """The right half of the image is not observed. Columns run from left to right."""
    camera = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)
    observed = np.repeat(np.arange(64)[None] < 32, 48, axis=0)
    rgb, depth_m = np.full((48, 64, 3), 200, np.uint8), np.full((48, 64), 5, np.float32)
    ranges, colour, seen = resample(rgb, depth_m, camera, R_BODY_OPTICAL.T, ViewGrid(rows=5, columns=36), observed)
    assert seen[:, :17].all()
    assert (colour[:, :17] == 200).all()
    assert not seen[:, 19:].any()
    assert not ranges[:, 19:].any()
    assert not colour[:, 19:].any()


def test_pictures_that_are_none_are_refused():
    camera = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)
    with pytest.raises((ValueError, TypeCheckError)):
        resample(
            np.zeros((48, 64, 3), np.uint8),
            np.ones((48, 64), np.float32),
            camera,
            R_BODY_OPTICAL.T,
            GRID,
            np.ones((9, 9), bool),
        )
    with pytest.raises((ValueError, TypeCheckError)):  # whichever looks first
        resample(np.zeros((48, 64), np.uint8), np.ones((48, 64), np.float32), camera, R_BODY_OPTICAL.T, GRID)


def test_a_missing_library_says_what_to_do(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "LIBRARY", tmp_path / "_resample.so")
    module._library.cache_clear()
    with pytest.raises(StreetfixError, match=r"_resample\.so is missing .* install the package again"):
        module._library()
    module._library.cache_clear()
