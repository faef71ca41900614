"""The surface of a road from its lanes, outwards from the reference line (ASAM OpenDRIVE 1.8, chapter 11)."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from jaxtyping import Float64
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from model_training.streets.named_street import LARGEST_M, Lanes
from model_training.streets.plan_view import STEP_M, Along, Geometry, Points, reference_line

#: OpenDRIVE's lane types that vehicles drive on.
DRIVEN = frozenset(
    {
        "driving",
        "entry",
        "exit",
        "onRamp",
        "offRamp",
        "slipLane",
        "connectingRamp",
        "bidirectional",
        "bus",
        "taxi",
        "HOV",
        "mwyEntry",
        "mwyExit",
        "roadWorks",
        "tram",
        "stop",
    }
)
#: Lane types that are no part of a road: "none" is the ground outside of it.
NOWHERE = frozenset({"none"})
#: Grid of the surfaces, metres. Adjacent strips differ by rounding errors; on this grid they meet exactly.
GRID_M = 0.001


@dataclass(frozen=True, slots=True)
class Records:
    """A piecewise cubic function of the length along a road: a lane offset or a lane width.

    Attributes:
        starts: length at which each cubic begins, metres, rising.
        coefficients: four coefficients of each cubic, lowest first; metres.
    """

    starts: tuple[float, ...]
    coefficients: tuple[tuple[float, float, float, float], ...]

    def at(self, s: Along) -> Along:
        """Return the values (n,), metres; 0 before the first record and without records.

        Args:
            s: lengths (n,), metres, measured like ``starts``.
        """
        values = np.zeros(len(s))
        record = np.searchsorted(self.starts, s, side="right") - 1
        for number, (start, cubic) in enumerate(zip(self.starts, self.coefficients, strict=True)):
            here = record == number
            values[here] = np.polynomial.polynomial.polyval(s[here] - start, cubic)
        return values


@dataclass(frozen=True, slots=True)
class Lane:
    """A lane.

    Attributes:
        number: positive to the left of the reference line, negative to the right; its magnitude rises outwards.
        kind: OpenDRIVE's lane type.
        width: as a function of the length from the start of its section.
    """

    number: int
    kind: str
    width: Records


@dataclass(frozen=True, slots=True)
class LaneSection:
    """Lanes that begin at the same length of their road.

    Attributes:
        s: length along the road, metres.
        lanes: in the file's order.
    """

    s: float
    lanes: tuple[Lane, ...]


@dataclass(frozen=True, slots=True)
class RoadShape:
    """Everything that defines a road's surface.

    Attributes:
        length_m: of the road, metres.
        geometries: pieces of the reference line, in order.
        offset: lateral offset of the lanes from the reference line, positive to the left.
        sections: in order.
    """

    length_m: float
    geometries: tuple[Geometry, ...]
    offset: Records
    sections: tuple[LaneSection, ...]

    def centre(self) -> Points:
        """Return the reference line (n, 2), the file's coordinates, metres."""
        return reference_line(self.geometries, self._lengths(0.0, self.length_m))[0]

    def surface(self, lanes: Lanes) -> BaseGeometry:
        """Return the ground of the lanes, the file's coordinates, metres; empty without a lane of that kind.

        Args:
            lanes: which lanes count.

        Raises:
            ValueError: a coordinate is larger than those of any map.
        """
        ends = [section.s for section in self.sections[1:]] + [self.length_m]
        strips = [
            strip
            for section, end in zip(self.sections, ends, strict=True)
            for strip in self._strips(section, end, lanes)
        ]
        return shapely.union_all(strips, grid_size=GRID_M)

    def _strips(self, section: LaneSection, end: float, lanes: Lanes) -> list[BaseGeometry]:
        if end <= section.s:
            return []
        s = self._lengths(section.s, end)
        points, heading = reference_line(self.geometries, s)
        left = np.stack([-np.sin(heading), np.cos(heading)], axis=1)
        borders = [self.offset.at(s)]  # from the outer border of the leftmost lane to that of the rightmost lane
        wanted: list[bool] = []  # for the lane to the right of each border
        for lane in sorted((each for each in section.lanes if each.number > 0), key=lambda each: each.number):
            borders.insert(0, borders[0] + np.maximum(lane.width.at(s - section.s), 0.0))
            wanted.insert(0, _is_wanted(lane.kind, lanes))
        for lane in sorted((each for each in section.lanes if each.number < 0), key=lambda each: -each.number):
            borders.append(borders[-1] - np.maximum(lane.width.at(s - section.s), 0.0))
            wanted.append(_is_wanted(lane.kind, lanes))
        if not (np.abs(points) <= LARGEST_M).all() or not (np.abs(borders) <= LARGEST_M).all():
            raise ValueError(f"a coordinate is beyond {LARGEST_M:g} m")
        outer = [number for number, (a, b) in enumerate(pairwise([False, *wanted, False])) if a != b]
        return [
            strip_between(points + left * borders[a][:, None], points + left * borders[b][:, None])
            for a, b in zip(outer[::2], outer[1::2], strict=True)
        ]

    def _lengths(self, start: float, end: float) -> Along:
        """Sample lengths from start to end: at the start of every record and geometry, and in steps between them."""
        marks = [g.s for g in self.geometries] + list(self.offset.starts)
        marks += [section.s + at for section in self.sections for lane in section.lanes for at in lane.width.starts]
        inner = np.unique([mark for mark in marks if start < mark < end])
        corners = np.r_[start, inner, end]
        pieces = [
            np.linspace(a, b, max(1, int(np.ceil((b - a) / STEP_M))), endpoint=False) for a, b in pairwise(corners)
        ]
        return np.concatenate([*pieces, [end]])


def strip_between(left: Points, right: Points) -> BaseGeometry:
    """Return the ground between two lines that run side by side, even if one folds over itself in a tight bend.

    Args:
        left: (n, 2), metres.
        right: (n, 2), metres.
    """
    ring: BaseGeometry = shapely.Polygon(np.concatenate([left, right[::-1]]))
    if not ring.is_valid:
        quads: Float64[NDArray[np.float64], "m 4 2"] = np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1)
        ring = shapely.union_all(shapely.convex_hull(shapely.multipoints(quads)))
    return ring


def _is_wanted(kind: str, lanes: Lanes) -> bool:
    return kind in DRIVEN if lanes == "driving" else kind not in NOWHERE
