"""``streetfix streets``."""

from pathlib import Path
from typing import Annotated, cast

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console

from model_training.datasets.dataset import Dataset
from model_training.streets.collection import StreetCollection, collection_of, write_streets
from model_training.streets.geojson import WIDEST_M, read_geojson
from model_training.streets.map_frame import MapFrame
from model_training.streets.named_street import Lanes, StreetSource
from model_training.streets.opendrive import read_opendrive
from model_training.streets.openstreetmap import read_openstreetmap
from model_training.streets.picture import picture_png
from model_training.streets.sections import Cut, in_sections
from service.errors import DatasetError
from service.maps.streets import FILE, Streets

KINDS = ("geojson", "opendrive", "osm")
_SHOWN = 10


def command(
    kind: Annotated[str, typer.Argument(help="Format of SOURCE: geojson, opendrive or osm.")],
    source: Annotated[Path, typer.Argument(help="Source file: .geojson, .xodr, .osm or .osm.pbf.")],
    dataset: Annotated[Path, typer.Option(help="Dataset folder. The command writes streets.geojson into it.")],
    section_length: Annotated[
        float | None, typer.Option(help="Cut streets longer than this into sections, metres.")
    ] = None,
    sections: Annotated[
        str,
        typer.Option(
            help="ends: the first and last metres of a street are its beginning and end. numbered: equal sections."
        ),
    ] = "ends",
    width: Annotated[
        float | None, typer.Option(help="Width of centre lines, if the source gives none, metres.")
    ] = None,
    lanes: Annotated[str, typer.Option(help="driving: the carriageway. all: also shoulders and pavements.")] = "all",
    frame: Annotated[
        str | None,
        typer.Option(
            help="map: the source has map coordinates, metres. wgs84: the source has degrees or projected "
            "coordinates. The dataset's georeference transforms them into the map.  [default: wgs84 if the dataset "
            "has a georeference]"
        ),
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace an existing streets.geojson.")] = False,
    picture: Annotated[
        Path | None, typer.Option(help="PNG file for a drawing of the streets and the survey's places.")
    ] = None,
) -> None:
    """Import named streets from GeoJSON, OpenDRIVE or OpenStreetMap.

    The command writes the streets into a dataset.

    \b
    Example:
      streetfix streets opendrive Town01.xodr --dataset data/town01 --section-length 80 --picture town01.png
    """
    _require("kind", kind, KINDS)
    _require("sections", sections, ("ends", "numbered"))
    _require("lanes", lanes, ("driving", "all"))
    _require("frame", frame, (None, "map", "wgs84"))
    _require_metres("width", width, WIDEST_M)
    _require_metres("section_length", section_length, 1e6)
    opened = Dataset(dataset)
    if (dataset / FILE).exists() and not replace:
        raise DatasetError(f"{dataset / FILE} exists; pass --replace", field=FILE)
    read = _read(kind, source, opened, frame, cast(Lanes, lanes), width)
    streets = read.streets
    if section_length is not None:
        streets = in_sections(streets, length_m=section_length, cut=cast(Cut, sections))
    collection = collection_of(streets)
    places = opened.survey_poses()[:, :2, 3]
    written = write_streets(dataset / FILE, collection.document, replace=replace)
    if picture is not None:
        try:
            picture.write_bytes(picture_png(written, places))
        except OSError as error:
            raise DatasetError(f"{picture}: cannot be written: {error.strerror or error}", field="picture") from error
    for line in _summary(read, collection, written, places):
        Console(soft_wrap=True, highlight=False).print(line, markup=False)


def _require(name: str, value: str | None, known: tuple[str | None, ...]) -> None:
    if value not in known:
        words = ", ".join(word for word in known if word is not None)
        raise DatasetError(f"{name}: {value!r} is not valid; choose one of: {words}", field=name)


def _require_metres(name: str, value: float | None, most: float) -> None:
    if value is not None and not 0 < value <= most:
        raise DatasetError(f"{name}: {value:g} is not a length in metres between 0 and {most:g}", field=name)


def _read(
    kind: str, source: Path, dataset: Dataset, frame: str | None, lanes: Lanes, width_m: float | None
) -> StreetSource:
    georeference = dataset.description.georeference
    if georeference is None and (frame == "wgs84" or kind == "osm"):
        raise DatasetError(
            f"{dataset.folder}/dataset.json: georeference is null, so WGS-84 coordinates have no position in its map; "
            "import the survey with `streetfix import --georeference LAT,LON`"
            + ("" if kind == "osm" else ", or give --frame map"),
            field="georeference",
        )
    if kind == "osm" and frame == "map":
        raise DatasetError("frame: OpenStreetMap data are in degrees; omit --frame map", field="frame")
    on_earth = None if georeference is None or frame == "map" else MapFrame(georeference)
    if kind == "osm" and on_earth is not None:
        return read_openstreetmap(source, frame=on_earth, lanes=lanes, width_m=width_m)
    if kind == "geojson":
        return read_geojson(source, width_m=width_m, frame=on_earth)
    return read_opendrive(source, lanes=lanes, frame=on_earth)


def _summary(
    read: StreetSource, collection: StreetCollection, written: Streets, places: NDArray[np.float64]
) -> list[str]:
    names = {feature.street for feature in written.features}
    sections = sum(feature.section is not None or feature.name != feature.street for feature in written.features)
    inside = sum(written.index_at(place) >= 0 for place in places)
    lines = [f"{FILE}: {len(names)} streets, {len(written)} polygons, {sections} of them sections"]
    if read.unnamed:
        lines.append(f"roads without a name: {read.unnamed}")
    if collection.overlap_m2 >= 1.0:
        lines.append(f"{collection.overlap_m2:.0f} m2 belong to two streets and were given to the first of them")
    dropped = [*read.dropped, *collection.dropped]
    lines += [f"left out: {each}" for each in dropped[:_SHOWN]]
    if len(dropped) > _SHOWN:
        lines.append(f"left out: {len(dropped) - _SHOWN} more")
    lines.append(f"{inside} of {len(places)} places of the survey are in a street")
    if not inside:
        lines.append("so the streets do not fit the map: check --frame, and look at --picture")
    return lines
