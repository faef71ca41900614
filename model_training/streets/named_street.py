"""Common result of all street readers: named surfaces in the map frame, metres."""

import re
from dataclasses import dataclass
from typing import Literal

import shapely
from shapely.geometry.base import BaseGeometry

Section = Literal["beginning", "end"]
#: Which lanes form a street's surface: those for vehicles, or shoulders and pavements too.
Lanes = Literal["driving", "all"]
#: Greatest coordinate, metres; no projection has larger ones. GEOS does not terminate on some larger coordinates.
LARGEST_M = 1e8
#: Largest file of streets that is read. CARLA's largest town has 70 MB.
LARGEST_BYTES = 256 * 2**20


@dataclass(frozen=True, slots=True)
class NamedStreet:
    """A street, a section of one, or a junction.

    Attributes:
        street: name of the whole street.
        name: displayed name: that of the street, or of the section.
        surface: Polygon or MultiPolygon, map frame, metres.
        lines: centre lines in the source's direction, map frame, metres; empty if the source has only polygons.
        section: None for a whole street, or for a section that is neither the beginning nor the end.
        id: the source's own id; None if one is to be made from the name.
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
    """What a reader found in a file.

    Attributes:
        streets: in order of priority: if two overlap, the earlier one keeps the ground.
        unnamed: number of roads (ways, features) without a name.
        dropped: what was left out and why, one sentence each.
    """

    streets: tuple[NamedStreet, ...]
    unnamed: int = 0
    dropped: tuple[str, ...] = ()


def in_natural_order(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a sorting key under which "Road 9" comes before "Road 10".

    Args:
        name: of a street.
    """
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts)
