"""Read the streets of an OpenDRIVE map (.xodr).

OpenDRIVE is right-handed: x east, y north, z up. CARLA's maps are OpenDRIVE files and fit without conversion.
CARLA's own world is left-handed (Unreal's) with the opposite y. After its importer has negated y, a CARLA recording has
the frame of its .xodr file.
"""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from model_training.streets.lanes import GRID_M
from model_training.streets.map_frame import MapFrame, Points
from model_training.streets.named_street import Lanes, NamedStreet, StreetSource, in_natural_order
from model_training.streets.opendrive_junctions import junction_streets
from model_training.streets.opendrive_road import Road, attribute, number_of, read_road
from model_training.streets.safe_xml import read_xml
from service.errors import DatasetError

#: Greatest total length of roads, metres. Surfaces are sampled every 0.5 m, so longer networks would fill the memory.
_LONGEST_M = 5_000_000.0


@dataclass(frozen=True, slots=True)
class RoadNetwork:
    """Roads of an OpenDRIVE file.

    Attributes:
        roads: in the file's order.
        junctions: names of the junctions by id.
        projection: the file's geoReference; None if it has none.
        offset: the header's offset: x, y (m) and heading (rad).
    """

    roads: tuple[Road, ...]
    junctions: dict[str, str]
    projection: str | None
    offset: tuple[float, float, float]

    def to_projection(self, points: Points) -> Points:
        """Convert the file's coordinates to eastings and northings (n, 2) with the header's offset.

        Args:
            points: the file's coordinates (n, 2), metres.
        """
        x, y, heading = self.offset
        c, s = np.cos(heading), np.sin(heading)
        moved: Points = points @ np.array([[c, s], [-s, c]]) + (x, y)
        return moved


def read_network(path: Path, *, lanes: Lanes = "all") -> RoadNetwork:
    """Read the roads of an OpenDRIVE file with the ground of their lanes.

    Args:
        path: of the .xodr file.
        lanes: which lanes form the surface.

    Raises:
        DatasetError: the file is no OpenDRIVE, has no roads, has two roads with one id, is too large, or a road lacks what
            defines its surface; the error names the road.
    """
    tree = read_xml(path, root="OpenDRIVE")
    elements = tree.findall("road")
    if not elements:
        raise DatasetError(f"{path}: the file has no <road>; export the road network with the scene", field="road")
    length = sum(number_of(element, "length", f"{path}: road {element.get('id')}") for element in elements)
    if length > _LONGEST_M:
        raise DatasetError(
            f"{path}: {length / 1000:.0f} km of roads are more than {_LONGEST_M / 1000:.0f}; reduce the map to the "
            "surroundings of the survey",
            field="road",
        )
    roads = tuple(read_road(element, lanes, path) for element in elements)
    _require_unique((road.id for road in roads), path)
    header = tree.find("header")
    offset = None if header is None else header.find("offset")
    projection = None if header is None else (header.findtext("geoReference") or "").strip() or None
    names = {attribute(j, "id", f"{path}: junction"): (j.get("name") or "").strip() for j in tree.findall("junction")}
    x, y, heading = (
        (0.0, 0.0, 0.0)
        if offset is None
        else (number_of(offset, name, f"{path}: header.offset", missing=0.0) for name in ("x", "y", "hdg"))
    )
    return RoadNetwork(roads, names, projection, (x, y, heading))


def read_opendrive(path: Path, *, lanes: Lanes = "all", frame: MapFrame | None = None) -> StreetSource:
    """Read the streets of an OpenDRIVE file: roads of one name joined, then the junctions.

    Args:
        path: of the .xodr file.
        lanes: which lanes form the surface.
        frame: converts the file's projection to the map frame; None takes the coordinates as they are.

    Raises:
        DatasetError: as ``read_network``; or ``frame`` is given, and the file has no geoReference or lies too far from the
            map's origin.
    """
    network = read_network(path, lanes=lanes)
    dropped = [f"road {road.id} has no lane of the kind {lanes!r}" for road in network.roads if road.surface.is_empty]
    roads = [road for road in network.roads if road.junction is None]
    named = {road.name for road in roads if road.name}
    of_name: dict[str, list[Road]] = defaultdict(list)
    name_of_road = {}
    for road in roads:
        fallback = f"Road {road.id}" if f"Road {road.id}" not in named else f"Road {road.id} (without a name)"
        name_of_road[road.id] = road.name or fallback
        if not road.surface.is_empty:
            of_name[road.name or fallback].append(road)
    through, junctions = junction_streets(network.roads, network.junctions, {r.id: r.name for r in roads if r.name})
    streets = [
        NamedStreet(
            street=name,
            name=name,
            lines=tuple(road.centre for road in of_name[name]),
            surface=shapely.union_all(
                [*(road.surface for road in of_name[name]), *through.get(name, ())], grid_size=GRID_M
            ),
        )
        for name in sorted(of_name, key=in_natural_order)
    ]
    placed = tuple(_in_map(street, network, frame, path) for street in (*streets, *junctions))
    unnamed = sum(not road.name for road in roads)
    return StreetSource(placed, unnamed, tuple(dropped))


def _require_unique(ids: Iterable[str], path: Path) -> None:
    seen: set[str] = set()
    for identity in ids:
        if identity in seen:
            raise DatasetError(f"{path}: two roads have the id {identity!r}; give each its own", field="road.id")
        seen.add(identity)


def _in_map(street: NamedStreet, network: RoadNetwork, frame: MapFrame | None, path: Path) -> NamedStreet:
    if frame is None:
        return street
    if network.projection is None:
        raise DatasetError(
            f"{path}: header.geoReference is missing, so its position on the Earth is unknown; give --frame map if "
            "its coordinates are the map's",
            field="geoReference",
        )
    projection = network.projection

    def placed(points: Points) -> Points:
        points = frame.from_projection(network.to_projection(points), projection)
        if not np.isfinite(points).all():
            raise DatasetError(
                f"{path}: {street.name} is more than 50 km from the map's origin by geoReference {projection!r}; "
                "correct one of the georeferences, or give --frame map if its coordinates are the map's",
                field="geoReference",
            )
        return points

    return NamedStreet(
        street=street.street,
        name=street.name,
        surface=shapely.transform(street.surface, placed),
        lines=tuple(shapely.transform(line, placed) for line in street.lines),
        divisible=street.divisible,
    )
