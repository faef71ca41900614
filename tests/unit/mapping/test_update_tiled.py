"""A tiled map gets a new survey: the tiles in its reach change as a bundle would, and the others stay the same files."""

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from model_training.cli.map_care import app
from model_training.datasets.dataset import Dataset, scan_path, write_tum
from model_training.mapping import build_tiled as driver
from model_training.mapping.build_tile import build_tile
from model_training.mapping.build_tiled import build_tiled
from model_training.mapping.join import of_places
from model_training.mapping.settings import BuildSettings
from model_training.mapping.stored_map import content_of, voxels_of
from model_training.mapping.tiles import TILE_MARGIN_M, Square
from model_training.mapping.update_tiled import _without_places, update_tiled
from model_training.mapping.verify import damage_of
from model_training.mapping.work import work_folder
from service.errors import BundleError, DatasetError
from service.maps.manifest import read_manifest
from service.maps.reader import MapBundle
from service.maps.tiled_writer import write_tiled
from service.maps.writer import write_bundle

SETTINGS = BuildSettings(
    name="town", headings=6, spacing_m=5.0, between_m=0.0, voxel_m=0.6, calibration=None, align_survey=False, traffic_vote=False
)  # fmt: skip
#: The street of 60 m lies in two tiles. One more tile is far from it.
TILE_M, FAR = 50.0, (40, -7)
WRITE = "model_training.mapping.update_tiled.write_bundle"


def written(
    source: Dataset, folder: Path, numbers: Any, demolished: Any = lambda points: np.zeros(len(points), bool)
) -> Dataset:
    """Write a dataset with some scans of another one, and without the points of a demolished block (map frame)."""
    shutil.copytree(source.folder, folder, ignore=shutil.ignore_patterns("scans", "queries"))
    stamps, poses = source.survey_trajectory()
    (folder / "survey" / "scans").mkdir()
    for number, k in enumerate(numbers):
        points, T = source.scan(k), poses[k]
        gone = demolished(points[:, :3] @ T[:3, :3].T + T[:3, 3])
        points[~gone].astype("<f4").tofile(scan_path(folder, number))
    write_tum(folder / "survey" / "poses.txt", stamps[list(numbers)], poses[list(numbers)])
    return Dataset(folder)


def in_this_process(_engine: str, tasks: Any, *, on_progress: Any, **_: Any) -> None:
    for index, task in enumerate(tasks):
        build_tile(task, partial(on_progress, index))


def built(dataset: Dataset, encoder: Path, out: Path, settings: BuildSettings = SETTINGS) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driver, "run", in_this_process)
        build_tiled(dataset, encoder, out, settings, tile_m=TILE_M)
    return out


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tiled")


@pytest.fixture(scope="module")
def whole(small_dataset: Dataset, encoder_file: Path, folder: Path) -> Path:
    """The map of the whole street, and a tile far away."""
    plain = built(small_dataset, encoder_file, folder / "plain")
    tiles = {(tile.column, tile.row): plain / tile.folder for tile in read_manifest(plain).tiles}
    bundle = MapBundle.open(next(iter(tiles.values())))
    first = np.arange(len(bundle.places)) == 0
    write_bundle(folder / "far", of_places(content_of(bundle), first))
    write_tiled(folder / "whole", {**tiles, FAR: folder / "far"}, TILE_M, name="town")
    return folder / "whole"


@pytest.fixture(scope="module")
def first(small_dataset: Dataset, folder: Path) -> Dataset:
    """The first half of the street."""
    return written(small_dataset, folder / "first", range(len(small_dataset.survey_poses()) // 2))


@pytest.fixture(scope="module")
def half(first: Dataset, encoder_file: Path, folder: Path) -> Path:
    return built(first, encoder_file, folder / "half")


@pytest.fixture(scope="module")
def second(small_dataset: Dataset, folder: Path) -> Dataset:
    count = len(small_dataset.survey_poses())
    return written(small_dataset, folder / "second", range(count // 2, count))


def tiles(path: Path) -> dict[tuple[int, int], Path]:
    return {(tile.column, tile.row): path / tile.folder for tile in read_manifest(path).tiles}


def voxels(square: tuple[int, int], path: Path) -> dict[bytes, int]:
    """Return the number of points of each voxel of a tile, by its cell. The edge of the margin cuts voxels, so they do not count."""
    of_tile = voxels_of(MapBundle.open(path))
    found, inside = of_tile.statistics(), Square(*square, TILE_M).within(TILE_MARGIN_M - 0.6, of_tile.means())
    return {
        cell.tobytes(): int(points) for cell, points in zip(found["cell"][inside], found["points"][inside], strict=True)
    }


def xy(path: Path) -> np.ndarray:
    places = MapBundle.open(path).T_map_place[:, :2, 3]
    return places[np.lexsort(places.T)]


def test_the_second_half_makes_the_map_of_the_whole(half: Path, second: Dataset, whole: Path, tmp_path: Path) -> None:
    made = update_tiled(half, second, tmp_path / "m", threads=1)
    assert damage_of(tmp_path / "m") == []
    expected, found = tiles(whole), tiles(tmp_path / "m")
    assert found.keys() == expected.keys() - {FAR}
    assert read_manifest(half).counts.places < made.counts.places == sum(len(xy(expected[square])) for square in found)
    for square, tile in found.items():
        np.testing.assert_allclose(xy(tile), xy(expected[square]), atol=1e-9)
        assert voxels(square, tile) == voxels(square, expected[square])
    assert not work_folder(tmp_path / "m").exists()


def test_a_square_without_a_tile_gets_one(whole: Path, small_dataset: Dataset, second: Dataset, tmp_path: Path) -> None:
    """The old map has one of the two tiles of the street. The new tile has the points of the old survey in its margin too."""
    of_whole = tiles(whole)
    present, missing = sorted(of_whole.keys() - {FAR})
    write_tiled(tmp_path / "old", {present: of_whole[present], FAR: of_whole[FAR]}, TILE_M, name="town")
    update_tiled(tmp_path / "old", small_dataset, tmp_path / "m", threads=1)
    found = tiles(tmp_path / "m")
    assert found.keys() == of_whole.keys()
    np.testing.assert_allclose(xy(found[missing]), xy(of_whole[missing]), atol=1e-9)
    counts, expected = voxels(missing, found[missing]), voxels(missing, of_whole[missing])
    assert counts.keys() == expected.keys()
    assert {counts[cell] / expected[cell] for cell in counts} == {1.0, 2.0}
    counted = MapBundle.open(found[missing]).manifest.parameters["survey_scans"]
    assert counted == MapBundle.open(of_whole[missing]).manifest.parameters["survey_scans"]


def test_tiles_out_of_reach_stay_the_same_files(whole: Path, second: Dataset, tmp_path: Path) -> None:
    update_tiled(whole, second, tmp_path / "m", threads=1)
    before, after = tiles(whole), tiles(tmp_path / "m")
    assert [square for square in before if before[square].name == after[square].name] == [FAR]
    one, other = (path[FAR] / "places.npy" for path in (before, after))
    assert one.stat().st_ino == other.stat().st_ino


@pytest.fixture(scope="module")
def rebuilt(small_dataset: Dataset, whole: Path, folder: Path) -> tuple[Dataset, Any]:
    """A survey after the demolition of everything higher than 1 m, 7.5 m around the middle of the street; and which points these are."""
    places = np.concatenate(
        [MapBundle.open(tile).T_map_place[:, :3, 3] for square, tile in tiles(whole).items() if square != FAR]
    )
    along = int(np.ptp(places[:, 1]) > np.ptp(places[:, 0]))
    middle, ground = float(places[:, along].mean()), float(places[:, 2].mean()) - read_manifest(whole).lidar_height_m

    def standing(points: np.ndarray) -> np.ndarray:
        return np.asarray((np.abs(points[:, along] - middle) < 7.5) & (points[:, 2] > ground + 1.0))

    count = len(small_dataset.survey_poses())
    return written(small_dataset, folder / "rebuilt", range(count), standing), standing


def standing_in(path: Path, standing: Any) -> list[int]:
    """Return for each tile how many voxels of the block near the street it has."""
    found = []
    for square, tile in tiles(path).items():
        means = voxels_of(MapBundle.open(tile)).means()
        near = np.min(np.linalg.norm(means[:, None, :2] - xy(tile)[None], axis=2), axis=1) < 8.0
        found += [int((standing(means) & near).sum())] if square != FAR else []
    return found


def test_a_rebuilt_block_is_replaced_in_every_tile_that_sees_it(
    whole: Path, rebuilt: tuple[Dataset, Any], tmp_path: Path
) -> None:
    survey, standing = rebuilt
    before = standing_in(whole, standing)
    update_tiled(whole, survey, tmp_path / "added", threads=1)
    update_tiled(whole, survey, tmp_path / "replaced", replace_covered=True, threads=1)
    assert damage_of(tmp_path / "replaced") == []
    assert min(before) > 30
    for was, added, replaced in zip(
        before, standing_in(tmp_path / "added", standing), standing_in(tmp_path / "replaced", standing), strict=True
    ):
        assert added > 0.8 * was
        assert replaced < 0.2 * was
    assert read_manifest(tmp_path / "replaced").counts.places == read_manifest(whole).counts.places


def polygon(path: Path, low: Any, high: Any) -> Path:
    ring = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]], [low[0], low[1]]]
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [[[float(x) for x in corner] for corner in ring]]}))
    return path


def test_a_polygon_empties_tiles_that_the_survey_does_not_reach(
    whole: Path, small_dataset: Dataset, second: Dataset, tmp_path: Path
) -> None:
    """The tile far away has one place, which the polygon holds. So this tile goes."""
    everything = polygon(tmp_path / "area.geojson", (-5000, -5000), (5000, 5000))
    made = update_tiled(whole, second, tmp_path / "m", replace_area=everything, threads=1)
    assert tiles(tmp_path / "m").keys() == tiles(whole).keys() - {FAR}
    assert made.counts.places == len(second.survey_poses())


def test_a_polygon_without_a_place_of_the_survey_is_refused(whole: Path, second: Dataset, tmp_path: Path) -> None:
    far = polygon(tmp_path / "area.geojson", (9000, 9000), (9100, 9100))
    with pytest.raises(DatasetError, match="no place of the new survey lies in the polygon"):
        update_tiled(whole, second, tmp_path / "m", replace_area=far, threads=1)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["area.geojson"]


def test_a_killed_update_keeps_its_finished_tiles(
    whole: Path, second: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = update_tiled(whole, second, tmp_path / "expected", threads=1)
    written_tiles: list[Path] = []

    def dying(path: Path, *arguments: Any) -> Any:
        if written_tiles:
            raise KeyboardInterrupt
        written_tiles.append(path)
        return write_bundle(path, *arguments)

    monkeypatch.setattr(WRITE, dying)
    with pytest.raises(KeyboardInterrupt):
        update_tiled(whole, second, tmp_path / "m", threads=1)
    assert not (tmp_path / "m").exists()
    first = written_tiles.copy()
    written_tiles.clear()
    monkeypatch.setattr(WRITE, lambda path, *rest: written_tiles.append(path) or write_bundle(path, *rest))
    made = update_tiled(whole, second, tmp_path / "m", threads=1)
    assert len(written_tiles) == 1  # of two changed tiles
    assert written_tiles != first
    assert made.version == expected.version
    assert not work_folder(tmp_path / "m").exists()


def test_tiles_of_other_options_are_not_taken(
    whole: Path, second: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A killed update without the vote is started again with it, then with another street."""
    written_tiles: list[Path] = []

    def dying(path: Path, *arguments: Any) -> Any:
        written_tiles.append(path)
        write_bundle(path, *arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(WRITE, dying)
    changed = shutil.copytree(second.folder, tmp_path / "more streets")
    streets = json.loads((changed / "streets.geojson").read_text())
    streets["features"][0]["properties"] |= {"id": "new", "name": "New street"}
    (changed / "streets.geojson").write_text(json.dumps(streets))
    for dataset, vote in ((second, False), (second, True), (Dataset(changed), True)):
        with pytest.raises(KeyboardInterrupt):
            update_tiled(whole, dataset, tmp_path / "m", passes_vote=vote, threads=1)
    assert len(set(written_tiles)) == 3


def test_the_usual_settings_work_on_tiles_too(
    first: Dataset, second: Dataset, encoder_file: Path, tmp_path: Path
) -> None:
    """Alignment, traffic vote, places between scans and the vote of passes."""
    usual = BuildSettings(name="town", headings=6, spacing_m=5.0, voxel_m=0.6, calibration=None)
    built(first, encoder_file, tmp_path / "old", usual)
    made = update_tiled(tmp_path / "old", second, tmp_path / "m", passes_vote=True, threads=1)
    assert damage_of(tmp_path / "m") == []
    assert made.counts.places > read_manifest(tmp_path / "old").counts.places
    assert made.parameters["traffic_vote"] == made.parameters["survey_aligned"] == 1.0


def test_a_new_tile_does_not_take_over_the_site_check_of_another(whole: Path, calibration_json: Any) -> None:
    tile = content_of(MapBundle.open(tiles(whole)[FAR]))
    site = {"offset": 0.1, "queries": 9, "right": 8, "expected_calibration_error": 0.01}
    found = _without_places(replace(tile, calibration=calibration_json(site=site)))
    assert found.calibration["site"] is None
    assert found.parameters["survey_scans"] == 0.0
    assert len(found.T_map_place) == 0


@pytest.mark.parametrize(("name", "values"), [("voxel_m", (0.6, 0.3)), ("between_m", (0.0, 3.0))])
def test_tiles_of_different_settings_are_refused(
    whole: Path, second: Dataset, tmp_path: Path, name: str, values: tuple[float, float]
) -> None:
    content = content_of(MapBundle.open(tiles(whole)[FAR]))
    for k, value in enumerate(values):
        parameters = {**content.parameters, name: value}
        write_bundle(tmp_path / f"{k}", replace(content, parameters=parameters))
    write_tiled(tmp_path / "old", {(k, 0): tmp_path / f"{k}" for k in range(2)}, TILE_M, name="town")
    with pytest.raises(BundleError, match=f"its tiles have different {name}") as refused:
        update_tiled(tmp_path / "old", second, tmp_path / "m", threads=1)
    assert refused.value.field == name


def test_a_street_that_contradicts_the_maps_is_refused_before_the_work(
    whole: Path, second: Dataset, tmp_path: Path
) -> None:
    changed = shutil.copytree(second.folder, tmp_path / "renamed")
    streets = json.loads((changed / "streets.geojson").read_text())
    streets["features"][0]["properties"]["name"] = "Another street"
    (changed / "streets.geojson").write_text(json.dumps(streets))
    told: list[Any] = []
    for replaced in (False, True):
        with pytest.raises(BundleError, match="both maps have a street"):
            update_tiled(
                whole,
                Dataset(changed),
                tmp_path / "m",
                replace_covered=replaced,
                report=lambda *each: told.append(each),
            )
    assert told == []


def test_the_command_updates_a_tiled_map(whole: Path, second: Dataset, tmp_path: Path) -> None:
    found = CliRunner().invoke(app, ["update", str(whole), str(second.folder), "--out", str(tmp_path / "m")])
    assert found.exit_code == 0, found.output
    assert "map town" in found.output
    again = CliRunner().invoke(app, ["diff", str(whole), str(tmp_path / "m")])
    assert "2 changed, 1 kept" in again.output
