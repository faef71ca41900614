import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from model_training.cli.streets import command
from service.errors import DatasetError
from service.geometry.earth import Georeference

NAMED = {"name": "High Street"}
LINE = ("LineString", [[0, 0], [100, 0]], NAMED)


@pytest.fixture
def run():
    app = typer.Typer()
    app.command()(command)

    def call(*arguments):
        done = CliRunner().invoke(app, [str(argument) for argument in arguments])
        if isinstance(done.exception, DatasetError):
            raise done.exception
        assert done.exit_code == 0, done.output
        return done.stdout

    return call


def test_centre_lines_become_streets_of_the_dataset(run, geojson, dataset, streets_in):
    folder = dataset((50, 0), (50, 90))
    out = run("geojson", geojson(LINE), "--dataset", folder, "--width", "10", "--section-length", "60")
    assert [street.name for street in streets_in(folder).features] == ["Beginning of High Street", "End of High Street"]
    assert "1 streets, 2 polygons, 2 of them sections" in out
    assert "1 of 2 places of the survey are in a street" in out


def test_an_opendrive_map_without_names_says_how_many(run, xodr, road, dataset, streets_in):
    folder = dataset((50, 2))
    out = run("opendrive", xodr(road(1), road(2, y=50)), "--dataset", folder)
    assert "roads without a name: 2" in out
    assert [street.name for street in streets_in(folder).features] == ["Road 1", "Road 2"]


def test_openstreetmap_lands_in_the_georeferenced_map(run, osm, dataset, streets_in, ulm):
    ends = [Georeference(**ulm).to_earth(np.array([x, 20.0, 0.0]))[1::-1] for x in (0.0, 100.0)]
    folder = dataset((50, 20), georeference=ulm)
    run("osm", osm((ends, {"highway": "residential", "name": "Mill Lane"})), "--dataset", folder)
    streets = streets_in(folder)
    assert streets[streets.index_at(np.array([50.0, 20.0]))].name == "Mill Lane"


def test_a_picture_is_drawn(run, geojson, dataset, tmp_path):
    run("geojson", geojson(LINE), "--dataset", dataset((50, 0)), "--picture", tmp_path / "map.png")
    picture = cv2.imread(str(tmp_path / "map.png"))
    assert picture is not None
    assert picture.shape[1] == 1600
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 3


def test_streets_away_from_the_survey_are_reported(run, geojson, dataset):
    out = run("geojson", geojson(LINE), "--dataset", dataset((5000, 5000)))
    assert "0 of 1 places" in out
    assert "do not fit the map" in out


def test_streets_that_are_there_stay_unless_they_may_go(run, geojson, dataset):
    folder = dataset((50, 0))
    run("geojson", geojson(LINE), "--dataset", folder)
    with pytest.raises(DatasetError, match="exists; pass --replace"):
        run("geojson", geojson(LINE), "--dataset", folder)
    run("geojson", geojson(LINE), "--dataset", folder, "--replace")


def test_degrees_in_a_georeferenced_dataset_can_be_declared_metres(run, geojson, dataset, streets_in, ulm):
    folder = dataset((50, 0), georeference=ulm)
    run("geojson", geojson(LINE), "--dataset", folder, "--frame", "map")
    assert streets_in(folder).index_at(np.array([99.0, 3.0])) == 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("shapefile",), "kind: 'shapefile' is not valid; choose one of: geojson, opendrive, osm"),
        (("geojson", "--frame", "utm"), "frame: 'utm' is not valid; choose one of"),
        (("geojson", "--lanes", "bus"), "lanes: 'bus' is not valid; choose one of"),
        (("geojson", "--sections", "thirds"), "sections: 'thirds' is not valid; choose one of"),
        (("geojson", "--width", "0"), "width: 0 is not a length in metres"),
        (("geojson", "--section-length", "nan"), "section_length: nan is not a length"),
        (("geojson", "--frame", "wgs84"), "georeference is null.*or give --frame map"),
        (("osm",), "georeference is null"),
    ],
)
def test_an_invalid_combination_is_refused_by_name(run, geojson, dataset, arguments, said):
    kind, *options = arguments
    with pytest.raises(DatasetError, match=said):
        run(kind, geojson(LINE), "--dataset", dataset((50, 0)), *options)
