"""Resample a colour and a depth image to the cells of a view grid, in compiled code.

Speed: a view takes a sixth of the time of NumPy (26 November 2026, decision 0148). In NumPy this step would cost the most of a
retrieval after decoding (decision 0046).
"""

import ctypes
from ctypes import POINTER, byref, c_double, c_int64, c_void_p
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy.typing import NDArray

from service.compiled import load
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Rotation
from service.imaging.as_c import CPicture, c_picture
from service.imaging.view_grid import ViewGrid

#: Library that the build compiles from ``resample.c``.
LIBRARY = Path(__file__).with_name("_resample.so")
#: Each cell is sampled by ``SUB_RAYS`` x ``SUB_RAYS`` rays.
SUB_RAYS = 3
#: A cell gets a range, the median over its rays, only if at least so many of its rays hit a measurement.
FEWEST_SAMPLES = 3


def finest_rad(grid: ViewGrid) -> float:
    """Compute the angle between neighbouring rays, radians.

    An image with finer pixels does not improve the resampled view.

    Args:
        grid: view grid that the images are resampled to.
    """
    return grid.column_rad / SUB_RAYS


@cache
def _library() -> ctypes.CDLL:
    arguments: list[Any] = [
        c_void_p,
        c_int64,
        c_void_p,
        c_void_p,
        POINTER(CPicture),
        c_void_p,
        c_void_p,
        POINTER(CPicture),
        c_double,
        c_double,
        c_int64,
        c_void_p,
        c_void_p,
        c_void_p,
    ]
    library = load(LIBRARY, {"Picture": CPicture}, {"SAMPLES": SUB_RAYS**2, "ARGUMENTS": len(arguments)})
    library.streetfix_resample.argtypes = arguments
    library.streetfix_resample.restype = None
    return library


def resample(
    rgb: UInt8[NDArray[np.uint8], "H W 3"],
    depth_m: Float32[NDArray[np.float32], "h w"],
    camera: PinholeCamera,
    R_camera_view: Rotation,
    grid: ViewGrid,
    observed: Bool[NDArray[np.bool_], "h w"] | None = None,
) -> tuple[
    Float32[NDArray[np.float32], "rows columns"],
    Float32[NDArray[np.float32], "rows columns 3"],
    Bool[NDArray[np.bool_], "rows columns"],
]:
    """Resample a colour and a depth image to the range, colour and visibility of every cell of a view.

    Args:
        rgb: sRGB image with the aspect ratio of the camera.
        depth_m: z, metres, 0 where nothing was measured. It has the aspect ratio of the camera.
        camera: pinhole intrinsics, pixels.
        R_camera_view: rotation from the level frame of the view (x along its heading, z up) to the optical frame, (3, 3).
        grid: view grid.
        observed: pixels of the depth image that the sensor could see; None: all. A ray that hits another pixel hits nothing.

    Returns:
        ranges: median range in metres. 0 where fewer than ``FEWEST_SAMPLES`` rays hit a measurement within the grid's limits.
        colour: mean colour in 0..255, black where no ray hits the colour image.
        seen: whether a ray of the cell hits the depth image.

    Raises:
        ValueError: ``rgb`` is not (H, W, 3), or ``depth_m`` and ``observed`` are not (h, w).
    """
    # The compiled code trusts these shapes and reads memory by them.
    rgb, depth_m = np.ascontiguousarray(rgb, np.uint8), np.ascontiguousarray(depth_m, np.float32)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or depth_m.ndim != 2:
        raise ValueError(f"rgb {rgb.shape} must be (H, W, 3), and depth {depth_m.shape} must be (h, w)")
    if observed is not None:
        observed = np.ascontiguousarray(observed, np.bool_)
        if observed.shape != depth_m.shape:
            raise ValueError(f"observed {observed.shape} must have the shape of the depth image {depth_m.shape}")
    rays = _sub_rays(grid)
    cells = grid.rows * grid.columns
    R = np.ascontiguousarray(R_camera_view, np.float64).reshape(3, 3)
    ranges, colour = np.empty(cells, np.float32), np.empty((cells, 3), np.float32)
    seen = np.empty(cells, np.bool_)
    _library().streetfix_resample(
        rays.ctypes.data,
        cells,
        R.ctypes.data,
        depth_m.ctypes.data,
        byref(c_picture(camera, depth_m)),
        None if observed is None else observed.ctypes.data,
        rgb.ctypes.data,
        byref(c_picture(camera, rgb)),
        grid.min_range_m,
        grid.max_range_m,
        FEWEST_SAMPLES,
        ranges.ctypes.data,
        colour.ctypes.data,
        seen.ctypes.data,
    )
    shape = (grid.rows, grid.columns)
    return ranges.reshape(shape), colour.reshape(*shape, 3), seen.reshape(shape)


@cache
def _sub_rays(grid: ViewGrid) -> Float32[NDArray[np.float32], "samples 3 cells"]:
    """Compute ``SUB_RAYS`` squared unit rays for each cell, in the level frame.

    The first axis is the sample, because the compiled code reads sample by sample.
    """
    rows, columns = grid.elevations_rad, grid.azimuths_rad
    spread = (np.arange(SUB_RAYS) - (SUB_RAYS - 1) / 2) / SUB_RAYS
    row_step, column_step = abs(rows[1] - rows[0]), abs(columns[1] - columns[0])
    elevation = rows[None, None, :, None] + spread[:, None, None, None] * row_step
    azimuth = columns[None, None, None, :] + spread[None, :, None, None] * column_step
    elevation, azimuth = np.broadcast_arrays(elevation, azimuth)
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=2)
    return np.ascontiguousarray(rays.reshape(SUB_RAYS**2, 3, grid.rows * grid.columns), np.float32)
