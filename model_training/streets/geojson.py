"""Read the streets of a GeoJSON file: polygons, or centre lines with a width."""

import json
import math
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NoReturn, cast

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry, BaseMultipartGeometry

from model_training.streets.corridor import corridor
from model_training.streets.map_frame import FARTHEST_M, MapFrame
from model_training.streets.named_street import LARGEST_BYTES, LARGEST_M, NamedStreet, Section, StreetSource
from service.errors import DatasetError

#: Width of a centre line without its own width, metres.
DEFAULT_WIDTH_M = 8.0
#: Greatest width that is accepted, metres.
WIDEST_M = 500.0
#: Names of WGS-84 in the ``crs`` of older files. RFC 7946 always uses WGS-84.
_WGS84 = ("urn:ogc:def:crs:OGC:1.3:CRS84", "urn:ogc:def:crs:OGC::CRS84", "OGC:CRS84")
ToMap = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class _Naming:
    """Properties of a feature that name its street."""

    street: str
    name: str
    section: Section | None
    id: str | None


def read_geojson(path: Path, *, width_m: float | None = None, frame: MapFrame | None = None) -> StreetSource:
    """Read a FeatureCollection of streets.

    A feature has a ``name`` or ``street``, and may have ``id``, ``section`` and ``width`` (m).
    Features without an id that have the same street, name and section are joined.

    Args:
        path: of the file.
        width_m: width of centre lines without their own width, metres; None for ``DEFAULT_WIDTH_M``.
        frame: converts longitude and latitude, or the projection that an older file's ``crs`` names, to the map frame.
            None takes the coordinates as map metres.

    Raises:
        DatasetError: the file is no FeatureCollection, a property is invalid, two features have one id, or no feature is a
            named polygon or line. The error names the number of the feature.
    """
    document = _load(path)
    features = document.get("features")
    if document.get("type") != "FeatureCollection" or not isinstance(features, list) or not features:
        raise DatasetError(f"{path}: not a FeatureCollection with features; export it as one", field="features")
    to_map = _to_map(document, frame)
    joined: dict[tuple[str, ...], list[tuple[_Naming, list[BaseGeometry], float]]] = defaultdict(list)
    left_out: Counter[str] = Counter()
    number_of_id: dict[str, int] = {}
    for number, feature in enumerate(features):
        where = f"{path}: features[{number}]"
        naming = _naming(feature, where)
        parts = _parts(feature, to_map, where)
        if naming is None:
            left_out["have no name"] += 1
        elif isinstance(parts, str):
            left_out[parts] += 1
        else:
            key: tuple[str, ...] = (naming.street, naming.name, naming.section or "")
            if naming.id is not None:
                key = (naming.id,)
                if naming.id in number_of_id:
                    raise DatasetError(
                        f"{where}.properties.id: {naming.id!r} is also the id of features[{number_of_id[naming.id]}]; "
                        "give each feature its own id, or none",
                        field="id",
                    )
                number_of_id[naming.id] = number
            joined[key].append((naming, parts, _width(feature, width_m, where)))
    reasons = tuple(f"{count} features {reason}" for reason, count in left_out.items())
    if not joined:
        raise DatasetError(
            f"{path}: no feature is a named polygon or centre line ({'; '.join(reasons)}); streets need a Polygon, MultiPolygon, "
            "LineString or MultiLineString with the property name or street",
            field="features",
        )
    return StreetSource(tuple(_street(group) for group in joined.values()), left_out["have no name"], reasons)


def _load(path: Path) -> dict[str, Any]:
    def refuse(word: str) -> NoReturn:
        raise ValueError(f"{word} is not a valid JSON number")

    try:
        if path.stat().st_size > LARGEST_BYTES:
            raise DatasetError(
                f"{path}: larger than {LARGEST_BYTES} bytes; reduce it to the surroundings of the survey",
                field=path.name,
            )
        document = json.loads(path.read_bytes(), parse_constant=refuse)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}", field=path.name) from error
    except (ValueError, RecursionError) as error:
        raise DatasetError(
            f"{path}: not valid JSON: {error}; the file may be incomplete, export it again", field=path.name
        ) from error
    if not isinstance(document, dict):
        raise DatasetError(f"{path}: not a GeoJSON object; export it as a FeatureCollection", field=path.name)
    return document


def _to_map(document: dict[str, Any], frame: MapFrame | None) -> ToMap:
    if frame is None:
        return lambda points: points
    crs = document.get("crs")
    named = crs.get("properties") if isinstance(crs, dict) else None
    projection = named.get("name") if isinstance(named, dict) else None
    if isinstance(projection, str) and projection not in _WGS84:
        return lambda points: frame.from_projection(points, projection)
    return frame.from_wgs84


def _naming(feature: Any, where: str) -> _Naming | None:
    if not isinstance(feature, dict) or not isinstance(feature.get("properties") or {}, dict):
        raise DatasetError(f"{where}: not a Feature with properties; export the file again", field="properties")
    properties = feature.get("properties") or {}
    name, street, section = properties.get("name"), properties.get("street"), properties.get("section")
    identity = properties.get("id")
    for field, text in (("name", name), ("street", street), ("id", identity)):
        if text is not None and not (isinstance(text, str) and len(text) <= 200):
            raise DatasetError(
                f"{where}.properties.{field}: {str(text)[:40]!r} is not a text of at most 200 characters; correct it",
                field=field,
            )
    if section not in ("beginning", "end", None):
        raise DatasetError(
            f"{where}.properties.section: {str(section)[:40]!r} is not beginning, end or null; put it into the name",
            field="section",
        )
    known = name or street
    if not known:
        return None
    return _Naming(street or known, known, cast(Literal["beginning", "end"] | None, section), identity or None)


def _parts(feature: dict[str, Any], to_map: ToMap, where: str) -> list[BaseGeometry] | str:
    """Polygons or lines of a feature in the map frame, or the reason why it has none."""
    geometry = feature.get("geometry")
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if not isinstance(geometry, dict) or kind not in ("Polygon", "MultiPolygon", "LineString", "MultiLineString"):
        return f"have the type {str(kind)[:40]}, which covers no area"
    try:
        with np.errstate(invalid="ignore"):
            shape = shapely.geometry.shape(geometry)
            placed = shapely.transform(shapely.force_2d(shape), to_map)
    except (TypeError, ValueError, IndexError, KeyError, AttributeError, shapely.errors.ShapelyError) as error:
        raise DatasetError(
            f"{where}.geometry: its coordinates are not a valid {kind}: {error}; correct them", field="geometry"
        ) from error
    if not (np.abs(shapely.get_coordinates(placed)) <= LARGEST_M).all():
        return f"are more than {FARTHEST_M / 1000:.0f} km from the map's origin, or not finite (are they WGS-84?)"
    repaired = shapely.make_valid(placed) if "Polygon" in kind else placed
    wanted: type[BaseGeometry] = shapely.Polygon if "Polygon" in kind else shapely.LineString
    parts = [part for part in _leaves(repaired) if isinstance(part, wanted) and not part.is_empty and part.length > 0]
    return parts or "cover no area"


def _leaves(shape: BaseGeometry) -> list[BaseGeometry]:
    """Simple parts of a geometry, also of nested collections."""
    if not isinstance(shape, BaseMultipartGeometry):
        return [shape]
    return [leaf for part in shape.geoms for leaf in _leaves(part)]


def _width(feature: dict[str, Any], width_m: float | None, where: str) -> float:
    given = (feature.get("properties") or {}).get("width")
    if given is None:
        return DEFAULT_WIDTH_M if width_m is None else width_m
    try:
        width = float(given)
    except (TypeError, ValueError):
        width = math.nan
    if not 0 < width <= WIDEST_M:
        raise DatasetError(
            f"{where}.properties.width: {str(given)[:40]!r} is not a width in metres between 0 and {WIDEST_M:g}; "
            "correct it, or remove it to use the default",
            field="width",
        )
    return width


def _street(group: list[tuple[_Naming, list[BaseGeometry], float]]) -> NamedStreet:
    naming = group[0][0]
    lines = [(part, width) for _, parts, width in group for part in parts if isinstance(part, shapely.LineString)]
    polygons = [part for _, parts, _ in group for part in parts if isinstance(part, shapely.Polygon)]
    along = corridor([line for line, _ in lines], [width for _, width in lines])
    return NamedStreet(
        street=naming.street,
        name=naming.name,
        surface=shapely.union_all([*polygons, along]),
        lines=tuple(line for line, _ in lines),
        section=naming.section,
        id=naming.id,
        divisible=naming.section is None,
    )
