"""OpenDRIVE's reference line from above: lines, arcs, spirals and cubics (ASAM OpenDRIVE 1.8, chapter 9).

Coordinates are OpenDRIVE's: right-handed, x east, y north. Headings are counter-clockwise from x.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

Along = Float64[NDArray[np.float64], "n"]
Points = Float64[NDArray[np.float64], "n 2"]
#: Distance between samples, metres. In a bend of 5 m radius the chord deviates by 6 mm.
STEP_M = 0.5
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)


@dataclass(frozen=True, slots=True)
class Bend:
    """Line, arc or spiral: its curvature changes linearly with the length.

    Attributes:
        curvature: at the start, 1/m; positive turns left.
        growth: change of the curvature per metre, 1/m2.
    """

    curvature: float = 0.0
    growth: float = 0.0

    def at(self, s: Along) -> tuple[Points, Along]:
        """Return points (n, 2), metres, and headings (n,), radians, of a bend that starts at the origin along x.

        Args:
            s: lengths from the start (n,), metres, rising.
        """
        ends = np.union1d(np.arange(0.0, max(s[-1], STEP_M), STEP_M), s)
        half, middle = np.diff(ends) / 2, (ends[1:] + ends[:-1]) / 2
        # Gauss-Legendre quadrature per step: exact to rounding if a step turns by less than a radian.
        inner = self._heading(middle[:, None] + half[:, None] * _NODES)
        steps = np.stack([np.cos(inner) @ _WEIGHTS, np.sin(inner) @ _WEIGHTS], axis=1) * half[:, None]
        points = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        return points[np.searchsorted(ends, s)], self._heading(s)

    def _heading(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        return s * (self.curvature + 0.5 * self.growth * s)


@dataclass(frozen=True, slots=True)
class Cubic:
    """``poly3`` and ``paramPoly3``: u and v are cubics of a parameter, which follows from the length along the curve.

    Attributes:
        u: four coefficients of u, lowest first, metres.
        v: four coefficients of v, lowest first, metres.
        last: parameter at the end of the geometry.
        length_m: length of the geometry, metres; None for poly3, whose parameter does not end at a given length.
    """

    u: tuple[float, float, float, float]
    v: tuple[float, float, float, float]
    last: float
    length_m: float | None

    def at(self, s: Along) -> tuple[Points, Along]:
        """Return points (n, 2), metres, and headings (n,), radians, in the frame of the curve's start.

        Args:
            s: lengths from the start (n,), metres, rising.
        """
        p = np.linspace(0.0, self.last, max(200, int(20 * (self.length_m or self.last))))
        slopes = np.stack([_derivative(self.u, p), _derivative(self.v, p)])
        speed = np.hypot(*slopes)
        travelled = np.r_[0.0, np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(p))]
        if self.length_m is not None:  # the file's length is rounded; the curve ends at its last parameter
            s = s * (travelled[-1] / self.length_m)
        at = np.interp(s, travelled, p)
        points: Points = np.stack([np.polynomial.polynomial.polyval(at, c) for c in (self.u, self.v)], axis=1)
        return points, np.arctan2(_derivative(self.v, at), _derivative(self.u, at))


@dataclass(frozen=True, slots=True)
class Geometry:
    """A piece of a reference line.

    Attributes:
        s: length of the road at its start, metres.
        x: of its start, metres.
        y: of its start, metres.
        heading_rad: at its start, radians.
        length_m: of the piece, metres.
        shape: in the frame of its start.
    """

    s: float
    x: float
    y: float
    heading_rad: float
    length_m: float
    shape: Bend | Cubic


def reference_line(geometries: tuple[Geometry, ...], s: Along) -> tuple[Points, Along]:
    """Return points (n, 2), metres, and headings (n,), radians, of a reference line.

    Args:
        geometries: pieces of the line, in order.
        s: lengths along the line (n,), metres, rising.
    """
    points, headings = np.empty((len(s), 2)), np.empty(len(s))
    piece = np.searchsorted([g.s for g in geometries], s, side="right") - 1
    for number, geometry in enumerate(geometries):
        here = np.flatnonzero(np.maximum(piece, 0) == number)
        if len(here) == 0:
            continue
        local, turned = geometry.shape.at(np.maximum(s[here] - geometry.s, 0.0))
        c, n = np.cos(geometry.heading_rad), np.sin(geometry.heading_rad)
        points[here] = local @ np.array([[c, n], [-n, c]]) + (geometry.x, geometry.y)
        headings[here] = turned + geometry.heading_rad
    return points, headings


def polynomial_shape(
    u: tuple[float, float, float, float],
    v: tuple[float, float, float, float],
    *,
    length_m: float,
    p_range: Literal["normalized", "arcLength"] | None,
) -> Cubic:
    """Make a ``paramPoly3`` from its pRange, or a ``poly3``.

    Args:
        u: four coefficients of u, lowest first, metres.
        v: four coefficients of v, lowest first, metres.
        length_m: length of the geometry, metres.
        p_range: pRange of a paramPoly3; None for poly3, where ``u`` is the parameter itself.
    """
    if p_range is None:
        return Cubic(u, v, last=length_m, length_m=None)
    return Cubic(u, v, last=1.0 if p_range == "normalized" else length_m, length_m=length_m)


def _derivative(coefficients: tuple[float, float, float, float], p: NDArray[np.float64]) -> NDArray[np.float64]:
    slope: NDArray[np.floating] = np.polynomial.polynomial.polyval(p, np.polynomial.polynomial.polyder(coefficients))
    return slope.astype(np.float64)
