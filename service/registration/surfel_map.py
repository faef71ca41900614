"""The surfel map of a map bundle: surfels and a lookup grid of nearest surfels.

``build-map`` computes all of it, and the service reads it as it is on disk. A request builds nothing.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float16, Float32, Float64
from numpy.typing import NDArray

from service.errors import BundleError
from service.registration.kernel import (
    BLOCK,
    GRID_BLOCK,
    GRID_REGION,
    PACKED_SURFEL,
    REGION,
    TOLERANCE_M,
    ChooseRegions,
    NearestGrid,
    PackedSurfels,
    Piece,
    QueryPoints,
    SolverOptions,
    align,
    nearest_grid,
    packed_surfels,
)

#: Edge of a cell of the lookup grid, and largest distance from a surfel to a cell that refers to it, m.
CELL_M, REACH_M = 0.4, 1.2
#: Edge of a region of the lookup grid, m.
REGION_M = REGION * BLOCK * CELL_M
#: Largest coordinate of the corner of a grid, and largest edge of a cell, m. A damaged file may hold any number.
MOST_AWAY_M, LARGEST_CELL_M = 1e7, 10.0

_FLOATS, _NUMBERS, _BRIGHT = np.dtype("<f8"), np.dtype("<i4"), np.dtype("<f2")
#: Name of the array of intensities. Maps of a sensor without intensity do not have it.
BRIGHTNESS = "brightness"
#: Type and shape of every other array by name; -1 is any length.
_EXPECTED: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {
    "origin": (_FLOATS, (3,)),
    "surfels": (PACKED_SURFEL, (-1,)),
    "grid_frame": (_FLOATS, (4,)),
    "grid_slots": (_NUMBERS, (-1,)),
    "grid_regions": (GRID_REGION, (-1,)),
    "grid_blocks": (GRID_BLOCK, (-1,)),
    "grid_cells": (np.dtype("u1"), (-1,)),
    "grid_others": (_NUMBERS, (-1,)),
}


@dataclass(frozen=True, slots=True, eq=False)
class SurfelMap:
    """Surfels, and their lookup grid for registration. Rendering goes through the regions of the grid.

    Positions are relative to ``origin_m``, with the axes of the map frame. We call this the surfels' frame.

    Attributes:
        origin_m: origin of the surfels' frame, map frame, m.
        surfels: (S,) of ``PACKED_SURFEL``, sorted by region and block of the grid.
        grid: lookup grid of the nearest surfel.
        brightness: mean intensity of each surfel's returns in the sensor's unit, NaN where unknown; None if the map has no intensities.
        pieces: surfels and grid as the kernel takes them; computed.
    """

    origin_m: Float64[NDArray[np.float64], "3"]
    surfels: NDArray[Any]
    grid: NearestGrid
    brightness: Float16[NDArray[np.float16], " s"] | None = None
    pieces: tuple[Piece, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "pieces", (Piece(self.grid, self.surfels),))

    @classmethod
    def prepare(
        cls,
        origin_m: Float64[NDArray[np.float64], "3"],
        surfels: NDArray[Any],
        brightness: Float32[NDArray[np.float32], " s"] | None = None,
    ) -> "SurfelMap":
        """Pack the surfels of a map and build the lookup grid; this takes seconds for a district.

        Args:
            origin_m: origin of the surfels' frame, map frame, m.
            surfels: (S,) of ``SURFEL``, in any order.
            brightness: mean intensity of each surfel's returns, NaN where unknown. An array without a value above 0 comes from a sensor
                without intensity and counts as None.
        """
        return cls.of_packed(origin_m, *cls.packed(surfels, brightness))

    @staticmethod
    def packed(
        surfels: NDArray[Any],
        brightness: Float32[NDArray[np.float32], " s"] | None = None,
        lattice_m: Float64[NDArray[np.float64], "3"] | None = None,
    ) -> tuple[PackedSurfels, Float16[NDArray[np.float16], " s"] | None]:
        """Pack the surfels of a map: the first half of ``prepare``. The second half does not need them any more.

        Args:
            surfels: as of ``prepare``.
            brightness: as of ``prepare``.
            lattice_m: as of ``kernel.packed_surfels``, m.

        Returns:
            The packed surfels, and their intensities as a map holds them (S,).
        """
        found, order = packed_surfels(surfels, cell_m=CELL_M, reach_m=REACH_M, lattice_m=lattice_m)
        if brightness is None:
            return found, None
        half = np.minimum(brightness[order], np.finfo(_BRIGHT).max).astype(_BRIGHT)
        return found, half if (half > 0).any() else None

    @classmethod
    def of_packed(
        cls,
        origin_m: Float64[NDArray[np.float64], "3"],
        packed: PackedSurfels,
        brightness: Float16[NDArray[np.float16], " s"] | None,
        has_cells: ChooseRegions | None = None,
    ) -> "SurfelMap":
        """Build the lookup grid of packed surfels: the second half of ``prepare``.

        Args:
            origin_m: origin of the surfels' frame, map frame, m.
            packed: the surfels.
            brightness: their intensities; None if the map has none.
            has_cells: as of ``kernel.nearest_grid``.
        """
        return cls(origin_m, packed.surfels, nearest_grid(packed, has_cells), brightness)

    def unpacked(self, rows: NDArray[np.integer[Any]] | slice) -> NDArray[Any]:
        """Return surfels as numbers: (n,) of ``SURFEL``, in the surfels' frame.

        Args:
            rows: rows in ``surfels`` (n,), or a slice of them.
        """
        if isinstance(rows, slice):
            rows = np.arange(*rows.indices(len(self.surfels)))
        return self.grid.unpacked(self.surfels, rows)

    def brightness_of(self, rows: NDArray[np.integer[Any]]) -> Float32[NDArray[np.float32], " *n"] | None:
        """Return the intensities of some surfels in the sensor's unit, NaN where unknown; None if the map has none.

        Args:
            rows: rows in ``surfels``, (n,) or of another shape, which the result has too.
        """
        return None if self.brightness is None else self.brightness[rows].astype(np.float32)

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
        tolerance_m: float = TOLERANCE_M,
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
        align(self.pieces, points, states, options, tolerance_m=tolerance_m, height_min_m=height_min_m)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays to write, by name; ``from_arrays`` reads them again.

        Returns:
            origin (3,), surfels (S,), grid_frame (4,), grid_slots (H,), grid_regions (R,), grid_blocks (B,), grid_cells (F,),
            grid_others (E,). A map with intensities also has brightness (S,). ``grid_frame`` holds the grid's origin and the edge
            of its cells, m.
        """
        arrays = {
            "origin": self.origin_m,
            "surfels": self.surfels,
            "grid_frame": np.array([*self.grid.origin_m, self.grid.cell_m]),
            "grid_slots": self.grid.slots,
            "grid_regions": self.grid.regions,
            "grid_blocks": self.grid.blocks,
            "grid_cells": self.grid.cells,
            "grid_others": self.grid.others,
        }
        return arrays if self.brightness is None else arrays | {BRIGHTNESS: self.brightness}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], *, verify: bool = True) -> "SurfelMap":
        """Assemble a map from arrays that were read or memory-mapped.

        Args:
            arrays: arrays by name, as ``arrays`` returns them: origin (3,), surfels (S,), grid_frame (4,), grid_slots (H,),
                grid_regions (R,), grid_blocks (B,), grid_cells (F,), grid_others (E,) and, if the map has intensities, brightness (S,).
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
        if not (np.abs(frame[:3]) <= MOST_AWAY_M).all() or not 0 < frame[3] <= LARGEST_CELL_M:
            raise _defect(
                "grid_frame",
                f"the corner is not within {MOST_AWAY_M:g} m, or the edge of a cell not between 0 and {LARGEST_CELL_M:g} m",
            )
        parts = ("slots", "regions", "blocks", "cells", "others")
        grid = NearestGrid(frame[:3], float(frame[3]), *(arrays[f"grid_{name}"] for name in parts))
        found = cls(np.array(arrays["origin"]), arrays["surfels"], grid, brightness)
        if verify:
            found.require_consistent()
        return found

    def require_consistent(self) -> None:
        """Check that all indices refer to existing entries and that all numbers make sense.

        Raises:
            BundleError: an index refers outside its array, or a number is not finite or otherwise invalid. The error names the array.
        """
        if not len(self.surfels):
            raise _defect("surfels", "there is none")
        _require_levels(self.grid)
        _require_surfels(self.grid, len(self.surfels))
        if not (np.abs(self.origin_m) <= MOST_AWAY_M).all():
            raise _defect("origin", f"a coordinate is not within {MOST_AWAY_M:g} m")
        if self.brightness is not None and (np.isinf(self.brightness).any() or (self.brightness < 0).any()):
            raise _defect(BRIGHTNESS, "a brightness is negative or infinite")


def _require_levels(grid: NearestGrid) -> None:
    """Check that every region is in the hash table once, and that its blocks are in ``blocks``."""
    slots, regions, blocks = grid.slots, grid.regions, grid.blocks
    if len(slots) < 2 or len(slots) & (len(slots) - 1) or len(slots) <= len(regions):
        raise _defect(
            "grid_slots", f"{len(slots)} slots for {len(regions)} regions instead of a power of two above their number"
        )
    _require_indices("grid_slots", slots, len(regions), least=-1)
    if not np.array_equal(np.sort(slots[slots >= 0]), np.arange(len(regions))):
        raise _defect("grid_slots", "a region is missing or occurs twice")
    found = np.cumsum(np.bitwise_count(regions["has"]), axis=1, dtype=np.int64)
    if (regions["before"][:, 0] != 0).any() or (regions["before"][:, 1:] != found[:, :-1]).any():
        raise _defect("grid_regions", "a number of blocks is wrong")
    _require_shares("grid_regions", "blocks", regions["block"], found[:, -1], len(blocks))


def _require_surfels(grid: NearestGrid, count: int) -> None:
    """Check that the regions share out all surfels, and that every cell refers to one that its region numbers."""
    regions = grid.regions
    _require_shares("grid_regions", "surfels", regions["surfel"], regions["surfels"], count)
    _require_shares("grid_regions", "entries of grid_others", regions["other"], regions["others"], len(grid.others))
    _require_indices("grid_others", grid.others, count, least=0)
    if (defect := grid.cells_defect()) is not None:
        array, what = defect
        raise _defect(f"grid_{array}", what)


def _require_shares(name: str, what: str, first: NDArray[Any], count: NDArray[Any], whole: int) -> None:
    """Check that ranges of rows follow each other without gaps, from 0 to the last one."""
    ends = np.cumsum(count, dtype=np.int64)
    if (first != ends - count).any() or (int(ends[-1]) if len(ends) else 0) != whole:
        raise _defect(name, f"the {whole} {what} are not shared out one after the other")


def _require_indices(name: str, indices: NDArray[np.int32], count: int, *, least: int) -> None:
    if indices.size and (int(indices.min()) < least or int(indices.max()) >= count):
        raise _defect(name, f"an index is outside the {count} entries")


def _defect(name: str, what: str) -> BundleError:
    return BundleError(f"cloud/{name}.npy: {what}; copy or build the bundle again", field=f"cloud/{name}.npy")
