import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from model_training.datasets.dataset import DatasetDescription, Sensors, write_description, write_tum
from service.maps.streets import Streets

ULM = {"latitude_deg": 48.4, "longitude_deg": 9.99, "height_m": 480.0}
LANES = '<left><lane id="1" type="driving"><width sOffset="0" a="4" b="0" c="0" d="0"/></lane></left>'


def road_of(
    identity: int,
    geometry: str = "<line/>",
    *,
    length: float = 100.0,
    name: str = "",
    x: float = 0.0,
    y: float = 0.0,
    hdg: float = 0.0,
    junction: int = -1,
    link: str = "",
    offset: str = "",
    lanes: str = LANES,
) -> str:
    """Return a <road> of one geometry and one lane section; by default 100 m to the east, one lane of 4 m on the left."""
    drawn = f'<geometry s="0" x="{x}" y="{y}" hdg="{hdg}" length="{length}">{geometry}</geometry>'
    return (
        f'<road id="{identity}" name="{name}" length="{length}" junction="{junction}"><link>{link}</link>'
        f'<planView>{drawn}</planView><lanes>{offset}<laneSection s="0">{lanes}</laneSection></lanes></road>'
    )


@pytest.fixture
def road() -> Callable[..., str]:
    return road_of


@pytest.fixture
def xodr(tmp_path: Path) -> Callable[..., Path]:
    """Write an OpenDRIVE file of roads and junctions."""

    def write(*elements: str, header: str = "") -> Path:
        path = tmp_path / "map.xodr"
        path.write_text(f"<OpenDRIVE><header>{header}</header>{''.join(elements)}</OpenDRIVE>")
        return path

    return write


@pytest.fixture
def geojson(tmp_path: Path) -> Callable[..., Path]:
    """Write a FeatureCollection of (geometry type, coordinates, properties)."""

    def write(*features: tuple[str, Any, Mapping[str, Any]], **more: Any) -> Path:
        path = tmp_path / "map.geojson"
        written = [
            {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}
            for kind, coordinates, properties in features
        ]
        path.write_text(json.dumps({"type": "FeatureCollection", "features": written} | more))
        return path

    return write


@pytest.fixture
def osm(tmp_path: Path) -> Callable[..., Path]:
    """Write OpenStreetMap XML of ways with node coordinates (longitude, latitude) and tags. Equal coordinates are one node."""

    def write(*ways: tuple[Sequence[tuple[float, float]], Mapping[str, str]]) -> Path:
        path = tmp_path / "map.osm"
        places = list(dict.fromkeys(place for nodes, _ in ways for place in nodes))
        lines = [
            f'<node id="{number + 1}" version="1" lon="{lon:.9f}" lat="{lat:.9f}"/>'
            for number, (lon, lat) in enumerate(places)
        ]
        for number, (nodes, tags) in enumerate(ways):
            refs = "".join(f'<nd ref="{places.index(node) + 1}"/>' for node in nodes)
            tagged = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
            lines.append(f'<way id="{number + 1}" version="1">{refs}{tagged}</way>')
        path.write_text(f'<osm version="0.6">{"".join(lines)}</osm>')
        return path

    return write


@pytest.fixture
def ulm() -> dict[str, float]:
    return dict(ULM)


@pytest.fixture
def dataset(tmp_path: Path) -> Callable[..., Path]:
    """Return a dataset folder with survey scans at given positions (m)."""

    def write(*places: tuple[float, float], georeference: Mapping[str, float] | None = None) -> Path:
        folder = tmp_path / "dataset"
        folder.mkdir()
        poses = np.tile(np.eye(4), (len(places), 1, 1))
        poses[:, :2, 3] = places
        write_tum(folder / "survey" / "poses.txt", np.arange(float(len(places))), poses)
        described = DatasetDescription(
            name="town", source={}, sensors=Sensors(), georeference=None if georeference is None else dict(georeference)
        )
        write_description(folder, described)
        return folder

    return write


@pytest.fixture
def streets_in() -> Callable[[Path], Streets]:
    """Return the streets of a dataset as the service reads them."""
    return lambda folder: Streets.from_geojson(json.loads((folder / "streets.geojson").read_text()))


@pytest.fixture
def town01() -> Path:
    path = Path(__file__).parents[4] / "shared" / "data" / "carla_xodr" / "Town01.xodr"
    if not path.is_file():
        pytest.skip("CARLA's Town01 (../shared/data/carla_xodr) is not here")
    return path
