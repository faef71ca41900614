"""Cut streets by length: into beginning and end, or into numbered sections."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from model_training.streets.axis import axis_of
from model_training.streets.named_street import NamedStreet, Section
from service.errors import DatasetError

Cut = Literal["ends", "numbered"]
_STEP_M = 1.0
_MOST = 1000
#: Greatest number of samples per section. Longer sections are sampled more coarsely, except at their ends.
_MOST_POINTS = 5000


def in_sections(streets: Iterable[NamedStreet], *, length_m: float, cut: Cut = "ends") -> tuple[NamedStreet, ...]:
    """Cut every street that is longer than ``length_m`` along its axis. Junctions and sections stay whole.

    Args:
        streets: map frame, metres.
        length_m: length of a section, metres, above 0.
        cut: "ends": the first ``length_m`` are the beginning, the last are the end, and the rest keeps the street's name. A
            street of up to two lengths is halved. "numbered": the fewest equal sections that are not longer.

    Raises:
        DatasetError: a street would be cut into more than a thousand sections.
    """
    return tuple(section for street in streets for section in _cut(street, length_m, cut))


def _cut(street: NamedStreet, length_m: float, cut: Cut) -> list[NamedStreet]:
    if not street.divisible or street.surface.is_empty:
        return [street]
    axis = axis_of(street.surface, street.lines)
    if axis.length <= length_m:
        return [street]
    if axis.length > _MOST * length_m:
        raise DatasetError(
            f"{street.name} is {axis.length:.0f} m long: more than {_MOST} sections of {length_m:g} m; check that the "
            "coordinates are metres of the map (--frame), and the length of a section",
            field="section_length",
        )
    named: list[tuple[str, Section | None]]
    if cut == "numbered":
        count = int(np.ceil(axis.length / length_m))
        bounds = np.linspace(0.0, axis.length, count + 1)
        named = [(f"{street.name}, section {number + 1}", None) for number in range(count)]
    else:
        first, last = f"Beginning of {street.name}", f"End of {street.name}"
        if axis.length <= 2 * length_m:
            bounds, named = np.linspace(0.0, axis.length, 3), [(first, "beginning"), (last, "end")]
        else:
            bounds = np.array([0.0, length_m, axis.length - length_m, axis.length])
            named = [(first, "beginning"), (street.name, None), (last, "end")]
    return [
        replace(
            street,
            name=name,
            section=section,
            surface=ground,
            divisible=False,
            id=None if street.id is None else f"{street.id}-{section or number + 1}",
        )
        for number, ((name, section), ground) in enumerate(
            zip(named, _divided(street.surface, axis, bounds), strict=True)
        )
        if not ground.is_empty
    ]


def _divided(surface: BaseGeometry, axis: shapely.LineString, bounds: NDArray[np.float64]) -> list[BaseGeometry]:
    """Divide a surface by the nearest section of the axis. The parts cover all of it, do not overlap, and meet at right angles."""
    near, far = bounds[:-1], bounds[1:]
    half = min(_STEP_M, float((far - near).min())) / 2
    # The samples before and after a bound are equally far from it. So their cells meet exactly at the cut.
    lengths = [
        np.linspace(a + half, b - half, int(np.clip(np.ceil((b - a) / _STEP_M), 2, _MOST_POINTS)))
        for a, b in zip(near, far, strict=True)
    ]
    stretch = np.repeat(np.arange(len(near)), [len(each) for each in lengths])
    points = shapely.line_interpolate_point(axis, np.concatenate(lengths))
    cells = shapely.get_parts(shapely.voronoi_polygons(shapely.union_all(points), extend_to=surface.envelope))
    point, cell = shapely.STRtree(cells).query(points, predicate="intersects")
    return [
        shapely.intersection(surface, shapely.union_all(cells[np.unique(cell[stretch[point] == number])]))
        for number in range(len(near))
    ]
