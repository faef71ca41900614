"""The view grid: azimuth x elevation cells of metric range, the one image space of map views and queries.

A row looks at one elevation (top first), a column at one azimuth (left first), both in a *level frame*: x along the
heading of the view, z up (normal to the local ground). A cell is a ray, not an area: its value is the range along the
ray through its centre, metres; 0 is "no measurement". Both sides forget what lies beyond ``max_range_m``.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy.typing import NDArray

from service.imaging.brightness import brightness

#: What the encoder is given of a view, in this order: range (m) in the place of intensity, V1 and V2 (grey levels,
#: eq. 9; 0 where there is no colour), height above the local ground (m), 1 where the sensor could have measured, and
#: brightness (``service.imaging.brightness``): of the LiDAR's return on one side, of the picture on the other.
PLANES = ("range_m", "v1", "v2", "height_m", "observed", "brightness")

Ranges = Float32[NDArray[np.float32], "rows columns"]
#: Range (m) and intensity (as the sensor gives it) of a LiDAR, all round; and of what lies ahead.
Panorama = Float32[NDArray[np.float32], "2 rows around"]
LidarView = Float32[NDArray[np.float32], "2 rows columns"]
Planes = Float32[NDArray[np.float32], "6 rows columns"]


@dataclass(frozen=True, slots=True)
class ViewGrid:
    """Shape and limits of the view grid; the defaults are the prototype's best (feasibility, November 2026)."""

    rows: int = 32
    columns: int = 128
    azimuth_span_deg: float = 90.0
    elevation_top_deg: float = 15.0
    elevation_bottom_deg: float = -15.0
    min_range_m: float = 0.5
    max_range_m: float = 40.0

    @property
    def elevations_rad(self) -> Float64[NDArray[np.float64], " rows"]:
        """Elevation of every row, the top row first; the first and last lie on the limits."""
        return np.deg2rad(np.linspace(self.elevation_top_deg, self.elevation_bottom_deg, self.rows))

    @property
    def azimuths_rad(self) -> Float64[NDArray[np.float64], " columns"]:
        """Azimuth of every column's centre against the heading, counter-clockwise, so the left column is positive."""
        span = np.deg2rad(self.azimuth_span_deg)
        azimuths: Float64[NDArray[np.float64], " columns"] = (
            span / 2 - span * (np.arange(self.columns) + 0.5) / self.columns
        )
        return azimuths

    @property
    def column_rad(self) -> float:
        """Azimuth from a column to the next."""
        return float(np.deg2rad(self.azimuth_span_deg)) / self.columns

    def widened(self, columns: int) -> "ViewGrid":
        """The same with so many further columns on either side."""
        count = self.columns + 2 * columns
        return replace(self, columns=count, azimuth_span_deg=self.azimuth_span_deg * count / self.columns)

    @property
    def around(self) -> int:
        """Columns of a panorama: 360 degrees at twice the view's density, so any heading lies within a half column."""
        return round(2 * self.columns * 360.0 / self.azimuth_span_deg)

    def rays_level(self) -> Float64[NDArray[np.float64], "rows columns 3"]:
        """Unit rays of the cells in the level frame (x along the heading, y left, z up)."""
        elevation, azimuth = np.meshgrid(self.elevations_rad, self.azimuths_rad, indexing="ij")
        flat = np.cos(elevation)
        return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)


def panorama_from_points(points_level: Float32[NDArray[np.float32], "N 4"], grid: ViewGrid) -> Panorama:
    """Range and intensity all round of a levelled scan: each cell takes the point whose ray is nearest to the cell's.

    Rows that fall between two beams are filled where the cells above and below agree on one surface.

    Args:
        points_level: x, y, z (metres, z up, origin at the sensor; azimuth 0 is x) and intensity.
        grid: rows and limits; the panorama has ``grid.around`` columns, column 0 at azimuth -pi.

    Returns:
        Range, metres, and intensity; both 0 where nothing was measured within the limits.
    """
    x, y, z, intensity = points_level.T
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
    # Written far ones first, so that the nearest to the cell's own ray is written last and stays.
    off = np.abs(row_exact - row)[good] + np.abs(column_exact - np.rint(column_exact))[good]
    order = np.argsort(-off, kind="stable")
    panorama = np.zeros((2, grid.rows * around), np.float32)
    panorama[0, cell[order]] = distance[good][order]
    panorama[1, cell[order]] = intensity[good][order]
    return _fill_between_beams(panorama.reshape(2, grid.rows, around))


def _fill_between_beams(panorama: Panorama) -> Panorama:
    """Fill gaps of one to three rows, and single columns, whose two sides lie on one surface (within 10 % of range)."""
    filled = panorama.copy()
    rows = panorama.shape[1]
    for gap in (1, 2, 3):
        for offset in range(1, gap + 1):
            above, below = filled[:, : rows - gap - 1], filled[:, gap + 1 :]
            hole = filled[:, offset : rows - gap - 1 + offset]
            agree = (hole[0] == 0) & (above[0] > 0) & (below[0] > 0)
            agree &= np.abs(above[0] - below[0]) < (0.10 + 0.05 * gap) * np.minimum(above[0], below[0])
            share = np.float32(offset / (gap + 1))
            hole[:, agree] = (1 - share) * above[:, agree] + share * below[:, agree]
    left, right = np.roll(filled, 1, axis=2), np.roll(filled, -1, axis=2)
    agree = (filled[0] == 0) & (left[0] > 0) & (right[0] > 0)
    agree &= np.abs(left[0] - right[0]) < 0.10 * np.minimum(left[0], right[0])
    filled[:, agree] = 0.5 * (left[:, agree] + right[:, agree])
    return filled


def view_from_panorama(panorama: Panorama, heading_rad: float, grid: ViewGrid) -> LidarView:
    """Cut the view that looks along a heading (radians, against the panorama's x) out of a panorama."""
    azimuth = heading_rad + grid.azimuths_rad
    column = np.rint((azimuth + np.pi) / (2 * np.pi) * grid.around).astype(np.int64) % grid.around
    return panorama[:, :, column]


def survey_planes(
    view: LidarView,
    *,
    sensor_height_m: float,
    rows_seen: Bool[NDArray[np.bool_], " rows"],
    grid: ViewGrid,
) -> Planes:
    """The encoder's planes of a LiDAR view: no colour, and observed wherever the survey's beams reach.

    Args:
        view: range (metres) and intensity.
        sensor_height_m: of the LiDAR above the local ground.
        rows_seen: rows that the survey's sensor covers; the others are blank on both sides.
        grid: the view grid.
    """
    planes = np.zeros((len(PLANES), grid.rows, grid.columns), np.float32)
    ranges, intensity = view
    inside = (ranges >= grid.min_range_m) & (ranges <= grid.max_range_m) & rows_seen[:, None]
    planes[0] = ranges * inside
    planes[3] = heights_of(planes[0], sensor_height_m, grid)
    planes[4] = rows_seen[:, None]
    planes[5] = brightness(intensity, measured=inside, seen=inside)
    return planes


def heights_of(
    ranges: Float32[NDArray[np.float32], "*lead rows columns"], sensor_height_m: float, grid: ViewGrid
) -> Float32[NDArray[np.float32], "*lead rows columns"]:
    """Height above the local ground, metres, of every measured cell; 0 elsewhere."""
    sine = np.sin(grid.elevations_rad).astype(np.float32)[:, None]
    return np.where(ranges > 0, ranges * sine + np.float32(sensor_height_m), np.float32(0))
