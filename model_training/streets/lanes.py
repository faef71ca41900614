"""A road's surface of its lanes: from the reference line outwards, lane by lane (ASAM OpenDRIVE 1.8, chapter 11)."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from jaxtyping import Float64
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from model_training.streets.named_street import LARGEST_M, Lanes
from model_training.streets.plan_view import STEP_M, Along, Geometry, Points, reference_line

#: OpenDRIVE's types of lanes that vehicles drive on.
DRIVEN = frozenset({
    "driving", "entry", "exit", "onRamp", "offRamp", "slipLane", "connectingRamp", "bidirectional", "bus", "taxi", "HOV",
    "mwyEntry", "mwyExit", "roadWorks", "tram", "stop",
})  # fmt: skip
#: "none" is the ground outside of a road.
NOWHERE = frozenset({"none"})
#: Strips that follow one another meet to rounding only; on this grid they meet exactly.
GRID_M = 0.001


@dataclass(frozen=True, slots=True)
class Records:
    """Cubics one after the other, each from its start on: lane offsets and widths, metres."""

    starts: tuple[float, ...]
    coefficients: tuple[tuple[float, float, float, float], ...]

    def at(self, s: Along) -> Along:
        """Values (n) at lengths from where ``starts`` count; 0 before the first record and where there is none."""
        values = np.zeros(len(s))
        record = np.searchsorted(self.starts, s, side="right") - 1
        for number, (start, cubic) in enumerate(zip(self.starts, self.coefficients, strict=True)):
            here = record == number
            values[here] = np.polynomial.polynomial.polyval(s[here] - start, cubic)
        return values


@dataclass(frozen=True, slots=True)
class Lane:
    """A lane: its number (positive to the left, rising outwards), type, and width by the length from its section's start."""

    number: int
    kind: str
    width: Records


@dataclass(frozen=True, slots=True)
class LaneSection:
    """Lanes that begin together, at the length ``s`` (m) of their road."""

    s: float
    lanes: tuple[Lane, ...]


@dataclass(frozen=True, slots=True)
class RoadShape:
    """All that a road's surface follows from."""

    length_m: float
    geometries: tuple[Geometry, ...]
    offset: Records
    sections: tuple[LaneSection, ...]

    def centre(self) -> Points:
        """The reference line (n, 2), metres."""
        return reference_line(self.geometries, self._lengths(0.0, self.length_m))[0]

    def surface(self, lanes: Lanes) -> BaseGeometry:
        """The ground its lanes cover, metres; empty where it has no lane of that kind.

        Raises:
            ValueError: a cubic leads further than any map reaches.
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
        borders = [self.offset.at(s)]  # from the leftmost lane's outer border to the rightmost's
        wanted: list[bool] = []  # of the lane to the right of each border
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
        """Lengths from start to end: every record's and geometry's start, and steps between."""
        marks = [g.s for g in self.geometries] + list(self.offset.starts)
        marks += [section.s + at for section in self.sections for lane in section.lanes for at in lane.width.starts]
        inner = np.unique([mark for mark in marks if start < mark < end])
        corners = np.r_[start, inner, end]
        pieces = [
            np.linspace(a, b, max(1, int(np.ceil((b - a) / STEP_M))), endpoint=False) for a, b in pairwise(corners)
        ]
        return np.concatenate([*pieces, [end]])


def strip_between(left: Points, right: Points) -> BaseGeometry:
    """The ground between two lines that run side by side (n, 2), also where one folds over itself in a tight bend."""
    ring: BaseGeometry = shapely.Polygon(np.concatenate([left, right[::-1]]))
    if not ring.is_valid:
        quads: Float64[NDArray[np.float64], "m 4 2"] = np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1)
        ring = shapely.union_all(shapely.convex_hull(shapely.multipoints(quads)))
    return ring


def _is_wanted(kind: str, lanes: Lanes) -> bool:
    return kind in DRIVEN if lanes == "driving" else kind not in NOWHERE
