"""The surfel map of a map bundle: surfels, the tiles they are sorted by, and a lookup grid of nearest surfels.

``build-map`` computes all of it, and the service reads it as it is on disk. A request builds nothing.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from service.errors import BundleError
from service.registration.kernel import (
    GRID_BLOCK,
    GRID_REGION,
    SURFEL,
    NearestGrid,
    QueryPoints,
    SolverOptions,
    align,
    nearest_grid,
)

#: Edge of a cell of the lookup grid, and largest distance from a surfel to a cell that refers to it, m.
CELL_M, REACH_M = 0.4, 1.2
#: Edge of a tile, m.
TILE_M = 40.0


_FLOATS, _NUMBERS, _BRIGHT = np.dtype("<f8"), np.dtype("<i4"), np.dtype("<f4")
#: Name of the array of intensities. Maps of earlier releases, or of a sensor without intensity, do not have it.
BRIGHTNESS = "brightness"
#: Type and shape of every other array by name; -1 is any length.
_EXPECTED: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {
    "origin": (_FLOATS, (3,)),
    "surfels": (SURFEL, (-1,)),
    "tiles": (_FLOATS, (-1, 4)),
    "grid_frame": (_FLOATS, (4,)),
    "grid_slots": (_NUMBERS, (-1,)),
    "grid_regions": (GRID_REGION, (-1,)),
    "grid_blocks": (GRID_BLOCK, (-1,)),
    "grid_nearest": (_NUMBERS, (-1,)),
}


@dataclass(frozen=True, slots=True, eq=False)
class SurfelMap:
    """Surfels, their tiles for rendering, and their lookup grid for registration.

    Positions are relative to ``origin_m``, with the axes of the map frame. We call this the surfels' frame.

    Attributes:
        origin_m: origin of the surfels' frame, map frame, m.
        surfels: (S,) of ``SURFEL``, sorted by tile.
        tiles: centre x, y (surfels' frame, m), first surfel, number of surfels.
        grid: lookup grid of the nearest surfel.
        brightness: mean intensity of each surfel's returns in the sensor's unit, NaN where unknown; None if the map has no intensities.
    """

    origin_m: Float64[NDArray[np.float64], "3"]
    surfels: NDArray[Any]
    tiles: Float64[NDArray[np.float64], "n 4"]
    grid: NearestGrid
    brightness: Float32[NDArray[np.float32], " s"] | None = None

    @classmethod
    def prepare(
        cls,
        origin_m: Float64[NDArray[np.float64], "3"],
        surfels: NDArray[Any],
        tiles: Float64[NDArray[np.float64], "n 4"],
        brightness: Float32[NDArray[np.float32], " s"] | None = None,
    ) -> "SurfelMap":
        """Build the lookup grid of a map; this takes seconds for a district.

        Args:
            origin_m: origin of the surfels' frame, map frame, m.
            surfels: (S,) of ``SURFEL``, sorted by tile.
            tiles: centre x, y (surfels' frame, m), first surfel, number of surfels.
            brightness: mean intensity of each surfel's returns, NaN where unknown. An array without a value above 0 comes from a sensor
                without intensity and counts as None.
        """
        if brightness is not None and not (brightness > 0).any():
            brightness = None
        return cls(origin_m, surfels, tiles, nearest_grid(surfels, cell_m=CELL_M, reach_m=REACH_M), brightness)

    @property
    def has_brightness(self) -> bool:
        """Whether the map has intensities."""
        return self.brightness is not None

    def at(self, position_m: Float64[NDArray[np.float64], "3"]) -> "SurfelMap":  # noqa: ARG002 - as of SurfelTiles
        """Return the surfel map at a position: this one. A tiled map has several (``SurfelTiles.at``).

        Args:
            position_m: position, map frame, m.
        """
        return self

    def parts(self, most: int = 1) -> tuple["SurfelMap", ...]:  # noqa: ARG002 - as of SurfelTiles
        """Return the surfel maps to draw: this one. A tiled map has several (``SurfelTiles.parts``).

        Args:
            most: largest number of them.
        """
        return (self,)

    def align(
        self,
        points: QueryPoints,
        states: NDArray[Any],
        options: SolverOptions,
        *,
        tolerance_m: float = 0.1,
        height_min_m: float = -1e9,
    ) -> None:
        """Register every start on this cloud, in place, then score it (``kernel.align``).

        Args:
            points: of the query.
            states: starts, (n,) of ``STATE``, relative to ``origin_m``; overwritten with the results.
            options: of the solver.
            tolerance_m: standard deviation of a point's distance to its surface in the score, m, apart from its noise.
            height_min_m: points lower than this do not count in the score, m.
        """
        align(self.grid, self.surfels, points, states, options, tolerance_m=tolerance_m, height_min_m=height_min_m)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays to write, by name; ``from_arrays`` reads them again.

        Returns:
            origin (3,), surfels (S,), tiles (T, 4), grid_frame (4,), grid_slots (H,), grid_regions (R,), grid_blocks (B,),
            grid_nearest (F,). A map with intensities also has brightness (S,). ``grid_frame`` holds the grid's origin and the
            edge of its cells, m.
        """
        arrays = {
            "origin": self.origin_m,
            "surfels": self.surfels,
            "tiles": self.tiles,
            "grid_frame": np.array([*self.grid.origin_m, self.grid.cell_m]),
            "grid_slots": self.grid.slots,
            "grid_regions": self.grid.regions,
            "grid_blocks": self.grid.blocks,
            "grid_nearest": self.grid.nearest,
        }
        return arrays if self.brightness is None else arrays | {BRIGHTNESS: self.brightness}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], *, verify: bool = True) -> "SurfelMap":
        """Assemble a map from arrays that were read or memory-mapped.

        Args:
            arrays: arrays by name, as ``arrays`` returns them: origin (3,), surfels (S,), tiles (T, 4), grid_frame (4,),
                grid_slots (H,), grid_regions (R,), grid_blocks (B,), grid_nearest (F,) and, if the map has intensities, brightness (S,).
            verify: check every index and number. The kernel itself does not check them.

        Raises:
            BundleError: an array is missing, has a wrong type or shape, or refers outside another. The error names the array.
        """
        for name, (dtype, shape) in _EXPECTED.items():
            if name not in arrays:
                raise _defect(name, "missing")
            array = arrays[name]
            fits = len(shape) == array.ndim and all(w in (-1, has) for w, has in zip(shape, array.shape, strict=True))
            if array.dtype != dtype or not fits or not array.flags["C_CONTIGUOUS"]:
                raise _defect(
                    name, f"{array.dtype} of shape {array.shape} instead of {dtype} of shape {shape} (-1: any)"
                )
        brightness = arrays.get(BRIGHTNESS)
        if brightness is not None and (brightness.dtype, brightness.shape) != (_BRIGHT, arrays["surfels"].shape):
            raise _defect(
                BRIGHTNESS, f"{brightness.dtype} of shape {brightness.shape} instead of one {_BRIGHT} per surfel"
            )
        frame = np.array(arrays["grid_frame"])
        grid = NearestGrid(
            frame[:3], float(frame[3]), *(arrays[f"grid_{name}"] for name in ("slots", "regions", "blocks", "nearest"))
        )
        found = cls(np.array(arrays["origin"]), arrays["surfels"], np.array(arrays["tiles"]), grid, brightness)
        if verify:
            found.require_consistent()
        return found

    def require_consistent(self) -> None:
        """Check that all indices refer to existing entries and that all numbers make sense.

        Raises:
            BundleError: an index refers outside its array, or a number is not finite or otherwise invalid. The error names the array.
        """
        if not np.isfinite(self.grid.origin_m).all() or not self.grid.cell_m > 0:
            raise _defect("grid_frame", "the origin is not finite, or the cell size is not positive")
        _require_levels(self.grid)
        _require_indices("grid_nearest", self.grid.nearest, len(self.surfels), least=0)
        first, count = self.tiles[:, 2], self.tiles[:, 3]
        if not np.isfinite(self.tiles).all() or (first < 0).any() or (count < 0).any():
            raise _defect("tiles", "a number is not finite, or an index is negative")
        if len(self.tiles) and (first + count).max() > len(self.surfels):
            raise _defect("tiles", "a tile ends beyond the surfels")
        if not np.isfinite(self.origin_m).all():
            raise _defect("origin", "a coordinate is not finite")
        if self.brightness is not None and (np.isinf(self.brightness).any() or (self.brightness < 0).any()):
            raise _defect(BRIGHTNESS, "a brightness is negative or infinite")
        for name in ("xyz", "normal", "thickness_m"):
            if not np.isfinite(self.surfels[name]).all():
                raise _defect("surfels", f"a number of {name} is not finite")


def _require_levels(grid: NearestGrid) -> None:
    """Check that every region is in the hash table once, its blocks are in ``blocks``, and their filled cells in ``nearest``."""
    slots, regions, blocks = grid.slots, grid.regions, grid.blocks
    if len(slots) < 2 or len(slots) & (len(slots) - 1) or len(slots) <= len(regions):
        raise _defect(
            "grid_slots", f"{len(slots)} slots for {len(regions)} regions instead of a power of two above their number"
        )
    _require_indices("grid_slots", slots, len(regions), least=-1)
    if not np.array_equal(np.sort(slots[slots >= 0]), np.arange(len(regions))):
        raise _defect("grid_slots", "a region is missing or occurs twice")
    most = regions["row"].max(axis=1, initial=0).astype(np.int64)
    if (regions["first"] < 0).any() or (regions["first"] > len(blocks) - most).any():
        raise _defect("grid_regions", f"a block is outside the {len(blocks)} entries of grid_blocks")
    cells = np.cumsum(np.bitwise_count(blocks["filled"]), axis=1, dtype=np.int64)
    if (blocks["before"][:, 0] != 0).any() or (blocks["before"][:, 1:] != cells[:, :-1]).any():
        raise _defect("grid_blocks", "a number of filled cells is wrong")
    if (blocks["first"] < 0).any() or (blocks["first"] > len(grid.nearest) - cells[:, -1]).any():
        raise _defect("grid_blocks", f"a cell is outside the {len(grid.nearest)} entries of grid_nearest")


def _require_indices(name: str, indices: NDArray[np.int32], count: int, *, least: int) -> None:
    if indices.size and (int(indices.min()) < least or int(indices.max()) >= count):
        raise _defect(name, f"an index is outside the {count} entries")


def _defect(name: str, what: str) -> BundleError:
    return BundleError(f"cloud/{name}.npy: {what}; copy or build the bundle again", field=f"cloud/{name}.npy")
