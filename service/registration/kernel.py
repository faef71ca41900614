"""Call the compiled registration kernel (``kernel.c``) through ctypes.

The library uses no Python API, so one build serves every Python version. The global interpreter lock is released while it runs.

Speed: a solver step takes a sixth of the time of NumPy over all starts at once (26 November 2026, decision 0148).
"""

import ctypes
from collections.abc import Callable, Iterator
from ctypes import POINTER, Structure, byref, c_double, c_int64, c_void_p
from dataclasses import astuple, dataclass, field, fields
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, UInt8, UInt32
from numpy.typing import NDArray

from service.compiled import load
from service.errors import StreetfixError
from service.geometry.camera import PinholeCamera

#: Unknowns of the solver: translation (3), rotation (3), log scale, disparity offset.
UNKNOWNS = 8
#: Cells along the edge of a block of the lookup grid. A block has 2 x 2 x 2 parts of 4 x 4 x 4 cells.
BLOCK = 8
#: Blocks along the edge of a region of the lookup grid.
REGION = 8
#: Bits of a region's number along each axis, in its key.
KEY_BITS = 18
#: Bits of a block's number in its region, and of the number of filled cells before a part.
NUMBER_BITS = 9
#: Most surfels that a region numbers: the cells of a wide block have three bytes.
_MOST_NUMBERED = 1 << 24
#: Surfels that are assigned to regions at once. Each takes some hundred bytes meanwhile.
_CHUNK = 1 << 16
#: Points in a batch of the kernel. Arrays of points are padded to whole batches.
BATCH_SIZE = 32
#: Standard deviation of a point's distance to its surface in the score of a pose, m, apart from its noise.
TOLERANCE_M = 0.1
LIBRARY = Path(__file__).with_name("_kernel.so")

#: A surfel: position (m, surfels' frame), unit normal, thickness across the surface (m), number of survey points.
SURFEL = np.dtype([("xyz", "<f4", (3,)), ("normal", "<f4", (3,)), ("thickness_m", "<f4"), ("points", "<u4")])
#: A surfel as a map holds it (``NearestGrid.unpacked``). xyz: position from the corner of its region, ``STEPS`` along the edge of a cell.
#: normal: octahedral map of the unit vector (Meyer et al., Eurographics Symposium on Rendering 2010), two signed numbers of 12 bits.
#: The first is in the lower bits. thickness, points: codes.
PACKED_SURFEL = np.dtype([("xyz", "<u2", (3,)), ("normal", "u1", (3,)), ("thickness", "u1"), ("points", "u1")])
#: Steps of a packed position along the edge of a cell.
STEPS = 1024
#: The surfels of a region: its corner (surfels' frame, m), row of the first, number.
CUBE = np.dtype([("corner", "<f8", (3,)), ("first", "<i8"), ("count", "<i8")])
#: A block of the lookup grid with at least one filled cell. A filled cell has a surfel in reach of its centre.
#: filled: 64 bits for each part, bit (x * 4 + y) * 4 + z for a cell. before: number of filled cells before parts 1 to 7, 9 bits each; its
#: uppermost bit is set for a wide block. first: byte of its first filled cell in ``NearestGrid.cells``, counted from ``cells`` of its
#: region. own: number of its own surfels (lower 8 bits), and the first one, counted from ``surfel`` of its region (24 bits); 0 for wide.
GRID_BLOCK = np.dtype([("filled", "<u8", (8,)), ("before", "<u8"), ("first", "<u4"), ("own", "<u4")])
#: A region with at least one block or surfel. key: its numbers along x, y and z, 18 bits each, x first. block, surfel, other: rows of its
#: first block in ``NearestGrid.blocks``, of its first surfel, and of its first entry in ``NearestGrid.others``. cells: its first byte in
#: ``NearestGrid.cells``. surfels, others: numbers of its surfels and of its entries in ``others``. has: a bit for the number
#: (x * 8 + y) * 8 + z of each block that has filled cells. before: number of such blocks before each 64 bits.
GRID_REGION = np.dtype(
    [("key", "<i8"), ("block", "<i8"), ("surfel", "<i8"), ("other", "<i8"), ("cells", "<i8"), ("surfels", "<u4"), ("others", "<u4"),
     ("has", "<u8", (REGION**3 // 64,)), ("before", "<u2", (REGION**3 // 64,))]
)  # fmt: skip
#: State of one start: pose of the level frame, scale, offset, centre and up axis of the priors, information, score, and how the
#: solver ended.
STATE = np.dtype(
    [("R", "<f8", (3, 3)), ("t", "<f8", (3,)), ("log_scale", "<f8"), ("offset", "<f8"), ("anchor", "<f8", (3,)), ("up", "<f8", (3,)),
     ("information", "<f8", (UNKNOWNS, UNKNOWNS)),
     ("inliers", "<f8"), ("matched", "<f8"), ("weight", "<f8"),
     ("iterations", "<f8"), ("converged", "<f8"), ("error", "<f8")]
)  # fmt: skip


class _Piece(Structure):
    _fields_ = [
        ("slot_bits", c_int64),
        *((name, c_void_p) for name in ("slots", "regions", "blocks", "cells", "others", "surfels", "served")),
        ("shift", c_int64 * 3),
        ("first", c_int64),
    ]


class _Grid(Structure):
    _fields_ = [
        *((name, c_double) for name in ("ox", "oy", "oz", "cell")),
        ("count", c_int64),
        ("pieces", POINTER(_Piece)),
    ]


class _Query(Structure):
    _fields_ = [
        ("count", c_int64),
        ("xyz", c_void_p * 3),
        ("ray", c_void_p * 3),
        *((name, c_void_p) for name in ("sigma", "weight", "q")),
    ]


class _Options(Structure):
    _fields_ = [("iterations", c_int64), *((name, c_double) for name in (
        "reach", "robust_first", "robust_last", "surface", "prior_weight", "tilt", "height", "position", "scale", "offset",
        "free_scale", "free_offset"))]  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamModel:
    """Mixture model of a measured depth, given the mapped depth of its pixel.

    Thrun, Burgard and Fox, Probabilistic Robotics, 2005, section 6.3.

    Attributes:
        hit: weight of rays that end on the mapped surface (normal distribution).
        new: weight of rays that end before it, on a new object (uniform from the camera to the surface).
        removed: weight of rays that end behind it, because an object is gone (uniform over ``span_m``).
        outlier: weight of outliers at any depth (uniform over ``span_m``).
        roughness_m: standard deviation of the surfaces' roughness, m.
        span_m: length over which ``removed`` and ``outlier`` are uniform, m.
        threshold_sigmas: a point is off the surface beyond ``threshold_sigmas`` x its standard deviation + ``margin_m``.
        margin_m: constant part of that threshold, m.
        unmapped_m: depth assumed for pixels where the map shows no surface, m.
    """

    hit: float
    new: float
    removed: float
    outlier: float
    roughness_m: float
    span_m: float
    threshold_sigmas: float
    margin_m: float
    unmapped_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SolverOptions:
    """Options of one run of the solver. Names as in ``kernel.c``.

    Attributes:
        iterations: Gauss-Newton steps; 0 only scores.
        reach: largest distance between a point and its surfel, m.
        robust_first: width of the robust kernel in the first iteration, m.
        robust_last: width in the last iteration, m. The width falls geometrically in between.
        surface: roughness of all surfaces, m.
        prior_weight: information of the priors, as a share of the summed weight of all points.
        tilt: standard deviation of the prior of roll and pitch, rad.
        height: standard deviation of the prior of height, m.
        position: standard deviation of the prior of position along the ground, m.
        scale: standard deviation of the prior of the log scale.
        offset: standard deviation of the prior of the disparity offset, px.
        free_scale: estimate the scale; otherwise it stays at its start.
        free_offset: estimate the disparity offset; otherwise it stays at its start.
    """

    iterations: int
    reach: float
    robust_first: float
    robust_last: float
    surface: float = 0.03
    prior_weight: float = 0.01
    tilt: float = float(np.deg2rad(1.0))
    height: float = 0.15
    position: float = 30.0
    scale: float = 0.01
    offset: float = 0.3
    free_scale: bool = True
    free_offset: bool = False


class _Beam(Structure):
    _fields_ = [(name, c_double) for name in (*(field.name for field in fields(BeamModel)), "scale", "offset")]


@cache
def _library() -> ctypes.CDLL:
    library = load(
        LIBRARY,
        {
            "Surfel": SURFEL,
            "PackedSurfel": PACKED_SURFEL,
            "Cube": CUBE,
            "Block": GRID_BLOCK,
            "Region": GRID_REGION,
            "Piece": _Piece,
            "Grid": _Grid,
            "Query": _Query,
            "Options": _Options,
            "State": STATE,
            "Beam": _Beam,
        },
        {
            "UNKNOWNS": UNKNOWNS,
            "BLOCK": BLOCK,
            "KEY_BITS": KEY_BITS,
            "NUMBER_BITS": NUMBER_BITS,
            "REGION": REGION,
            "STEPS": STEPS,
            "BATCH_SIZE": BATCH_SIZE,
        },
    )
    library.streetfix_align.argtypes = [
        POINTER(_Grid),
        POINTER(_Query),
        POINTER(_Options),
        c_double,
        c_double,
        c_int64,
        c_void_p,
    ]
    library.streetfix_gradients.argtypes = [
        POINTER(_Grid),
        POINTER(_Query),
        POINTER(_Options),
        c_void_p,
        c_void_p,
        c_void_p,
    ]
    library.streetfix_consistency.argtypes = [
        c_void_p, c_int64, c_int64, c_int64, c_void_p, c_void_p, c_void_p, c_void_p, POINTER(_Beam), c_void_p,
    ]  # fmt: skip
    library.streetfix_lookup.argtypes = [POINTER(_Grid), c_void_p, c_int64, c_void_p]
    library.streetfix_build_region.argtypes = [
        POINTER(_Grid), c_void_p, c_void_p, c_int64, c_double, c_void_p, c_void_p, c_void_p, c_void_p, c_void_p,
    ]  # fmt: skip
    library.streetfix_build_region.restype = c_int64
    library.streetfix_pack_cells.argtypes = [c_void_p, c_void_p, c_void_p, c_void_p, c_void_p, c_void_p]
    library.streetfix_pack_cells.restype = c_int64
    library.streetfix_check_cells.argtypes = [c_void_p, c_int64, c_void_p, c_void_p, c_int64]
    library.streetfix_check_cells.restype = c_int64
    library.streetfix_fill_slots.argtypes = [c_void_p, c_int64, c_int64, c_void_p]
    library.streetfix_keys.argtypes = [POINTER(_Grid), c_void_p, c_int64, c_void_p]
    library.streetfix_pack.argtypes = [POINTER(_Grid), c_void_p, c_void_p, c_int64, c_void_p]
    library.streetfix_unpack.argtypes = [c_double, c_void_p, c_int64, c_void_p, c_void_p, c_int64, c_void_p]
    library.streetfix_render.argtypes = [
        c_void_p, c_void_p, c_int64, c_double, c_void_p, c_void_p, c_double, c_double, c_double, c_double, c_int64, c_int64,
        c_double, c_double, c_void_p,
    ]  # fmt: skip
    for name in (
        "streetfix_align",
        "streetfix_gradients",
        "streetfix_lookup",
        "streetfix_fill_slots",
        "streetfix_keys",
        "streetfix_pack",
        "streetfix_unpack",
        "streetfix_render",
    ):
        getattr(library, name).restype = None
    return library


def numbers_of_regions(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the numbers of regions along x, y and z from the corner of their grid (n, 3).

    Args:
        keys: keys of the regions (n,).
    """
    return np.stack([keys >> 2 * KEY_BITS, keys >> KEY_BITS, keys], axis=1) & ((1 << KEY_BITS) - 1)


#: What ``streetfix_check_cells`` finds: an array and what is wrong with it.
_CELLS_DEFECTS = (
    None,
    ("blocks", "a number of filled cells is wrong"),
    ("blocks", "a first cell does not follow the cells of the block before"),
    ("regions", "the bytes of the cells are not shared out one after the other"),
    ("cells", "its length is not what the blocks need"),
    ("blocks", "the surfels of a block are outside those of its region"),
    ("cells", "a number is outside the surfels of its block or region"),
)


@dataclass(frozen=True, slots=True, eq=False)
class NearestGrid:
    """Lookup grid of the surfel nearest to each cell's centre; may be memory-mapped.

    It has three levels: regions of 8 x 8 x 8 blocks of 8 x 8 x 8 cells. Regions, blocks and cells without a surfel in reach take no
    memory. So the size follows the mapped surfaces, not the box around them. The surfels of a map are sorted by region and block.

    Attributes:
        origin_m: corner of the grid in the surfels' frame, m.
        cell_m: edge of a cell, m.
        slots: hash table with linear probing: row of a region in ``regions``, -1 for none. Its length is a power of two, at least twice
            the number of regions.
        regions: (R,) of ``GRID_REGION``, ascending by key.
        blocks: (B,) of ``GRID_BLOCK``, region by region.
        cells: the surfel nearest to each filled cell (F,). Of a narrow block: the numbers of its foreign surfels in the region, the last
            first, two bytes each; then a byte for each filled cell, part by part, in the order of the bits. A byte below the number of the
            block's own surfels is one of them, a larger one is a foreign surfel. Of a wide block: three bytes for each filled cell, the
            number in the region. A region numbers its own surfels first, then those of its entries in ``others``.
        others: rows of surfels of other regions (E,), region by region.
        cubes: (R,) of ``CUBE``; computed.
    """

    origin_m: Float64[NDArray[np.float64], "3"]
    cell_m: float
    slots: Int32[NDArray[np.int32], " H"]
    regions: NDArray[Any]
    blocks: NDArray[Any]
    cells: UInt8[NDArray[np.uint8], " F"]
    others: Int32[NDArray[np.int32], " E"]
    cubes: NDArray[Any] = field(init=False)

    def __post_init__(self) -> None:
        cubes = np.empty(len(self.regions), CUBE)
        cubes["corner"] = self.origin_m + numbers_of_regions(self.regions["key"]) * self.region_m
        cubes["first"], cubes["count"] = self.regions["surfel"], self.regions["surfels"]
        object.__setattr__(self, "cubes", cubes)

    @property
    def region_m(self) -> float:
        """Edge of a region, m."""
        return REGION * BLOCK * self.cell_m

    def cells_defect(self) -> tuple[str, str] | None:
        """Return the array whose content is wrong and what is wrong with it; None if all cells refer to surfels that their regions number.

        The regions must share out the blocks. The library checks nothing when it looks a cell up.
        """
        found = _library().streetfix_check_cells(
            self.regions.ctypes.data,
            len(self.regions),
            self.blocks.ctypes.data,
            self.cells.ctypes.data,
            len(self.cells),
        )
        return _CELLS_DEFECTS[found]

    def unpacked(self, surfels: NDArray[Any], rows: NDArray[np.integer[Any]]) -> NDArray[Any]:
        """Return surfels as numbers: (n,) of ``SURFEL``.

        Args:
            surfels: of the map, (S,) of ``PACKED_SURFEL``.
            rows: rows in ``surfels`` (n,), fastest if ascending.

        Raises:
            IndexError: a row is outside the surfels. The library does not check it.
        """
        rows, found = np.ascontiguousarray(rows, np.int64), np.empty(len(rows), SURFEL)
        if len(rows) and not 0 <= int(rows.min()) <= int(rows.max()) < len(surfels):
            raise IndexError(f"a row is outside the {len(surfels)} surfels")
        _library().streetfix_unpack(
            self.cell_m,
            self.cubes.ctypes.data,
            len(self.cubes),
            surfels.ctypes.data,
            rows.ctypes.data,
            len(rows),
            found.ctypes.data,
        )
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """Surfels with their lookup grid: those of a map of one bundle, or those that a tile gives to the surroundings of a pose.

    The pieces of one cloud lie in a common frame. They have cells of one size, and the corners of their grids are whole regions apart.

    Attributes:
        grid: lookup grid of the surfels.
        surfels: (S,) of ``PACKED_SURFEL``, in their own frame.
        at_m: origin of that frame in the common frame, m.
        served: the regions of the grid that this piece gives to the cloud (R,). None gives all. Each region comes from one piece.
        cubes: the surfels of these regions, with corners in the common frame: (n,) of ``CUBE``; computed.
    """

    grid: NearestGrid
    surfels: NDArray[Any]
    at_m: Float64[NDArray[np.float64], "3"] = field(default_factory=lambda: np.zeros(3))
    served: Bool[NDArray[np.bool_], " R"] | None = None
    cubes: NDArray[Any] = field(init=False)

    def __post_init__(self) -> None:
        cubes = self.grid.cubes if self.served is None else self.grid.cubes[self.served]
        if self.at_m.any():
            cubes = cubes.copy()
            cubes["corner"] += self.at_m
        object.__setattr__(self, "cubes", cubes)

    @property
    def corner_m(self) -> Float64[NDArray[np.float64], "3"]:
        """Corner of the grid in the common frame, m."""
        return self.at_m + self.grid.origin_m


def surfels_at(
    pieces: tuple[Piece, ...], positions_m: Float64[NDArray[np.float64], "n 3"]
) -> Int32[NDArray[np.int32], " n"]:
    """Return the number of the surfel that the cell of each position refers to; -1 for none. The surfels of all pieces count.

    Args:
        pieces: of the cloud.
        positions_m: positions in the common frame, m.
    """
    positions_m = np.ascontiguousarray(positions_m, np.float64)
    found = np.empty(len(positions_m), np.int32)
    _library().streetfix_lookup(byref(_grid_of(pieces)), positions_m.ctypes.data, len(positions_m), found.ctypes.data)
    return found


def _grid_of(pieces: tuple[Piece, ...]) -> _Grid:
    """Return the grid of all pieces as ``kernel.c`` takes it. It refers to their arrays, so they must live as long."""
    corners = np.array([piece.corner_m for piece in pieces])
    corner, edge_m = corners.min(axis=0), pieces[0].grid.region_m
    shifts = np.rint((corners - corner) / edge_m).astype(np.int64)
    made, first = (_Piece * len(pieces))(), 0
    for one, piece, shift in zip(made, pieces, shifts, strict=True):
        grid = piece.grid
        one.slot_bits = len(grid.slots).bit_length() - 1
        for name in ("slots", "regions", "blocks", "cells", "others"):
            setattr(one, name, getattr(grid, name).ctypes.data)
        one.surfels = piece.surfels.ctypes.data
        one.served = None if piece.served is None else piece.served.ctypes.data
        one.shift, one.first = (c_int64 * 3)(*shift), first
        first += len(piece.surfels)
    return _Grid(*corner, pieces[0].grid.cell_m, len(pieces), made)


@dataclass(frozen=True, slots=True, eq=False)
class QueryPoints:
    """Points of a query in its level frame, the camera at the origin.

    Attributes:
        xyz: position, m.
        ray: unit vectors from the camera to the points.
        sigma: standard deviation along the ray, m.
        weight: factor of each point's information.
        q: depth / (focal length x baseline), 1/px; 0 for a camera without a disparity offset.
    """

    xyz: Float32[NDArray[np.float32], "n 3"]
    ray: Float32[NDArray[np.float32], "n 3"]
    sigma: Float32[NDArray[np.float32], " n"]
    weight: Float32[NDArray[np.float32], " n"]
    q: Float32[NDArray[np.float32], " n"]

    def __len__(self) -> int:
        return len(self.sigma)

    def with_least_weight(self, weight: float) -> "QueryPoints":
        """Raise smaller weights to a lower limit; all else stays.

        Args:
            weight: least weight of a point.
        """
        return QueryPoints(self.xyz, self.ray, self.sigma, np.maximum(self.weight, np.float32(weight)), self.q)

    def thinned(self, count: int) -> "QueryPoints":
        """Select points that are evenly spread over their order.

        Args:
            count: largest number of points.
        """
        return self.subset(np.linspace(0, len(self) - 1, min(count, len(self))).astype(np.intp))

    def subset(self, rows: NDArray[np.intp]) -> "QueryPoints":
        """Select points by their indices.

        Args:
            rows: indices of the points, of shape (m,).
        """
        return QueryPoints(*(np.ascontiguousarray(getattr(self, name)[rows]) for name in self.__slots__))


def align(
    pieces: tuple[Piece, ...],
    query: QueryPoints,
    states: NDArray[Any],
    options: SolverOptions,
    *,
    tolerance_m: float = TOLERANCE_M,
    height_min_m: float = -1e9,
) -> None:
    """Register every start on the map in place, then score it.

    The solver minimises weighted, robust point-to-plane distances (Gauss-Newton, Geman-McClure kernel).

    Args:
        pieces: of the map's cloud.
        query: points of the query.
        states: the starts, (n,) of ``STATE``, common frame of the pieces; overwritten with the results.
        options: of the solver; with 0 ``iterations`` the states are only scored.
        tolerance_m: standard deviation of a point's distance to its surface in the score, m, apart from its noise. 0: the results are
            not scored.
        height_min_m: points lower than this do not count in the score, m. Heights are relative to the camera, along the map's z axis.
    """
    points, given = _as_c(query, options)
    _library().streetfix_align(
        byref(_grid_of(pieces)),
        byref(points),
        byref(given),
        tolerance_m,
        height_min_m,
        len(states),
        states.ctypes.data,
    )


def gradients(
    pieces: tuple[Piece, ...],
    query: QueryPoints,
    state: NDArray[Any],
    options: SolverOptions,
    patch: Int32[NDArray[np.int32], " n"],
) -> Float64[NDArray[np.float64], "B 8"]:
    """Sum the gradients of each patch's points at a pose: weight x residual x derivative by the eight unknowns.

    Args:
        pieces: of the map's cloud.
        query: points of the query.
        state: the pose, (1,) of ``STATE``, common frame of the pieces.
        options: of the solver. The robust kernel has the width of the last iteration.
        patch: number of each point's patch, counted from 0 without gaps.
    """
    found = np.zeros((int(patch.max(initial=-1)) + 1, UNKNOWNS))
    points, given = _as_c(query, options)
    _library().streetfix_gradients(
        byref(_grid_of(pieces)),
        byref(points),
        byref(given),
        state.ctypes.data,
        patch.ctypes.data,
        found.ctypes.data,
    )
    return found


def _as_c(query: QueryPoints, options: SolverOptions) -> tuple[_Query, _Options]:
    given = _Options(**{field[0]: getattr(options, field[0]) for field in _Options._fields_})
    planes = np.zeros((9, -(-len(query) // BATCH_SIZE) * BATCH_SIZE), np.float32)
    for rows, values in (
        (slice(0, 3), query.xyz.T),
        (slice(3, 6), query.ray.T),
        (6, query.sigma),
        (7, query.weight),
        (8, query.q),
    ):
        planes[rows, : len(query)] = values
    first = planes.ctypes.data
    at = [first + number * planes.strides[0] for number in range(len(planes))]
    points = _Query(len(query), (c_void_p * 3)(*at[:3]), (c_void_p * 3)(*at[3:6]), *at[6:])
    points.planes = planes  # keeps the memory alive as long as the pointers to it
    return points, given


@dataclass(frozen=True, slots=True, eq=False)
class PackedSurfels:
    """The surfels of a map, and what their lookup grid is built from.

    Attributes:
        surfels: (S,) of ``PACKED_SURFEL``, sorted by region and block.
        regions: (R,) of ``GRID_REGION``, ascending by key. Of the regions with surfels they have the key and the surfels.
        origin_m: corner of the grid in the surfels' frame, m.
        cell_m: edge of a cell, m.
        reach_m: largest distance from a surfel to the centre of a cell that refers to it, m.
    """

    surfels: NDArray[Any]
    regions: NDArray[Any]
    origin_m: Float64[NDArray[np.float64], "3"]
    cell_m: float
    reach_m: float


def packed_map(
    surfels: NDArray[Any], *, cell_m: float, reach_m: float
) -> tuple[NearestGrid, NDArray[Any], NDArray[np.int64]]:
    """Pack the surfels of a map and build their lookup grid, once per map build.

    A large map has no room for both forms of the surfels. It packs them, frees them and then builds the grid (``packed_surfels``,
    ``nearest_grid``).

    Args:
        surfels: of the map, (S,) of ``SURFEL``, in any order.
        cell_m: edge of a cell, m.
        reach_m: largest distance from a surfel to the centre of a cell that refers to it, m.

    Returns:
        The grid, the surfels (S,) of ``PACKED_SURFEL`` sorted by region and block, and their rows in ``surfels`` (S,).

    Raises:
        StreetfixError: the surfels lie too far from each other for the numbers of the regions, or a number is not finite.
    """
    packed, order = packed_surfels(surfels, cell_m=cell_m, reach_m=reach_m)
    return nearest_grid(packed), packed.surfels, order


def packed_surfels(
    surfels: NDArray[Any],
    *,
    cell_m: float,
    reach_m: float,
    lattice_m: Float64[NDArray[np.float64], "3"] | None = None,
) -> tuple[PackedSurfels, NDArray[np.int64]]:
    """Pack the surfels of a map.

    Args:
        surfels: of the map, (S,) of ``SURFEL``, in any order.
        cell_m: edge of a cell of their lookup grid, m.
        reach_m: largest distance from a surfel to the centre of a cell that refers to it, m.
        lattice_m: a position in the surfels' frame, m. The corner of the grid lies whole regions away from it, so that grids with one
            lattice fit together. None puts the corner just below the surfels.

    Returns:
        The packed surfels, and their rows in ``surfels`` (S,).

    Raises:
        StreetfixError: the surfels lie too far from each other for the numbers of the regions, or a number is not finite.
    """
    surfels = np.ascontiguousarray(surfels, SURFEL)
    for name in ("xyz", "normal", "thickness_m"):
        if not np.isfinite(surfels[name]).all():
            raise StreetfixError(f"surfels: a number of {name} is not finite; remove the points that cause it")
    low, high = surfels["xyz"].min(axis=0).astype(np.float64), surfels["xyz"].max(axis=0).astype(np.float64)
    origin = low - reach_m - 2 * cell_m
    if lattice_m is not None:
        region_m = REGION * BLOCK * cell_m
        origin = lattice_m + np.floor((origin - lattice_m) / region_m) * region_m
    extent_m, most_m = float((high + reach_m - origin).max()), (1 << KEY_BITS) * REGION * BLOCK * cell_m
    if not extent_m < most_m:
        raise StreetfixError(
            f"the cloud extends over {extent_m / 1000:,.0f} km, but a lookup grid with cells of {cell_m:g} m reaches "
            f"{most_m / 1000:,.0f} km; build a map of each area"
        )
    frame, keys = _Grid(*origin, cell_m), np.empty(len(surfels), np.int64)
    _library().streetfix_keys(byref(frame), surfels.ctypes.data, len(surfels), keys.ctypes.data)
    order = np.argsort(keys, kind="stable")
    keys = keys[order] >> NUMBER_BITS
    first = np.flatnonzero(np.r_[True, keys[1:] != keys[:-1]])
    own = np.zeros(len(first), GRID_REGION)
    own["key"], own["surfel"], own["surfels"] = keys[first], first, np.diff(np.r_[first, len(keys)])
    del keys  # a large map has no room for it beside the packed surfels
    packed = np.empty(len(surfels), PACKED_SURFEL)
    _library().streetfix_pack(byref(frame), surfels.ctypes.data, order.ctypes.data, len(surfels), packed.ctypes.data)
    return PackedSurfels(packed, own, origin, cell_m, reach_m), order


#: Chooses regions by their centres, m: (n, 3) to (n,).
ChooseRegions = Callable[[Float64[NDArray[np.float64], "n 3"]], Bool[NDArray[np.bool_], " n"]]


def nearest_grid(packed: PackedSurfels, has_cells: ChooseRegions | None = None) -> NearestGrid:
    """Build the lookup grid of the surfels of a map.

    It is built region by region. The memory grows with the number of surfels, not with the distances between them.

    Args:
        packed: the surfels.
        has_cells: chooses the regions that get cells, by their centres in the surfels' frame. The surfels of other regions only serve the
            cells of these. None gives all regions cells.
    """
    origin, cell_m = packed.origin_m, packed.cell_m
    xyz = _positions(_without_cells(origin, cell_m, packed.regions), packed.surfels)
    regions, blocks, cells, others = [], [np.zeros(0, GRID_BLOCK)], [np.zeros(0, np.uint8)], [np.zeros(0, np.int32)]
    first_block = first_byte = first_other = 0
    for region, some, rows in _regions(xyz, packed.regions, origin, cell_m, packed.reach_m, has_cells):
        numbers, foreign = _numbered(rows, region)
        region["block"], region["cells"], region["other"] = first_block, first_byte, first_other
        region["others"] = len(foreign)
        entries = _packed_cells(region, some, numbers, packed.surfels)
        first_block, first_byte = first_block + len(some), first_byte + len(entries)
        first_other += len(foreign)
        regions.append(region)
        blocks.append(some)
        cells.append(entries)
        others.append(foreign)
    whole = np.concatenate(regions)
    slot_bits = max(1, (2 * len(whole) - 1).bit_length())
    slots = np.full(1 << slot_bits, -1, np.int32)
    _library().streetfix_fill_slots(whole.ctypes.data, len(whole), slot_bits, slots.ctypes.data)
    return NearestGrid(
        origin, cell_m, slots, whole, np.concatenate(blocks), np.concatenate(cells), np.concatenate(others)
    )


def _numbered(
    rows: Int32[NDArray[np.int32], " f"], region: NDArray[Any]
) -> tuple[UInt32[NDArray[np.uint32], " f"], Int32[NDArray[np.int32], " e"]]:
    """Return the rows of surfels as numbers of a region (f,), and the rows of other regions (e,).

    Raises:
        StreetfixError: the region numbers more surfels than a cell can refer to.
    """
    own = int(region["surfels"][0])
    numbers = rows.astype(np.int64) - region["surfel"]
    outside = (numbers < 0) | (numbers >= own)
    foreign, place = np.unique(rows[outside], return_inverse=True)
    if own + len(foreign) > _MOST_NUMBERED:
        raise StreetfixError(
            f"a region of the lookup grid (64 cells along its edge) refers to {own + len(foreign):,} surfels, at most {_MOST_NUMBERED:,}; "
            "build the map with larger voxels (--voxel)"
        )
    numbers[outside] = own + place
    return numbers.astype(np.uint32), foreign


def _packed_cells(
    region: NDArray[Any], blocks: NDArray[Any], numbers: UInt32[NDArray[np.uint32], " f"], surfels: NDArray[Any]
) -> UInt8[NDArray[np.uint8], " b"]:
    """Return the bytes of the filled cells of a region, and complete its blocks in place.

    Args:
        region: the region (1,).
        blocks: its blocks, whose ``first`` counts from the first filled cell of the region.
        numbers: number of each filled cell's surfel in the region.
        surfels: of the map, (S,) of ``PACKED_SURFEL``.
    """
    first, count = int(region["surfel"][0]), int(region["surfels"][0])
    of_block = (surfels["xyz"][first : first + count] // (BLOCK * STEPS)) @ np.array([REGION * REGION, REGION, 1])
    starts = np.searchsorted(of_block, np.arange(REGION**3 + 1)).astype(np.uint32)
    place = np.full(count + int(region["others"][0]), -1, np.int32)
    cells = np.empty(3 * len(numbers) + 512 * len(blocks), np.uint8)  # the most that the library may write
    size = _library().streetfix_pack_cells(
        region.ctypes.data,
        blocks.ctypes.data,
        starts.ctypes.data,
        numbers.ctypes.data,
        place.ctypes.data,
        cells.ctypes.data,
    )
    return cells[:size].copy()


def _without_cells(origin_m: Float64[NDArray[np.float64], "3"], cell_m: float, regions: NDArray[Any]) -> NearestGrid:
    """Return a grid that has only its regions. It can unpack surfels."""
    none = np.zeros(0, np.int32)
    return NearestGrid(origin_m, cell_m, none, regions, np.zeros(0, GRID_BLOCK), np.zeros(0, np.uint8), none)


def _positions(grid: NearestGrid, surfels: NDArray[Any]) -> Float32[NDArray[np.float32], "S 3"]:
    """Return the positions of all surfels in the surfels' frame, m."""
    xyz = np.empty((len(surfels), 3), np.float32)
    for first in range(0, len(surfels), _CHUNK):
        rows = np.arange(first, min(first + _CHUNK, len(surfels)))
        xyz[rows] = grid.unpacked(surfels, rows)["xyz"]
    return xyz


def _regions(
    xyz: Float32[NDArray[np.float32], "S 3"],
    own: NDArray[Any],
    origin_m: Float64[NDArray[np.float64], "3"],
    cell_m: float,
    reach_m: float,
    has_cells: ChooseRegions | None,
) -> Iterator[tuple[NDArray[Any], NDArray[Any], Int32[NDArray[np.int32], " f"]]]:
    """Yield the regions, ascending by key: the region (1,), its blocks, and the rows of the surfels of their filled cells.

    ``own`` has the regions with surfels, with their surfels. The field ``first`` of a block counts from the region's first filled cell.
    """
    frame = _Grid(*origin_m, cell_m)
    edge = REGION * BLOCK
    touched, starts, which = _touched(xyz, origin_m, edge * cell_m, reach_m)
    keys = np.union1d(touched, own["key"])
    reached = np.searchsorted(touched, keys), np.searchsorted(touched, keys, side="right")
    if has_cells is not None:  # no surfel reaches a region without cells
        without = ~has_cells(origin_m + (numbers_of_regions(keys) + 0.5) * (edge * cell_m))
        reached[1][without] = reached[0][without]
    first_own = np.searchsorted(own["key"], keys)
    surfel_of, distance2 = np.empty(edge**3, np.int32), np.empty(edge**3, np.float32)
    blocks, nearest = np.empty(REGION**3, GRID_BLOCK), np.empty(edge**3, np.int32)
    for key, low, high, row in zip(keys, *reached, first_own, strict=True):
        region, some = np.zeros(1, GRID_REGION), which[starts[low] : starts[high]]
        region["key"] = key
        region["surfel"] = own["surfel"][row] if row < len(own) else len(xyz)
        if row < len(own) and own["key"][row] == key:
            region["surfels"] = own["surfels"][row]
        count = _library().streetfix_build_region(
            byref(frame),
            xyz.ctypes.data,
            some.ctypes.data,
            len(some),
            reach_m,
            surfel_of.ctypes.data,
            distance2.ctypes.data,
            region.ctypes.data,
            blocks.ctypes.data,
            nearest.ctypes.data,
        )
        if (
            count or region["surfels"][0]
        ):  # the reach of a surfel may touch a region without reaching the centre of a cell
            cells = int(np.bitwise_count(blocks["filled"][:count]).sum())
            yield region, blocks[:count].copy(), nearest[:cells].copy()


def _touched(
    positions: Float32[NDArray[np.float32], "S 3"],
    origin_m: Float64[NDArray[np.float64], "3"],
    region_m: float,
    reach_m: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64], Int32[NDArray[np.int32], " p"]]:
    """Return the surfels whose reach touches each region: keys of regions (R,), ascending; first entry of each (R + 1,); indices (p,).

    The surfels of a region are ascending. So the first of two equally near surfels counts, wherever regions begin.
    """

    def pairs_of(first: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        xyz = positions[first : first + _CHUNK].astype(np.float64) - origin_m
        # Axis by axis: NumPy is slow along an axis of three.
        low, high = (np.floor((xyz.T + sign * reach_m) / region_m).astype(np.int64) for sign in (-1, 1))
        extent, keys, numbers = high - low, [], []
        for step in product(*(range(int(most) + 1) for most in extent.max(axis=1))):
            reached = np.ones(len(xyz), np.bool_)
            for axis, further in enumerate(step):
                if further:
                    reached &= extent[axis] >= further
            inside = np.flatnonzero(reached)
            x, y, z = (each[inside] + further for each, further in zip(low, step, strict=True))
            keys.append((x << 2 * KEY_BITS) + (y << KEY_BITS) + z)
            numbers.append(inside + first)
        return np.concatenate(keys), np.concatenate(numbers)

    # A pair is one number of 64 bits: the row of the region, then the surfel. So the pairs are sorted in place. The first round finds the
    # regions and counts the pairs.
    regions, count = np.zeros(0, np.int64), 0
    for first in range(0, len(positions), _CHUNK):
        keys, _ = pairs_of(first)
        regions, count = np.union1d(regions, keys), count + len(keys)
    pairs, filled = np.empty(count, np.int64), 0
    for first in range(0, len(positions), _CHUNK):
        keys, numbers = pairs_of(first)
        pairs[filled : filled + len(keys)] = (np.searchsorted(regions, keys) << 32) + numbers
        filled += len(keys)
    pairs.sort()
    starts = np.searchsorted(pairs, np.arange(len(regions) + 1) << 32)
    return regions, starts, pairs.astype(np.int32)  # the lower half


def render(
    pieces: tuple[Piece, ...],
    *,
    T_map_camera: Float64[NDArray[np.float64], "4 4"],
    camera: PinholeCamera,
    size_m: float,
    reach_m: float,
) -> Float32[NDArray[np.float32], "H W"]:
    """Render the depth image that a camera would see of the surfels: z in metres, 0 where nothing is mapped.

    Args:
        pieces: of the map's cloud.
        T_map_camera: pose of the camera in the common frame of the pieces.
        camera: intrinsics of the rendered image, a small one.
        size_m: edge of the square that represents a surfel, m.
        reach_m: surfels beyond this depth are not rendered, m.
    """
    depth = np.full((camera.height, camera.width), 1e9, np.float32)
    R, t = np.ascontiguousarray(T_map_camera[:3, :3]), np.ascontiguousarray(T_map_camera[:3, 3])
    for piece in pieces:
        _library().streetfix_render(
            piece.surfels.ctypes.data,
            piece.cubes.ctypes.data,
            len(piece.cubes),
            piece.grid.cell_m,
            R.ctypes.data,
            t.ctypes.data,
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            camera.width,
            camera.height,
            size_m / 2,
            reach_m,
            depth.ctypes.data,
        )
    depth[depth > 1e8] = 0
    return depth


def consistency(
    rendered: Float32[NDArray[np.float32], "H W"],
    pixel: Int32[NDArray[np.int32], " n"],
    z: Float64[NDArray[np.float64], " n"],
    sigma: Float64[NDArray[np.float64], " n"],
    q: Float32[NDArray[np.float32], " n"],
    model: BeamModel,
    *,
    scale: float,
    offset: float,
) -> tuple[float, float, float, float]:
    """Compare measured depths with a depth image of the map (``render``).

    Args:
        rendered: rendered depth, m; 0 where nothing is mapped.
        pixel: index of each point's pixel, counted row by row.
        z: measured depth of each point along the optical axis, m.
        sigma: standard deviation of ``z``, m.
        q: as in ``QueryPoints``, 1/px.
        model: mixture model of the measured depth.
        scale: registered scale of the measured depth.
        offset: registered disparity offset, px.

    Returns:
        Mean logarithm of the density (1/m), then three shares of the points: behind the map's surfaces, in front of them, and where
        nothing is mapped. The surfaces of a point are those of the 3 x 3 pixels around its own.

    Raises:
        ValueError: there is no point, the arrays differ in length, or a pixel lies outside the image.
    """
    count = len(pixel)
    if (
        not count
        or any(len(each) != count for each in (z, sigma, q))
        or not 0 <= pixel.min() <= pixel.max() < rendered.size
    ):
        raise ValueError(
            f"{count} points: expected at least one, arrays of equal length, and pixels inside the image {rendered.shape}"
        )
    arrays = [
        np.ascontiguousarray(*given)
        for given in (
            (rendered, np.float32),
            (pixel, np.int32),
            (z, np.float64),
            (sigma, np.float64),
            (q, np.float32),
        )
    ]
    found = np.zeros(4)
    _library().streetfix_consistency(
        arrays[0].ctypes.data,
        *rendered.shape,
        count,
        *(each.ctypes.data for each in arrays[1:]),
        byref(_Beam(*astuple(model), scale, offset)),
        found.ctypes.data,
    )
    likelihood, through, front, unmapped = (found / count).tolist()
    return likelihood, through, front, unmapped
