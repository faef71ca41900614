"""Ground of streets that are given by centre lines and widths."""

from collections import Counter
from collections.abc import Sequence

import shapely
from shapely.geometry.base import BaseGeometry


def corridor(lines: Sequence[shapely.LineString], widths_m: Sequence[float]) -> BaseGeometry:
    """Return the ground along a street's centre lines. It ends where the lines end.

    Args:
        lines: centre lines, metres.
        widths_m: width of each line from edge to edge, metres.

    Returns:
        Polygon or MultiPolygon. The wedges between consecutive lines are filled.
    """
    meet = Counter(point for line in lines for point in (line.coords[0][:2], line.coords[-1][:2]))
    halves: dict[tuple[float, ...], float] = {}
    for line, width in zip(lines, widths_m, strict=True):
        for point in (line.coords[0][:2], line.coords[-1][:2]):
            halves[point] = min(width / 2, halves.get(point, width / 2))
    strips = [line.buffer(w / 2, cap_style="flat") for line, w in zip(lines, widths_m, strict=True)]
    joints = [shapely.Point(point).buffer(halves[point]) for point, count in meet.items() if count > 1]
    return shapely.union_all([*strips, *joints])
