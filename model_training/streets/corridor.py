"""Ground of streets that are known by centre lines and widths."""

from collections import Counter
from collections.abc import Sequence

import shapely
from shapely.geometry.base import BaseGeometry


def corridor(lines: Sequence[shapely.LineString], widths_m: Sequence[float]) -> BaseGeometry:
    """The ground along a street's centre lines, each as wide as given; it ends where its lines do.

    Args:
        lines: metres.
        widths_m: from edge to edge, one a line.

    Returns:
        Polygon or MultiPolygon; without wedges missing where one line goes on from another.
    """
    meet = Counter(point for line in lines for point in (line.coords[0][:2], line.coords[-1][:2]))
    halves: dict[tuple[float, ...], float] = {}
    for line, width in zip(lines, widths_m, strict=True):
        for point in (line.coords[0][:2], line.coords[-1][:2]):
            halves[point] = min(width / 2, halves.get(point, width / 2))
    strips = [line.buffer(w / 2, cap_style="flat") for line, w in zip(lines, widths_m, strict=True)]
    joints = [shapely.Point(point).buffer(halves[point]) for point, count in meet.items() if count > 1]
    return shapely.union_all([*strips, *joints])
