"""A picture pair onto the cells of a view grid, in compiled code: the dearest step of a query after decoding, otherwise."""

import ctypes
from ctypes import POINTER, byref, c_double, c_int64, c_void_p
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy.typing import NDArray

from service.compiled import load
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Rotation
from service.imaging.as_c import CPicture, c_picture
from service.imaging.view_grid import ViewGrid

LIBRARY = Path(__file__).with_name("_gather.so")
#: Each cell is sampled by 3 x 3 rays; the median of the measured ones stands, if there are at least this many.
SUB_RAYS = 3
FEWEST_SAMPLES = 3


def finest_rad(grid: ViewGrid) -> float:
    """Angle between neighbouring rays: a picture whose pixels are finer says no more."""
    return grid.column_rad / SUB_RAYS


@cache
def _library() -> ctypes.CDLL:
    library = load(LIBRARY, {"Picture": CPicture}, {"SAMPLES": SUB_RAYS**2})
    library.streetfix_gather.argtypes = [
        c_void_p, c_int64, c_void_p, c_void_p, POINTER(CPicture), c_void_p, POINTER(CPicture), c_double, c_double, c_int64,
        c_void_p, c_void_p, c_void_p,
    ]  # fmt: skip
    library.streetfix_gather.restype = None
    return library


def gather(
    rgb: UInt8[NDArray[np.uint8], "H W 3"],
    depth_m: Float32[NDArray[np.float32], "h w"],
    camera: PinholeCamera,
    R_camera_view: Rotation,
    grid: ViewGrid,
) -> tuple[
    Float32[NDArray[np.float32], "rows columns"],
    Float32[NDArray[np.float32], "rows columns 3"],
    Bool[NDArray[np.bool_], "rows columns"],
]:
    """Range, colour and whether the camera looks there, of every cell of a view.

    Args:
        rgb: sRGB, of the camera's aspect.
        depth_m: z, metres, 0 where nothing was measured; of the camera's aspect.
        camera: pinhole intrinsics.
        R_camera_view: from the view's level frame (x along its heading) to the optical one.
        grid: the view grid.

    Returns:
        Median range (metres, 0 where fewer than ``FEWEST_SAMPLES`` rays meet a measurement within the grid's limits), mean
        colour (0..255, black where the camera does not look), and whether it does.
    """
    # The kernel reads by these sizes, so what it is given must have them.
    rgb, depth_m = np.ascontiguousarray(rgb, np.uint8), np.ascontiguousarray(depth_m, np.float32)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or depth_m.ndim != 2:
        raise ValueError(f"rgb {rgb.shape} and depth {depth_m.shape} are no pictures")
    rays = _sub_rays(grid)
    cells = grid.rows * grid.columns
    R = np.ascontiguousarray(R_camera_view, np.float64).reshape(3, 3)
    ranges, colour = np.empty(cells, np.float32), np.empty((cells, 3), np.float32)
    seen = np.empty(cells, np.bool_)
    _library().streetfix_gather(
        rays.ctypes.data, cells, R.ctypes.data, depth_m.ctypes.data, byref(c_picture(camera, depth_m)), rgb.ctypes.data,
        byref(c_picture(camera, rgb)), grid.min_range_m, grid.max_range_m, FEWEST_SAMPLES, ranges.ctypes.data, colour.ctypes.data,
        seen.ctypes.data,
    )  # fmt: skip
    shape = (grid.rows, grid.columns)
    return ranges.reshape(shape), colour.reshape(*shape, 3), seen.reshape(shape)


@cache
def _sub_rays(grid: ViewGrid) -> Float32[NDArray[np.float32], "samples 3 cells"]:
    """Unit rays, level frame, ``SUB_RAYS`` squared for each cell; sample by sample, as the kernel reads them."""
    rows, columns = grid.elevations_rad, grid.azimuths_rad
    spread = (np.arange(SUB_RAYS) - (SUB_RAYS - 1) / 2) / SUB_RAYS
    row_step, column_step = abs(rows[1] - rows[0]), abs(columns[1] - columns[0])
    elevation = rows[None, None, :, None] + spread[:, None, None, None] * row_step
    azimuth = columns[None, None, None, :] + spread[None, :, None, None] * column_step
    elevation, azimuth = np.broadcast_arrays(elevation, azimuth)
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=2)
    return np.ascontiguousarray(rays.reshape(SUB_RAYS**2, 3, grid.rows * grid.columns), np.float32)
