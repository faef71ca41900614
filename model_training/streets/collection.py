"""Make ``streets.geojson`` as the service reads it: streets do not overlap, and every id is unique."""

import json
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import shapely
from shapely.geometry.base import BaseGeometry

from model_training.streets.named_street import NamedStreet
from service.errors import DatasetError
from service.maps.streets import Streets

#: Grid of all coordinates, metres.
GRID_M = 0.001
#: Tolerance of the simplified edges, metres. Every street is widened by the same amount. Otherwise rounding to the grid
#: would leave gaps between adjacent streets.
_EDGE_M = 0.002
#: Smaller parts are dropped, square metres.
_SLIVER_M2 = 1.0


@dataclass(frozen=True, slots=True)
class StreetCollection:
    """Streets as GeoJSON.

    Attributes:
        document: a FeatureCollection, map frame, metres.
        dropped: what was left out, one sentence each.
        overlap_m2: ground that two streets claimed, square metres.
    """

    document: dict[str, Any]
    dropped: tuple[str, ...]
    overlap_m2: float


def collection_of(streets: Iterable[NamedStreet]) -> StreetCollection:
    """Make a FeatureCollection. If streets overlap, the earlier one keeps the ground.

    Args:
        streets: in order of priority.

    Raises:
        DatasetError: two streets have the same id, or none covers any ground.
    """
    given = list(streets)
    surfaces = [_widened(street.surface) for street in given]
    tree, taken = shapely.STRtree(surfaces), set(_own_ids(given))
    features: list[dict[str, Any]] = []
    dropped, overlap = [], 0.0
    for number, (street, surface) in enumerate(zip(given, surfaces, strict=True)):
        earlier = [surfaces[other] for other in sorted(tree.query(surface, predicate="intersects")) if other < number]
        own = shapely.difference(surface, shapely.union_all(earlier), grid_size=GRID_M) if earlier else surface
        if earlier and surface.area - own.area >= _SLIVER_M2:  # a smaller overlap comes from the widening
            overlap += surface.area - own.area
        coordinates = _coordinates(own)
        if not coordinates:
            why = "is completely inside other streets" if surface.area >= _SLIVER_M2 else "covers less than 1 m2"
            dropped.append(f"{street.name} {why}")
            continue
        identity = street.id or _free(_id_from(street), taken)
        taken.add(identity)
        features.append(
            {
                "type": "Feature",
                "properties": {
                    "id": identity,
                    "street": street.street,
                    "section": street.section,
                    "name": street.name,
                    "class_index": len(features),
                },
                "geometry": {"type": "Polygon", "coordinates": coordinates[0]}
                if len(coordinates) == 1
                else {"type": "MultiPolygon", "coordinates": coordinates},
            }
        )
    if not features:
        raise DatasetError(
            f"no street covers any area ({'; '.join(dropped[:5])}); if the coordinates are degrees, pass --frame wgs84",
            field="features",
        )
    return StreetCollection({"type": "FeatureCollection", "features": features}, tuple(dropped), overlap)


def write_streets(path: Path, document: dict[str, Any], *, replace: bool = False) -> Streets:
    """Write ``streets.geojson``; the file is renamed when it is complete.

    Args:
        path: of the file.
        document: a FeatureCollection, map frame, metres.
        replace: overwrite an existing file.

    Returns:
        The streets as the service reads them.

    Raises:
        DatasetError: the file exists and ``replace`` is False, or it cannot be written.
        BundleError: the service would refuse the document.
    """
    if path.exists() and not replace:
        raise DatasetError(f"{path} exists; pass --replace", field=path.name)
    text = json.dumps(document, separators=(",", ":"), allow_nan=False)
    streets = Streets.from_geojson(json.loads(text))
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(text + "\n")
        part.replace(path)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be written: {error.strerror or error}", field=path.name) from error
    return streets


def _widened(surface: BaseGeometry) -> BaseGeometry:
    """Parts of a surface that cover ground, on the grid, with simplified edges."""
    parts = [part for part in shapely.get_parts(surface) if isinstance(part, shapely.Polygon)]
    plain = shapely.simplify(shapely.union_all(parts), _EDGE_M)
    return shapely.set_precision(plain.buffer(_EDGE_M, join_style="mitre"), GRID_M)


def _coordinates(shape: BaseGeometry) -> list[list[list[list[float]]]]:
    """GeoJSON coordinates of all parts except slivers. Points already lie on the grid; rounding only shortens their digits."""
    parts = [part for part in shapely.get_parts(shape) if isinstance(part, shapely.Polygon) and part.area >= _SLIVER_M2]
    return [
        [[[round(x, 3), round(y, 3)] for x, y in ring.coords] for ring in (part.exterior, *part.interiors)]
        for part in parts
    ]


def _own_ids(streets: list[NamedStreet]) -> list[str]:
    ids = [street.id for street in streets if street.id is not None]
    most = Counter(ids).most_common(1)
    if most and most[0][1] > 1:
        raise DatasetError(f"two streets have the id {most[0][0]!r}; give each its own id, or none", field="id")
    return ids


def _id_from(street: NamedStreet) -> str:
    text = f"{street.street} {street.section}" if street.section else street.name
    return re.sub(r"\W+", "-", text.casefold()).strip("-") or "street"


def _free(wanted: str, taken: set[str]) -> str:
    if wanted not in taken:
        return wanted
    number = 2
    while f"{wanted}-{number}" in taken:
        number += 1
    return f"{wanted}-{number}"
