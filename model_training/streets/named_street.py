"""What every source of streets is read into: names with a surface, in metres of the map frame."""

import re
from dataclasses import dataclass
from typing import Literal

import shapely
from shapely.geometry.base import BaseGeometry

Section = Literal["beginning", "end"]
#: Which lanes make a street's surface: those for vehicles, or the shoulders and pavements as well.
Lanes = Literal["driving", "all"]
#: No map's coordinates are larger, whatever its projection; GEOS does not come to an end on some that are.
LARGEST_M = 1e8


@dataclass(frozen=True, slots=True)
class NamedStreet:
    """A street, a section of one, or a junction.

    Args:
        street: name of the whole street.
        name: what people read; the street's, unless it is a section.
        surface: Polygon or MultiPolygon, map frame, metres.
        lines: centre lines, map frame, metres; in the source's direction. Empty where the source has polygons only.
        section: None where it is a whole street, or a section that is neither the beginning nor the end.
        id: the source's own, or None where one is to be made of the name.
        divisible: whether it may be cut into sections; junctions and sections may not.
    """

    street: str
    name: str
    surface: BaseGeometry
    lines: tuple[shapely.LineString, ...] = ()
    section: Section | None = None
    id: str | None = None
    divisible: bool = True


@dataclass(frozen=True, slots=True)
class StreetSource:
    """What was read of a file.

    Args:
        streets: where two overlap, the earlier one keeps the ground.
        unnamed: how many roads (ways, features) of the source had no name.
        dropped: what was left out, a sentence each, saying why.
    """

    streets: tuple[NamedStreet, ...]
    unnamed: int = 0
    dropped: tuple[str, ...] = ()


def in_natural_order(name: str) -> tuple[tuple[int, int, str], ...]:
    """A sorting key under which "Road 9" comes before "Road 10"."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts)
