"""The view grid: cells of metric range by azimuth and elevation, the common image space of map views and query views.

A row has one elevation (top first). A column has one azimuth (left first). Both are angles in the *level frame*: x along the
heading of the view, z up (normal to the local ground). A cell stands for a ray, not for an area. Its value is the range along the
ray through its centre, metres, and 0 means "not measured". Map and query discard ranges beyond ``max_range_m``.
"""

import ctypes
from ctypes import c_double, c_float, c_int64, c_void_p
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy.typing import NDArray

from service.compiled import load

#: Library that the build compiles from ``view_grid.c``.
LIBRARY = Path(__file__).with_name("_view_grid.so")
#: Input planes of the encoder, in this order: range (m), which replaces the intensity. V1 and V2 (grey levels, eq. 9; 0 without
#: colour). Height above the local ground (m). 1 where the sensor could have measured. Brightness of the LiDAR return or of the
#: image (``brightness``, standard deviations).
PLANES = ("range_m", "v1", "v2", "height_m", "observed", "brightness")

#: Largest valid range of the default grid, metres. Images of depth for people end there too.
MAX_RANGE_M = 40.0
#: Offset under the logarithm of brightness, as a share of the mean. All values well below it count as equally black.
BRIGHTNESS_FLOOR = 0.03
#: Smallest standard deviation of this logarithm. A flatter view carries no information, e.g. from a sensor without intensity.
LEAST_BRIGHTNESS_SPREAD = 0.05
#: Largest absolute brightness, standard deviations.
BRIGHTNESS_LIMIT = 3.0

Ranges = Float32[NDArray[np.float32], "rows columns"]
#: Range (m) and intensity (unit of the sensor) of a LiDAR over 360 degrees.
Panorama = Float32[NDArray[np.float32], "2 rows around"]
#: Range (m) and intensity (unit of the sensor) of a LiDAR in one view.
LidarView = Float32[NDArray[np.float32], "2 rows columns"]
Planes = Float32[NDArray[np.float32], "6 rows columns"]


@cache
def _library() -> ctypes.CDLL:
    arguments: dict[str, list[Any]] = {
        "fill": [c_void_p, c_int64, c_int64],
        "cut": [
            c_void_p, c_void_p, c_void_p, c_void_p, c_int64, c_int64, c_void_p, c_int64, c_int64,
            c_float, c_void_p, c_void_p, c_void_p,
        ],
        "brighten": [
            c_void_p, c_int64, c_int64, c_void_p, c_int64, c_int64, c_void_p, c_void_p,
            c_double, c_double, c_void_p,
        ],
    }  # fmt: skip
    constants = {f"{name.upper()}_ARGUMENTS": len(given) for name, given in arguments.items()}
    constants |= {"PLANES": len(PLANES), "RANGE": PLANES.index("range_m")}
    constants |= {"HEIGHT": PLANES.index("height_m"), "BRIGHTNESS": PLANES.index("brightness")}
    library = load(LIBRARY, constants=constants)
    for name, given in arguments.items():
        function = getattr(library, f"streetfix_{name}")
        function.argtypes, function.restype = given, c_int64 if name == "cut" else None
    return library


@dataclass(frozen=True, slots=True)
class ViewGrid:
    """Shape and limits of the view grid.

    The defaults are the best of the prototype (feasibility study, November 2026).

    Attributes:
        rows: number of elevations.
        columns: number of azimuths.
        azimuth_span_deg: horizontal field of view, degrees.
        elevation_top_deg: elevation of the top row, degrees.
        elevation_bottom_deg: elevation of the bottom row, degrees.
        min_range_m: smallest valid range, metres.
        max_range_m: largest valid range, metres.
    """

    rows: int = 32
    columns: int = 128
    azimuth_span_deg: float = 90.0
    elevation_top_deg: float = 15.0
    elevation_bottom_deg: float = -15.0
    min_range_m: float = 0.5
    max_range_m: float = MAX_RANGE_M

    @property
    def elevations_rad(self) -> Float64[NDArray[np.float64], " rows"]:
        """Elevation of every row, radians, top row first. The first and the last row lie on the limits."""
        return np.deg2rad(np.linspace(self.elevation_top_deg, self.elevation_bottom_deg, self.rows))

    @property
    def azimuths_rad(self) -> Float64[NDArray[np.float64], " columns"]:
        """Azimuth of every column's centre from the heading, radians, counter-clockwise. The left column is positive."""
        span = np.deg2rad(self.azimuth_span_deg)
        azimuths: Float64[NDArray[np.float64], " columns"] = (
            span / 2 - span * (np.arange(self.columns) + 0.5) / self.columns
        )
        return azimuths

    @property
    def column_rad(self) -> float:
        """Angle between neighbouring columns, radians."""
        return float(np.deg2rad(self.azimuth_span_deg)) / self.columns

    def widened(self, columns: int) -> "ViewGrid":
        """Return this grid with further columns on each side. The angle between columns stays the same.

        Args:
            columns: number of columns to add on the left, and again on the right.
        """
        count = self.columns + 2 * columns
        return replace(self, columns=count, azimuth_span_deg=self.azimuth_span_deg * count / self.columns)

    @property
    def around(self) -> int:
        """Number of columns of a panorama: 360 degrees at twice the density of a view.

        Any heading then lies within half a panorama column.
        """
        return round(2 * self.columns * 360.0 / self.azimuth_span_deg)

    def rays_level(self) -> Float64[NDArray[np.float64], "rows columns 3"]:
        """Compute the unit rays of the cells in the level frame (x along the heading, y left, z up)."""
        elevation, azimuth = np.meshgrid(self.elevations_rad, self.azimuths_rad, indexing="ij")
        flat = np.cos(elevation)
        return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)


def panorama_from_points(points_level: Float32[NDArray[np.float32], "N 4"], grid: ViewGrid) -> Panorama:
    """Project a levelled scan to a panorama of range and intensity.

    Each cell takes the point whose ray is nearest to the ray of the cell (decision 0004). Gaps between two beams are filled where
    the cells on both sides lie on one surface.

    Args:
        points_level: x, y, z in the level frame (metres, z up, origin at the sensor, azimuth 0 along x), and intensity.
        grid: rows and limits. The panorama has ``grid.around`` columns. Column 0 is at azimuth -pi.

    Returns:
        Range (metres) and intensity. Both are 0 where nothing was measured within the limits.
    """
    x, y, z, intensity = (np.ascontiguousarray(axis) for axis in points_level.T)
    flat = np.hypot(x, y)
    distance = np.hypot(flat, z)
    elevation = np.arctan2(z, flat)
    top, bottom = np.deg2rad(grid.elevation_top_deg), np.deg2rad(grid.elevation_bottom_deg)
    row_exact = (top - elevation) / (top - bottom) * (grid.rows - 1)
    around = grid.around
    column_exact = (np.arctan2(y, x) + np.pi) / (2 * np.pi) * around
    row = np.rint(row_exact).astype(np.int64)
    column = np.rint(column_exact).astype(np.int64) % around
    good = (row >= 0) & (row < grid.rows) & (distance >= grid.min_range_m) & (distance <= grid.max_range_m)
    cell = (row * around + column)[good]
    off = np.abs(row_exact - row)[good] + np.abs(column_exact - np.rint(column_exact))[good]
    least = np.full(grid.rows * around, np.inf, off.dtype)
    np.minimum.at(least, cell, off)
    nearest = np.flatnonzero(off == least[cell])  # of equally near points of a cell the last is written last and stays
    panorama = np.zeros((2, grid.rows * around), np.float32)
    panorama[0, cell[nearest]] = distance[good][nearest]
    panorama[1, cell[nearest]] = intensity[good][nearest]
    _fill_between_beams(panorama, around)
    return panorama.reshape(2, grid.rows, around)


def _fill_between_beams(cells: Float32[NDArray[np.float32], "2 cells"], around: int) -> None:
    """Fill gaps of one to three rows, and of one column, whose two sides lie on one surface, in place.

    The ranges of the two sides may differ by 15, 20 or 25 % across one, two or three rows, and by 10 % across a column.

    Args:
        cells: range and intensity of the cells of a panorama, row by row.
        around: number of cells of a row.
    """
    _library().streetfix_fill(cells.ctypes.data, cells.shape[1] // around, around)


def view_from_panorama(panorama: Panorama, heading_rad: float, grid: ViewGrid) -> LidarView:
    """Cut the view along a heading out of a panorama.

    Args:
        panorama: range and intensity over 360 degrees.
        heading_rad: heading of the view from x of the panorama's level frame, counter-clockwise, radians.
        grid: view grid, the one of the panorama.
    """
    view: LidarView = panorama.take(_columns_at(np.array([heading_rad]), grid)[0], axis=2)
    return view


def _columns_at(
    headings_rad: Float64[NDArray[np.float64], " views"], grid: ViewGrid
) -> Int64[NDArray[np.int64], "views columns"]:
    """Return the columns of a panorama that are the columns of the views along some headings."""
    azimuth = headings_rad[:, None] + grid.azimuths_rad
    return np.asarray(np.rint((azimuth + np.pi) / (2 * np.pi) * grid.around).astype(np.int64) % grid.around)


def survey_planes(
    view: LidarView,
    *,
    sensor_height_m: float,
    rows_seen: Bool[NDArray[np.bool_], " rows"],
    grid: ViewGrid,
) -> Planes:
    """Compute the input planes of the encoder for a LiDAR view.

    A LiDAR view has no colour. It is observed in all rows that the beams of the survey reach.

    Args:
        view: range (metres) and intensity.
        sensor_height_m: height of the LiDAR above the local ground, metres.
        rows_seen: rows that the LiDAR of the survey covers. The other rows are blank in map views and query views (decision 0006).
        grid: view grid.

    Raises:
        ValueError: the view has not the shape of the grid.
    """
    _require_shape(view, rows_seen, grid, grid.columns)
    planes: Planes = _planes_of(view, np.arange(grid.columns)[None], sensor_height_m, rows_seen, grid)[0]
    return planes


def fan_planes(
    panorama: Panorama,
    headings_rad: Float64[NDArray[np.float64], " views"],
    *,
    sensor_height_m: float,
    rows_seen: Bool[NDArray[np.bool_], " rows"],
    grid: ViewGrid,
) -> Float32[NDArray[np.float32], "views 6 rows columns"]:
    """Compute the input planes of the encoder for the views of a panorama along several headings.

    They are those of ``survey_planes`` for each ``view_from_panorama``. But what does not depend on the heading is computed once.

    Args:
        panorama: range (metres) and intensity over 360 degrees.
        headings_rad: heading of each view from x of the panorama's level frame, counter-clockwise, radians.
        sensor_height_m: height of the LiDAR above the local ground, metres.
        rows_seen: rows that the LiDAR of the survey covers.
        grid: view grid, the one of the panorama.

    Raises:
        ValueError: the panorama has not the shape of the grid.
    """
    _require_shape(panorama, rows_seen, grid, grid.around)
    return _planes_of(panorama, _columns_at(headings_rad, grid), sensor_height_m, rows_seen, grid)


def _require_shape(
    measured: Float32[NDArray[np.float32], "2 rows _"],
    rows_seen: Bool[NDArray[np.bool_], " rows"],
    grid: ViewGrid,
    columns: int,
) -> None:
    """Refuse a measurement of another grid: the C code would read and write outside of the arrays."""
    if measured.shape != (2, grid.rows, columns) or rows_seen.shape != (grid.rows,):
        raise ValueError(
            f"a measurement of the shape {measured.shape} with {len(rows_seen)} rows seen is not one of the view grid: give "
            f"{(2, grid.rows, columns)} and {grid.rows} rows"
        )


def _planes_of(
    measured: Float32[NDArray[np.float32], "2 rows _"],
    columns: Int64[NDArray[np.int64], "views columns"],
    sensor_height_m: float,
    rows_seen: Bool[NDArray[np.bool_], " rows"],
    grid: ViewGrid,
) -> Float32[NDArray[np.float32], "views 6 rows columns"]:
    """Compute the planes of views that have some columns of a measurement (range and intensity)."""
    ranges, intensity = np.ascontiguousarray(measured, np.float32)
    inside = (ranges >= grid.min_range_m) & (ranges <= grid.max_range_m) & rows_seen[:, None]
    kept = ranges * inside
    height = heights_of(kept, sensor_height_m, grid)
    planes = np.zeros((len(columns), len(PLANES), grid.rows, grid.columns), np.float32)
    planes[:, PLANES.index("observed")] = rows_seen[:, None]
    shares, counts = np.empty(len(columns) * grid.rows * grid.columns, np.float32), np.empty(len(columns), np.int64)
    rows, around = ranges.shape
    views = (columns.ctypes.data, len(columns), grid.columns)
    count = _library().streetfix_cut(
        kept.ctypes.data,
        height.ctypes.data,
        intensity.ctypes.data,
        inside.ctypes.data,
        rows,
        around,
        *views,
        BRIGHTNESS_FLOOR,
        planes.ctypes.data,
        shares.ctypes.data,
        counts.ctypes.data,
    )
    logarithms = np.log(shares[:count])  # as for query views: another logarithm rounds otherwise
    _library().streetfix_brighten(
        inside.ctypes.data,
        rows,
        around,
        *views,
        counts.ctypes.data,
        logarithms.ctypes.data,
        LEAST_BRIGHTNESS_SPREAD,
        BRIGHTNESS_LIMIT,
        planes.ctypes.data,
    )
    return planes


def heights_of(
    ranges: Float32[NDArray[np.float32], "*lead rows columns"], sensor_height_m: float, grid: ViewGrid
) -> Float32[NDArray[np.float32], "*lead rows columns"]:
    """Compute the height above the local ground of every measured cell, metres, and 0 elsewhere.

    Args:
        ranges: range of each cell, metres, 0 where nothing was measured.
        sensor_height_m: height of the sensor above the local ground, metres.
        grid: view grid of the ranges.
    """
    sine = np.sin(grid.elevations_rad).astype(np.float32)[:, None]
    return np.where(ranges > 0, ranges * sine + np.float32(sensor_height_m), np.float32(0))


def brightness(
    values: Float32[NDArray[np.float32], "rows columns"],
    *,
    measured: Bool[NDArray[np.bool_], "rows columns"],
    seen: Bool[NDArray[np.bool_], "rows columns"],
) -> Float32[NDArray[np.float32], "rows columns"]:
    """Normalise the brightness of a view to standard deviations from its mean: a cue that LiDAR intensity and grey level share.

    The two have no common scale. Exposure, gamma and the calibration of the sensor differ. So the logarithm is normalised: its mean
    is subtracted, and the result is divided by its standard deviation. Both are taken over the cells with a range. The result does
    not change if a gain or a gamma changes (decision 0023).

    Args:
        values: intensity of LiDAR returns, or of an image (paper, eq. 9). Not negative, any scale.
        measured: cells with a range. Mean and standard deviation are taken over these cells.
        seen: cells whose value is valid. The sky of an image has a brightness and no range.

    Returns:
        Brightness in standard deviations, clipped to +-3. It is 0 outside ``seen``. It is 0 everywhere if the measured cells
        have no positive mean, or if their logarithm varies less than ``LEAST_BRIGHTNESS_SPREAD``.
    """
    of_measured = values[measured]
    mean = float(of_measured.mean()) if of_measured.size else 0.0
    if not mean > 0:
        return np.zeros_like(values)
    logarithm = np.log(values / np.float32(mean) + np.float32(BRIGHTNESS_FLOOR))
    middle, spread = float(logarithm[measured].mean()), float(logarithm[measured].std())
    if spread < LEAST_BRIGHTNESS_SPREAD:
        return np.zeros_like(values)
    scaled = np.clip((logarithm - np.float32(middle)) / np.float32(spread), -BRIGHTNESS_LIMIT, BRIGHTNESS_LIMIT)
    result: Float32[NDArray[np.float32], "rows columns"] = np.where(seen, scaled, np.float32(0))
    return result
