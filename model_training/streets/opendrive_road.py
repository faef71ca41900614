"""Read one <road> element of OpenDRIVE as the numbers that define its surface."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast
from xml.etree.ElementTree import Element

import shapely
from shapely.geometry.base import BaseGeometry

from model_training.streets.lanes import Lane, LaneSection, Records, RoadShape
from model_training.streets.named_street import Lanes
from model_training.streets.plan_view import Bend, Cubic, Geometry, polynomial_shape
from service.errors import DatasetError

#: Greatest number that is accepted. No projection has larger coordinates; larger numbers would overflow later.
_LARGEST = 1e8
_LONGEST_ROAD_M = 100_000.0
_ABCD = ("a", "b", "c", "d")


@dataclass(frozen=True, slots=True)
class Road:
    """A road of the file. Its ground has the file's coordinates, metres.

    Attributes:
        id: the file's id.
        name: the file's name; empty if it has none.
        junction: id of the junction that the road leads through, or None.
        linked: ids of the roads before and after it.
        surface: ground of its lanes; empty if it has no lane of the wanted kind.
        centre: its reference line.
    """

    id: str
    name: str
    junction: str | None
    linked: tuple[str, ...]
    surface: BaseGeometry
    centre: shapely.LineString


def attribute(element: Element, name: str, where: str) -> str:
    """Return a required attribute of an element.

    Args:
        element: XML element.
        name: of the attribute.
        where: file and road, for the error.

    Raises:
        DatasetError: the attribute is missing.
    """
    value = element.get(name)
    if value is None:
        raise DatasetError(f"{where}: <{element.tag}> has no attribute {name!r}; export the map again", field=name)
    return value


def number_of(element: Element, name: str, where: str, *, missing: float | None = None) -> float:
    """Return an attribute of an element as a number.

    Args:
        element: XML element.
        name: of the attribute.
        where: file and road, for the error.
        missing: value if the attribute is missing; None makes the attribute required.

    Raises:
        DatasetError: the attribute is missing, not finite, or too large.
    """
    if missing is not None and name not in element.attrib:
        return missing
    text = attribute(element, name, where)
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= _LARGEST:
        raise DatasetError(
            f"{where}: <{element.tag}>: {name} is {text[:40]!r}, not a number of at most {_LARGEST:g}; correct it",
            field=name,
        )
    return value


def read_road(element: Element, lanes: Lanes, path: Path) -> Road:
    """Read a <road> element with the ground of its lanes.

    Args:
        element: the element.
        lanes: which lanes form the surface.
        path: of the file, for errors.

    Raises:
        DatasetError: the road lacks what defines its surface; the error names file and road.
    """
    identity = attribute(element, "id", f"{path}: road")
    where = f"{path}: road {identity}"
    shape = road_shape(element, where)
    junction = element.get("junction", "-1").strip()
    linked = [
        link.get("elementId", "")
        for link in (element.find("link/predecessor"), element.find("link/successor"))
        if link is not None and link.get("elementType") == "road"
    ]
    try:
        surface, centre = shape.surface(lanes), shapely.LineString(shape.centre())
    except (ValueError, shapely.errors.GEOSException) as error:
        raise DatasetError(
            f"{where}: its planView or lanes do not form a surface: {error}", field="planView"
        ) from error
    return Road(
        identity,
        (element.get("name") or "").strip(),
        None if junction in ("-1", "") else junction,
        tuple(linked),
        surface,
        centre,
    )


def road_shape(road: Element, where: str) -> RoadShape:
    """Read the plan view and the lanes of a road.

    Args:
        road: the <road> element.
        where: file and road, for errors.

    Raises:
        DatasetError: geometry or length is missing or invalid, or a shape or lane is incomplete.
    """
    length = number_of(road, "length", where)
    if not 0 < length <= _LONGEST_ROAD_M:
        raise DatasetError(
            f"{where}: its length of {length:g} m is not between 0 and {_LONGEST_ROAD_M:g}", field="length"
        )
    geometries = [_geometry(element, where) for element in road.findall("planView/geometry")]
    drawn = sorted((each for each in geometries if each.length_m > 0), key=lambda each: each.s)
    if not drawn:
        raise DatasetError(
            f"{where}: planView has no <geometry> of any length, so the road has no position; export the map again",
            field="planView",
        )
    sections = [_section(element, where) for element in road.findall("lanes/laneSection")]
    return RoadShape(
        length,
        tuple(drawn),
        _records(road.findall("lanes/laneOffset"), "s", where),
        tuple(sorted(sections, key=lambda each: each.s)),
    )


def _geometry(element: Element, where: str) -> Geometry:
    s = _station(element, where)
    x, y, heading, length = (number_of(element, name, where) for name in ("x", "y", "hdg", "length"))
    if length < 0 or length > _LONGEST_ROAD_M:
        raise DatasetError(f"{where}: a <geometry> is {length:g} m long", field="length")
    return Geometry(s, x, y, heading, length, _shape(element, length, where))


def _shape(element: Element, length_m: float, where: str) -> Bend | Cubic:
    for kind in element:
        if kind.tag == "line":
            return Bend()
        if kind.tag == "arc":
            return Bend(number_of(kind, "curvature", where))
        if kind.tag == "spiral":
            start, end = number_of(kind, "curvStart", where), number_of(kind, "curvEnd", where)
            return Bend(start, (end - start) / length_m if length_m else 0.0)
        if kind.tag == "poly3":
            return polynomial_shape((0.0, 1.0, 0.0, 0.0), _cubic(kind, _ABCD, where), length_m=length_m, p_range=None)
        if kind.tag == "paramPoly3":
            p_range = kind.get("pRange", "normalized")
            if p_range not in ("normalized", "arcLength"):
                raise DatasetError(f"{where}: pRange {p_range!r} is neither normalized nor arcLength", field="pRange")
            u, v = (_cubic(kind, tuple(letter + axis for letter in _ABCD), where) for axis in "UV")
            known = cast(Literal["normalized", "arcLength"], p_range)
            return polynomial_shape(u, v, length_m=length_m, p_range=known)
    shapes = ", ".join(kind.tag for kind in element) or "nothing"
    raise DatasetError(
        f"{where}: a <geometry> has {shapes}; expected line, arc, spiral, poly3 or paramPoly3", field="geometry"
    )


def _section(element: Element, where: str) -> LaneSection:
    start = _station(element, where)
    where = f"{where}: laneSection at s = {start:g}"
    lanes = [_lane(lane, where) for side in ("left", "right") for lane in element.findall(f"{side}/lane")]
    return LaneSection(start, tuple(lanes))


def _station(element: Element, where: str) -> float:
    """Length along the road at which an element begins. It is limited, because all lengths up to it are sampled."""
    s = number_of(element, "s", where)
    if not 0 <= s <= _LONGEST_ROAD_M:
        raise DatasetError(f"{where}: <{element.tag}>: s is {s:g}, not between 0 and {_LONGEST_ROAD_M:g}", field="s")
    return s


def _lane(element: Element, where: str) -> Lane:
    number, widths = attribute(element, "id", where), element.findall("width")
    if not number.removeprefix("-").isdecimal():
        raise DatasetError(f"{where}: a lane's id is {number!r}, not an integer", field="lane.id")
    if not widths and element.find("border") is not None:
        raise DatasetError(
            f"{where}: lane {number} is described by <border>, which is not supported; export the map with <width>",
            field="border",
        )
    return Lane(int(number), element.get("type", "none"), _records(widths, "sOffset", where))


def _records(elements: list[Element], start: str, where: str) -> Records:
    read = sorted((number_of(each, start, where), _cubic(each, _ABCD, where)) for each in elements)
    return Records(tuple(at for at, _ in read), tuple(cubic for _, cubic in read))


def _cubic(element: Element, names: tuple[str, ...], where: str) -> tuple[float, float, float, float]:
    a, b, c, d = (number_of(element, name, where) for name in names)
    return a, b, c, d
