"""Surveys with other georeferences become maps of one frame: the same squares on the ground, and the same answers."""

import json
import shutil
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from model_training.cli.build_map import command
from model_training.datasets.dataset import Dataset, write_tum
from model_training.datasets.frames import global_frame
from model_training.datasets.stored_survey import dataset_at
from model_training.evaluation.evaluate import evaluate
from model_training.mapping import engines
from model_training.mapping.build import build_map
from model_training.mapping.build_tiled import build_tiled
from model_training.mapping.frame_choice import in_chosen_frame
from model_training.mapping.merge import merge_maps
from model_training.mapping.settings import BuildSettings
from model_training.mapping.update import update_map
from model_training.mapping.update_tiled import update_tiled
from service.errors import BundleError, DatasetError
from service.geometry.earth import Georeference
from service.maps.manifest import read_manifest
from service.maps.reader import MapBundle

SETTINGS = BuildSettings(
    name="town", headings=6, spacing_m=5.0, between_m=0.0, voxel_m=0.6, calibration=None, align_survey=False, traffic_vote=False
)  # fmt: skip
#: Two origins of surveys in one town. The second one is 3 km to the south-west and 60 m lower.
ULM, NEU_ULM = Georeference(48.4, 9.98, 478.0), Georeference(48.38, 9.95, 418.0)
ORIGIN = Georeference(48.4, 10.0, 0.0)


def at(small: Dataset, folder: Path, origin: Georeference) -> Dataset:
    """Write a survey of the same street whose poses are in the frame of another origin."""
    shutil.copytree(small.folder, folder)
    description = json.loads((folder / "dataset.json").read_text()) | {"georeference": asdict(ULM)}
    (folder / "dataset.json").write_text(json.dumps(description))
    moved = Dataset(folder).in_frame(asdict(origin))
    sets = {name: moved.folder / "queries" / name / "poses.txt" for name in moved.query_sets(with_truth=True)}
    truths = {name: [frame.T_map_camera for frame in moved.queries(name)] for name in sets}
    streets, (stamps, poses) = moved.streets(), moved.survey_trajectory()
    (folder / "dataset.json").write_text(json.dumps(description | {"georeference": asdict(origin)}))
    (folder / "streets.geojson").write_text(json.dumps(streets))
    write_tum(folder / "survey" / "poses.txt", stamps, poses)
    for name, file in sets.items():
        write_tum(file, np.arange(len(truths[name]), dtype=float), np.array(truths[name]))
    return Dataset(folder)


@pytest.fixture(scope="module")
def surveys(small_dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, Dataset]:
    folder = tmp_path_factory.mktemp("surveys")
    return at(small_dataset, folder / "ulm", ULM), at(small_dataset, folder / "neu_ulm", NEU_ULM)


@pytest.fixture(scope="module")
def first_map(surveys: tuple[Dataset, Dataset], encoder_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a map of the first survey in the frame of its dataset."""
    out = tmp_path_factory.mktemp("first") / "map"
    build_map(surveys[0], encoder_file, out, SETTINGS, threads=1)
    return out


def places(path: Path) -> np.ndarray:
    return MapBundle.open(path).T_map_place


def test_tiles_of_two_surveys_are_the_same_squares_of_the_global_frame(
    surveys: Any, encoder_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def in_this_process(_engine: str, tasks: Any, do: Any, *, on_progress: Any, **_: Any) -> None:
        for index, task in enumerate(tasks):
            do(task, partial(on_progress, index))

    monkeypatch.setattr(engines, "run", in_this_process)
    for survey in surveys:
        moved = in_chosen_frame(survey, None, tiled=True)
        build_tiled(moved, encoder_file, tmp_path / survey.folder.name, SETTINGS, tile_m=50.0)
    update_tiled(tmp_path / "ulm", surveys[1], tmp_path / "updated")
    first, *others = (read_manifest(tmp_path / name) for name in ("ulm", "neu_ulm", "updated"))
    assert first.georeference == asdict(ORIGIN)
    # 0.02 degrees of longitude are 1,481 m at this latitude. The street reaches 30 m to both sides.
    assert {each.column for each in first.tiles} == {-31, -30}
    for other in others:
        assert other.georeference == first.georeference
        for one, same in zip(first.tiles, other.tiles, strict=True):
            assert (one.column, one.row) == (same.column, same.row)
    for name, other in zip(("neu_ulm", "updated"), others, strict=True):
        for one, same in zip(first.tiles, other.tiles, strict=True):
            bundles = MapBundle.open(tmp_path / "ulm" / one.folder), MapBundle.open(tmp_path / name / same.folder)
            # An update adds no place, because every place of its survey has an old place beside it.
            np.testing.assert_allclose(bundles[0].T_map_place, bundles[1].T_map_place, atol=1e-5)
            assert bundles[0].streets is not None
            assert bundles[0].place_street.tolist() == bundles[1].place_street.tolist()


def test_a_map_in_the_frame_of_another_one_merges_with_it(
    surveys: Any, encoder_file: Path, first_map: Path, tmp_path: Path
) -> None:
    moved = in_chosen_frame(surveys[1], str(first_map), tiled=False)
    build_map(moved, encoder_file, tmp_path / "second", SETTINGS, threads=1)
    np.testing.assert_allclose(places(tmp_path / "second"), places(first_map), atol=1e-5)
    made = merge_maps(first_map, tmp_path / "second", tmp_path / "both")
    assert made.counts.places == len(places(first_map))  # all places of the second map lie on those of the first one


def test_an_update_moves_the_survey_into_the_frame_of_the_map(surveys: Any, first_map: Path, tmp_path: Path) -> None:
    made = update_map(first_map, surveys[1], tmp_path / "updated", threads=1)
    assert made.georeference == asdict(ULM)
    np.testing.assert_allclose(places(tmp_path / "updated"), places(first_map), atol=1e-9)
    assert made.counts.streets == read_manifest(first_map).counts.streets


def test_an_evaluation_moves_the_ground_truth_into_the_frame_of_the_map(surveys: Any, first_map: Path) -> None:
    bundle = MapBundle.open(first_map)
    names = surveys[0].query_sets(with_truth=True)[:1]
    found = [evaluate(bundle, survey, names, refine=False).predictions[names[0]] for survey in surveys]
    np.testing.assert_allclose(found[0].T_true, found[1].T_true, atol=1e-5)
    np.testing.assert_array_equal(found[0].T_answer, found[1].T_answer)


def test_the_usual_frame_of_a_map_of_one_bundle_is_that_of_the_survey(surveys: Any) -> None:
    assert in_chosen_frame(surveys[0], None, tiled=False) is surveys[0]
    assert in_chosen_frame(surveys[0], "survey", tiled=True) is surveys[0]


def test_the_usual_frame_of_tiles_without_a_place_on_the_earth_is_that_of_the_survey(small_dataset: Dataset) -> None:
    assert in_chosen_frame(small_dataset, None, tiled=True) is small_dataset


def test_a_survey_in_a_store_is_moved_as_well(surveys: Any, tmp_path: Path) -> None:
    store = tmp_path / "store"
    shutil.copytree(surveys[0].folder, store, ignore=shutil.ignore_patterns("queries"))
    with dataset_at(store.as_uri(), tmp_path / "map") as given:
        moved = in_chosen_frame(given, "global", tiled=False)
        expected = in_chosen_frame(surveys[0], "global", tiled=False)
        np.testing.assert_array_equal(moved.survey_poses(), expected.survey_poses())
        assert moved.streets() == expected.streets()


def test_the_error_of_a_survey_in_a_store_that_is_far_from_the_map_names_the_url(surveys: Any, tmp_path: Path) -> None:
    store = tmp_path / "store"
    shutil.copytree(surveys[0].folder, store, ignore=shutil.ignore_patterns("queries"))
    with dataset_at(store.as_uri(), tmp_path / "map") as given, pytest.raises(DatasetError) as refused:
        given.in_frame(asdict(Georeference(40.7, -74.0)))
    assert refused.value.message.startswith(f"{store.as_uri()}: the dataset lies ")


@pytest.mark.parametrize("frame", ["global", "maps/other"])
def test_a_survey_without_a_place_on_the_earth_cannot_be_moved(small_dataset: Dataset, frame: str) -> None:
    with pytest.raises(DatasetError, match=r"georeference is null, .* or give --frame survey") as refused:
        in_chosen_frame(small_dataset, frame, tiled=True)
    assert refused.value.field == "georeference"


def test_a_map_without_a_place_on_the_earth_has_no_frame_to_take(surveys: Any, small_map: Path) -> None:
    with pytest.raises(BundleError, match="the map has no georeference") as refused:
        in_chosen_frame(surveys[0], str(small_map), tiled=False)
    assert refused.value.field == "frame"


def test_a_frame_that_is_no_map_is_named(surveys: Any, tmp_path: Path) -> None:
    with pytest.raises(BundleError, match="not a map bundle"):
        in_chosen_frame(surveys[0], str(tmp_path / "nowhere"), tiled=False)


def test_the_command_takes_the_frame(surveys: Any, encoder_file: Path, tmp_path: Path) -> None:
    options = [
        "--encoder",
        str(encoder_file),
        "--headings",
        "6",
        "--spacing",
        "20",
        "--no-align-survey",
        "--no-traffic-vote",
    ]
    app = typer.Typer()
    app.command()(command)
    done = CliRunner().invoke(
        app, [str(surveys[1].folder), "--out", str(tmp_path / "map"), "--frame", "global", *options]
    )
    assert done.exit_code == 0, done.output
    assert read_manifest(tmp_path / "map").georeference == asdict(ORIGIN)
    assert global_frame(NEU_ULM, surveys[1].survey_poses()[:, :3, 3]) == ORIGIN
