"""The compiled kernel, called through ctypes: no Python API, so one build serves every Python, and no lock is held while it runs."""

import ctypes
from ctypes import POINTER, Structure, byref, c_double, c_int64, c_void_p
from dataclasses import astuple, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int32
from numpy.typing import NDArray

from service.compiled import load
from service.geometry.camera import PinholeCamera

UNKNOWNS = 8  # translation, rotation, log scale, disparity offset
BLOCK = 8
AHEAD = 32  # points that the kernel works on side by side
LIBRARY = Path(__file__).with_name("_kernel.so")

#: A surface element: position relative to the grid's origin, unit normal, thickness across the surface (m), points.
SURFEL = np.dtype([("xyz", "<f4", (3,)), ("normal", "<f4", (3,)), ("thickness_m", "<f4"), ("points", "<u4")])
#: What the kernel keeps of one start: pose of the level frame, scale, offset, information, score.
STATE = np.dtype(
    [("R", "<f8", (3, 3)), ("t", "<f8", (3,)), ("log_scale", "<f8"), ("offset", "<f8"), ("anchor", "<f8", (3,)), ("up", "<f8", (3,)),
     ("information", "<f8", (UNKNOWNS, UNKNOWNS)),
     ("inliers", "<f8"), ("seen", "<f8"), ("weight", "<f8")]
)  # fmt: skip


class _Grid(Structure):
    _fields_ = [*((name, c_double) for name in ("ox", "oy", "oz", "cell")), *((name, c_int64) for name in ("bx", "by", "bz")),
                ("block", c_void_p), ("nearest", c_void_p)]  # fmt: skip


class _Query(Structure):
    _fields_ = [("count", c_int64), ("xyz", c_void_p * 3), ("ray", c_void_p * 3),
                *((name, c_void_p) for name in ("sigma", "weight", "q"))]  # fmt: skip


class _Options(Structure):
    _fields_ = [("iterations", c_int64), *((name, c_double) for name in (
        "reach", "robust_first", "robust_last", "surface", "prior_weight", "tilt", "height", "position", "scale", "offset",
        "free_scale", "free_offset"))]  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamModel:
    """What a camera sees of a mapped scene that may have changed.

    Attributes:
        hit: share of the rays that meet the mapped surface.
        new: share that something new stops before it.
        gone: share that goes on behind it.
        any: share that says nothing.
        rough_m: roughness of surfaces.
        span_m: over which what is gone, or says nothing, is spread.
        certain: standard deviations, and
        margin_m: metres beyond which a point lies off the surface.
        nothing_m: how far a surface is taken to be where the map shows none.
    """

    hit: float
    new: float
    gone: float
    any: float
    rough_m: float
    span_m: float
    certain: float
    margin_m: float
    nothing_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SolverOptions:
    """One run of the solver; metres and radians. Names as in ``kernel.c``."""

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
        {"Surfel": SURFEL, "Grid": _Grid, "Query": _Query, "Options": _Options, "State": STATE, "Beam": _Beam},
        {"UNKNOWNS": UNKNOWNS, "BLOCK": BLOCK, "AHEAD": AHEAD},
    )
    library.streetfix_align.argtypes = [
        POINTER(_Grid), c_void_p, POINTER(_Query), POINTER(_Options), c_double, c_double, c_int64, c_void_p,
    ]  # fmt: skip
    library.streetfix_pulls.argtypes = [
        POINTER(_Grid), c_void_p, POINTER(_Query), POINTER(_Options), c_void_p, c_void_p, c_void_p,
    ]  # fmt: skip
    library.streetfix_agree.argtypes = [
        c_void_p, c_int64, c_int64, c_int64, c_void_p, c_void_p, c_void_p, c_void_p, POINTER(_Beam), c_void_p,
    ]  # fmt: skip
    library.streetfix_mark.argtypes = [POINTER(_Grid), c_void_p, c_int64, c_double, c_void_p]
    library.streetfix_fill.argtypes = [POINTER(_Grid), c_void_p, c_int64, c_double, c_void_p, c_void_p]
    library.streetfix_render.argtypes = [
        c_void_p, c_void_p, c_int64, c_double, c_void_p, c_void_p, c_double, c_double, c_double, c_double, c_int64, c_int64,
        c_double, c_double, c_void_p,
    ]  # fmt: skip
    for name in ("streetfix_align", "streetfix_pulls", "streetfix_mark", "streetfix_fill", "streetfix_render"):
        getattr(library, name).restype = None
    return library


@dataclass(frozen=True, slots=True, eq=False)
class NearestGrid:
    """For every cell near a surface the surfel nearest to its centre, in blocks of 8 x 8 x 8 cells; may be memory-mapped.

    Attributes:
        origin_m: corner of the grid in the surfels' frame.
        cell_m: edge of a cell.
        block: number of each block, -1 where no surface is near.
        nearest: of each cell of each block, -1 where no surface is near.
    """

    origin_m: Float64[NDArray[np.float64], "3"]
    cell_m: float
    block: Int32[NDArray[np.int32], "X Y Z"]
    nearest: Int32[NDArray[np.int32], "N 512"]

    def _as_c(self) -> _Grid:
        return _Grid(*self.origin_m, self.cell_m, *self.block.shape, self.block.ctypes.data, self.nearest.ctypes.data)


@dataclass(frozen=True, slots=True, eq=False)
class QueryPoints:
    """Points of a query in its level frame, the camera at the origin.

    Attributes:
        xyz: metres.
        ray: unit vectors from the camera.
        sigma: standard deviation along the ray, metres.
        weight: share of the information that each brings.
        q: depth / (focal length x baseline); 0 where the camera knows no disparity offset.
    """

    xyz: Float32[NDArray[np.float32], "n 3"]
    ray: Float32[NDArray[np.float32], "n 3"]
    sigma: Float32[NDArray[np.float32], " n"]
    weight: Float32[NDArray[np.float32], " n"]
    q: Float32[NDArray[np.float32], " n"]

    def __len__(self) -> int:
        return len(self.sigma)

    def weighing_at_least(self, weight: float) -> "QueryPoints":
        """The same points, none of less weight."""
        return QueryPoints(self.xyz, self.ray, self.sigma, np.maximum(self.weight, np.float32(weight)), self.q)

    def thinned(self, count: int) -> "QueryPoints":
        """At most so many of the points, evenly spread over their order."""
        return self.subset(np.linspace(0, len(self) - 1, min(count, len(self))).astype(np.intp))

    def subset(self, rows: NDArray[np.intp]) -> "QueryPoints":
        """Some of the points."""
        return QueryPoints(*(np.ascontiguousarray(getattr(self, name)[rows]) for name in self.__slots__))


def align(
    grid: NearestGrid, surfels: NDArray[Any], query: QueryPoints, states: NDArray[Any], options: SolverOptions, *,
    tolerance_m: float = 0.1, height_min_m: float = -1e9,
) -> None:  # fmt: skip
    """Move every start (``STATE``, in place) onto the map and score it; ``iterations`` 0 scores alone."""
    points, given = _as_c(query, options)
    _library().streetfix_align(
        byref(grid._as_c()), surfels.ctypes.data, byref(points), byref(given), tolerance_m, height_min_m, len(states), states.ctypes.data
    )  # fmt: skip


def pulls(
    grid: NearestGrid, surfels: NDArray[Any], query: QueryPoints, state: NDArray[Any], options: SolverOptions,
    patch: Int32[NDArray[np.int32], " n"],
) -> Float64[NDArray[np.float64], "B 8"]:  # fmt: skip
    """Which way each patch of a picture would move a pose: gradients of its points, each by its residual and weight, summed.

    Args:
        grid: of the map.
        surfels: of the map.
        query: its points.
        state: one ``STATE``.
        options: as in the last iteration.
        patch: of each point, from 0 without gaps.
    """
    found = np.zeros((int(patch.max(initial=-1)) + 1, UNKNOWNS))
    points, given = _as_c(query, options)
    _library().streetfix_pulls(
        byref(grid._as_c()), surfels.ctypes.data, byref(points), byref(given), state.ctypes.data, patch.ctypes.data, found.ctypes.data
    )  # fmt: skip
    return found


def _as_c(query: QueryPoints, options: SolverOptions) -> tuple[_Query, _Options]:
    given = _Options(**{field[0]: getattr(options, field[0]) for field in _Options._fields_})
    planes = np.zeros((9, -(-len(query) // AHEAD) * AHEAD), np.float32)
    for rows, values in (
        (slice(0, 3), query.xyz.T),
        (slice(3, 6), query.ray.T),
        (6, query.sigma),
        (7, query.weight),
        (8, query.q),
    ):
        planes[rows, : len(query)] = values
    at = [planes.ctypes.data + number * planes.strides[0] for number in range(len(planes))]
    points = _Query(len(query), (c_void_p * 3)(*at[:3]), (c_void_p * 3)(*at[3:6]), *at[6:])
    points.planes = planes  # lives as long as what points there
    return points, given


def nearest_grid(surfels: NDArray[Any], *, cell_m: float, reach_m: float) -> NearestGrid:
    """Prepare the grid of a map; done once, when the map is built."""
    low, high = surfels["xyz"].min(axis=0).astype(np.float64), surfels["xyz"].max(axis=0).astype(np.float64)
    origin = low - reach_m - 2 * cell_m
    shape = np.ceil((high + reach_m + 2 * cell_m - origin) / (BLOCK * cell_m)).astype(int) + 1
    mark = np.zeros(tuple(shape), np.uint8)
    empty = NearestGrid(origin, cell_m, np.zeros(tuple(shape), np.int32), np.zeros((0, BLOCK**3), np.int32))
    _library().streetfix_mark(byref(empty._as_c()), surfels.ctypes.data, len(surfels), reach_m, mark.ctypes.data)
    block = np.where(mark > 0, np.cumsum(mark).reshape(mark.shape) - 1, -1).astype(np.int32)
    nearest = np.full((int(mark.sum()), BLOCK**3), -1, np.int32)
    distance2 = np.full(nearest.shape, np.inf, np.float32)
    grid = NearestGrid(origin, cell_m, block, nearest)
    _library().streetfix_fill(
        byref(grid._as_c()), surfels.ctypes.data, len(surfels), reach_m, nearest.ctypes.data, distance2.ctypes.data
    )
    return grid


def render(
    surfels: NDArray[Any], tiles: Float64[NDArray[np.float64], "n 4"], *, tile_m: float, T_map_camera: Float64[NDArray[np.float64], "4 4"],
    camera: PinholeCamera, size_m: float, reach_m: float,
) -> Float32[NDArray[np.float32], "H W"]:  # fmt: skip
    """Depth (z, metres; 0 where nothing is mapped) that a camera would see of the surfels.

    Args:
        surfels: sorted by tile.
        tiles: centre x, y (the surfels' frame, m), first surfel, count.
        tile_m: edge of a tile.
        T_map_camera: in the surfels' frame.
        camera: of the picture wanted; a small one.
        size_m: edge of the square that stands for a surfel.
        reach_m: nothing further is drawn.
    """
    depth = np.empty((camera.height, camera.width), np.float32)
    R, t = np.ascontiguousarray(T_map_camera[:3, :3]), np.ascontiguousarray(T_map_camera[:3, 3])
    _library().streetfix_render(
        surfels.ctypes.data, tiles.ctypes.data, len(tiles), reach_m + 0.71 * tile_m, R.ctypes.data, t.ctypes.data, camera.fx,
        camera.fy, camera.cx, camera.cy, camera.width, camera.height, size_m / 2, reach_m, depth.ctypes.data,
    )  # fmt: skip
    depth[depth > 1e8] = 0
    return depth


def agree(
    drawn: Float32[NDArray[np.float32], "H W"], pixel: Int32[NDArray[np.int32], " n"], z: Float64[NDArray[np.float64], " n"],
    sigma: Float64[NDArray[np.float64], " n"], q: Float32[NDArray[np.float32], " n"], model: BeamModel, *, scale: float, offset: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """How at least one point agrees with a picture of the map (``render``).

    Args:
        drawn: depth, metres; 0 where nothing is mapped.
        pixel: of each point, row by row.
        z: depth of each along the optical axis, metres.
        sigma: its standard deviation, metres.
        q: as in ``QueryPoints``.
        model: of what is seen.
        scale: of the depth, as registered.
        offset: of the disparity, as registered.

    Returns:
        Mean logarithm of the density (1/m); shares of the points behind the surfaces around their pixels, before them, and where
        nothing is mapped.
    """
    count = len(pixel)
    if (
        not count
        or any(len(each) != count for each in (z, sigma, q))
        or not 0 <= pixel.min() <= pixel.max() < drawn.size
    ):
        raise ValueError(f"{count} points do not lie on a picture of {drawn.shape}")
    arrays = [np.ascontiguousarray(*given) for given in (
        (drawn, np.float32), (pixel, np.int32), (z, np.float64), (sigma, np.float64), (q, np.float32),
    )]  # fmt: skip
    found = np.zeros(4)
    _library().streetfix_agree(
        arrays[0].ctypes.data, *drawn.shape, count, *(each.ctypes.data for each in arrays[1:]),
        byref(_Beam(*astuple(model), scale, offset)), found.ctypes.data,
    )  # fmt: skip
    likelihood, through, front, unmapped = (found / count).tolist()
    return likelihood, through, front, unmapped
