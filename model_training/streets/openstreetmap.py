"""Read the streets of an OpenStreetMap file (.osm XML or .osm.pbf): named ways for vehicles and pedestrians.

Their width follows from their tags. Names and lines come from OpenStreetMap's contributors (ODbL).
Whoever distributes a map with them must credit the contributors.
"""

import math
import re
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from model_training.streets.corridor import corridor
from model_training.streets.geojson import WIDEST_M
from model_training.streets.map_frame import FARTHEST_M, MapFrame
from model_training.streets.named_street import Lanes, NamedStreet, StreetSource, in_natural_order
from service.errors import DatasetError

#: Carriageway width (m) by class, most important class first: at a crossing the more important street keeps the ground.
CLASS_WIDTHS_M = {
    "motorway": 11.0,
    "trunk": 10.0,
    "primary": 9.0,
    "secondary": 8.0,
    "tertiary": 7.0,
    "unclassified": 6.0,
    "residential": 6.0,
    "living_street": 5.0,
    "pedestrian": 6.0,
    "motorway_link": 5.0,
    "trunk_link": 5.0,
    "primary_link": 5.0,
    "secondary_link": 5.0,
    "tertiary_link": 5.0,
    "road": 6.0,
    "busway": 6.0,
    "service": 4.0,
}
#: Width of a lane, metres.
LANE_M = 3.25
#: Width of a pavement, metres. With ``lanes`` "all" each side gets one, unless the tags or the class say otherwise.
PAVEMENT_M = 2.0
_WITHOUT_PAVEMENT = frozenset({"motorway", "motorway_link", "trunk", "trunk_link", "pedestrian", "service"})
_FOOT_M = 0.3048
_WIDTH = re.compile(r"(?P<number>[0-9]+(?:\.[0-9]+)?)\s*(?P<unit>m|ft|')?")


@dataclass(frozen=True, slots=True)
class _Way:
    rank: int
    line: shapely.LineString
    width_m: float


def read_openstreetmap(
    path: Path, *, frame: MapFrame, lanes: Lanes = "all", width_m: float | None = None
) -> StreetSource:
    """Read the named ways of an OpenStreetMap file. Ways of one ``name``, or else one ``ref``, form one street.

    Args:
        path: of the file.
        frame: converts WGS-84 to the map frame.
        lanes: "all" adds pavements.
        width_m: width of carriageways without a tagged width or number of lanes, metres; None for ``CLASS_WIDTHS_M``.

    Raises:
        DatasetError: the file is missing or broken, or has no named way near the map.
    """
    import osmium

    if not path.is_file():
        raise DatasetError(
            f"{path}: file not found; give an extract of OpenStreetMap, for example town.osm or town.osm.pbf",
            field=path.name,
        )
    of_name: dict[str, list[_Way]] = defaultdict(list)
    left_out: Counter[str] = Counter()
    try:
        for way in osmium.FileProcessor(str(path), osmium.osm.NODE | osmium.osm.WAY).with_locations():
            if not isinstance(way, osmium.osm.Way) or "highway" not in way.tags:
                continue
            tags = {tag.k: tag.v for tag in way.tags}
            nodes = [(node.lon, node.lat) for node in way.nodes if node.location.valid()]
            read = _way(tags, nodes, frame, lanes, width_m)
            if isinstance(read, str):
                left_out[read] += 1
            else:
                of_name[_name(tags)].append(read)
    except (RuntimeError, ValueError, osmium.InvalidLocationError) as error:  # from the parser, text, coordinates
        raise DatasetError(
            f"{path}: not valid OpenStreetMap data: {error}; download the extract again", field=path.name
        ) from error
    reasons = tuple(f"{count} ways {reason}" for reason, count in left_out.items())
    if not of_name:
        raise DatasetError(
            f"{path}: no way with the tags highway and name is near the map "
            f"({'; '.join(reasons) or 'no highways at all'}); download an extract of the surroundings of the survey",
            field="way",
        )
    order = sorted(of_name, key=lambda name: (min(way.rank for way in of_name[name]), in_natural_order(name)))
    streets = tuple(
        NamedStreet(
            street=name,
            name=name,
            lines=tuple(way.line for way in of_name[name]),
            surface=corridor([way.line for way in of_name[name]], [way.width_m for way in of_name[name]]),
        )
        for name in order
    )
    return StreetSource(streets, left_out[_UNNAMED], reasons)


_UNNAMED = "have no name"


def _name(tags: Mapping[str, str]) -> str:
    return (tags.get("name") or tags.get("ref") or "").strip()


def _way(
    tags: Mapping[str, str], nodes: list[tuple[float, float]], frame: MapFrame, lanes: Lanes, width_m: float | None
) -> _Way | str:
    """A way of a street, or the reason why it is none."""
    kind = tags["highway"]
    if kind not in CLASS_WIDTHS_M:
        return "are of other classes (footways, paths, steps, planned ones)"
    if not _name(tags):
        return _UNNAMED
    if tags.get("area") == "yes":
        return "are squares (area=yes), which have no centre line"
    points = frame.from_wgs84(np.array(nodes, np.float64).reshape(-1, 2))
    if len(points) < 2 or not np.ptp(points, axis=0).any():
        return "have fewer than two nodes in the file"
    if not np.isfinite(points).all():
        return f"reach farther than {FARTHEST_M / 1000:.0f} km from the map's origin"
    width = _carriageway_m(tags, width_m)
    if lanes == "all" and kind not in _WITHOUT_PAVEMENT and tags.get("sidewalk") not in ("no", "none"):
        width += 2 * PAVEMENT_M
    return _Way(list(CLASS_WIDTHS_M).index(kind), shapely.LineString(points), width)


def _carriageway_m(tags: Mapping[str, str], width_m: float | None) -> float:
    """Width by the tag width, else by the number of lanes, else the default, metres. Invalid tags are common and are ignored."""
    tagged = _WIDTH.fullmatch(tags.get("width", "").strip())
    if tagged:
        metres = float(tagged["number"]) * (_FOOT_M if tagged["unit"] in ("ft", "'") else 1.0)
        if 0 < metres <= WIDEST_M:
            return metres
    lanes = tags.get("lanes", "")
    if re.fullmatch(r"[1-9][0-9]?", lanes):
        return int(lanes) * LANE_M
    return CLASS_WIDTHS_M[tags["highway"]] if width_m is None or not math.isfinite(width_m) else width_m
