"""A tiled map gets a new survey: the tiles in its reach change as a bundle would, and the others stay the same files."""

import importlib.util
import json
import multiprocessing
import os
import pickle
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from model_training.cli.map_care import app
from model_training.datasets.dataset import Dataset, scan_path, write_tum
from model_training.datasets.stored_survey import dataset_at
from model_training.mapping import engines
from model_training.mapping.build import build_map
from model_training.mapping.build_tiled import build_tiled
from model_training.mapping.join import of_places
from model_training.mapping.settings import BuildSettings
from model_training.mapping.stored_map import content_of, voxels_of
from model_training.mapping.tile_area import Square, TileArea
from model_training.mapping.tiled_care import merge_tiled
from model_training.mapping.update_tile import SURFEL_BYTES, UpdateTask, _without_places, memory_of, update_tile
from model_training.mapping.update_tiled import update_tiled
from model_training.mapping.verify import damage_of
from model_training.mapping.work import work_folder
from service.errors import BundleError, DatasetError, ExtraMissingError
from service.maps.manifest import read_manifest
from service.maps.reader import MapBundle
from service.maps.tiled_writer import write_tiled
from service.maps.tiles import TiledMap
from service.maps.writer import write_bundle

SETTINGS = BuildSettings(
    name="town", headings=6, spacing_m=5.0, between_m=0.0, voxel_m=0.6, calibration=None, align_survey=False, traffic_vote=False
)  # fmt: skip
#: The street of 60 m lies in two tiles. One more tile is far from it.
TILE_M, FAR = 50.0, (40, -7)
WRITE = "model_training.mapping.update_tile.write_bundle"


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


def in_this_process(_engine: str, tasks: Any, do: Any, *, on_progress: Any, **_: Any) -> None:
    for index, task in enumerate(tasks):
        do(task, partial(on_progress, index))
        on_progress(index, 1.0)


@pytest.fixture
def serial(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace both engines, because processes take seconds to start."""
    monkeypatch.setattr(engines, "run", in_this_process)


def built(dataset: Dataset, encoder: Path, out: Path, settings: BuildSettings = SETTINGS) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engines, "run", in_this_process)
        build_tiled(dataset, encoder, out, settings, tile_m=TILE_M)
    return out


@pytest.fixture(scope="module")
def small_dataset(sparse_survey: Dataset) -> Dataset:
    """Replace the dataset of other tests."""
    return sparse_survey


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
    """Return the number of points of each voxel of a tile, by its cell. The edge of the cloud cuts voxels, so they do not count."""
    of_tile, area = (
        voxels_of(MapBundle.open(path)),
        TileArea(Square(*square, TILE_M), set(tiles(path.parents[1])), SETTINGS.voxel_m),
    )
    found, means = of_tile.statistics(), of_tile.means()
    inside = np.all([area.is_in_cloud(means + (x, y, 0.0)) for x in (-0.6, 0.6) for y in (-0.6, 0.6)], axis=0)
    return {
        cell.tobytes(): int(points) for cell, points in zip(found["cell"][inside], found["points"][inside], strict=True)
    }


def xy(path: Path) -> np.ndarray:
    places = MapBundle.open(path).T_map_place[:, :2, 3]
    return places[np.lexsort(places.T)]


@pytest.mark.usefixtures("serial")
def test_the_second_half_makes_the_map_of_the_whole(half: Path, second: Dataset, whole: Path, tmp_path: Path) -> None:
    made = update_tiled(half, second, tmp_path / "m")
    assert damage_of(tmp_path / "m") == []
    expected, found = tiles(whole), tiles(tmp_path / "m")
    assert found.keys() == expected.keys() - {FAR}
    assert read_manifest(half).counts.places < made.counts.places == sum(len(xy(expected[square])) for square in found)
    for square, tile in found.items():
        np.testing.assert_allclose(xy(tile), xy(expected[square]), atol=1e-9)
        assert voxels(square, tile) == voxels(square, expected[square])
    assert not work_folder(tmp_path / "m").exists()


@pytest.mark.usefixtures("serial")
def test_a_square_without_a_tile_gets_one(
    whole: Path, small_dataset: Dataset, encoder_file: Path, tmp_path: Path
) -> None:
    """The old survey drove in one of the two squares of the street. The new tile has its points in the other square too."""
    of_whole = tiles(whole)
    present, missing = sorted(of_whole.keys() - {FAR})
    columns = np.floor(small_dataset.survey_poses()[:, :2, 3] / TILE_M).astype(int)
    driven = np.flatnonzero((columns == present).all(axis=1)).tolist()
    built(written(small_dataset, tmp_path / "driven", driven), encoder_file, tmp_path / "old")
    assert tiles(tmp_path / "old").keys() == {present}
    update_tiled(tmp_path / "old", small_dataset, tmp_path / "m")
    found = tiles(tmp_path / "m")
    assert found.keys() == {present, missing}
    np.testing.assert_allclose(xy(found[missing]), xy(of_whole[missing]), atol=1e-9)
    counts, expected = voxels(missing, found[missing]), voxels(missing, of_whole[missing])
    assert counts.keys() == expected.keys()
    ratios = [counts[cell] / expected[cell] for cell in counts]  # the edge of the old cloud cuts voxels
    assert {1.0, 2.0} <= set(ratios)
    assert 1.0 <= min(ratios) <= max(ratios) <= 2.0
    counted = MapBundle.open(found[missing]).manifest.parameters["survey_scans"]
    assert counted == MapBundle.open(of_whole[missing]).manifest.parameters["survey_scans"]


@pytest.mark.usefixtures("serial")
def test_tiles_out_of_reach_stay_the_same_files(whole: Path, second: Dataset, tmp_path: Path) -> None:
    update_tiled(whole, second, tmp_path / "m")
    before, after = tiles(whole), tiles(tmp_path / "m")
    assert [square for square in before if before[square].name == after[square].name] == [FAR]
    one, other = (path[FAR] / "places.npy" for path in (before, after))
    assert one.stat().st_ino == other.stat().st_ino


@pytest.fixture(scope="module")
def driven(small_dataset: Dataset, whole: Path, folder: Path) -> tuple[Dataset, Dataset]:
    """The scans of one square of the street, and one scan of the other square, near the first."""
    present, _ = sorted(tiles(whole).keys() - {FAR})
    T = small_dataset.survey_poses()[:, :2, 3]
    inside = (np.floor(T / TILE_M) == present).all(axis=1)
    near = int(np.argmin(np.where(inside, np.inf, np.linalg.norm(T - T[inside].mean(axis=0), axis=1))))
    first = written(small_dataset, folder / "in-square", np.flatnonzero(inside).tolist())
    return first, written(small_dataset, folder / "beside", [near])


def seen_from(path: Path, position_m: np.ndarray) -> np.ndarray:
    """Return the surfels that a camera sees within 40 m, map frame, metres (n, 3)."""
    cloud = TiledMap.open(path).cloud
    assert cloud is not None
    surfels = cloud.at(position_m)
    rows = np.concatenate(
        [
            first + np.arange(cube["first"], cube["first"] + cube["count"])
            for piece, first in zip(
                surfels.pieces, np.cumsum([0, *(len(each.surfels) for each in surfels.pieces)]), strict=False
            )
            for cube in piece.cubes
        ]
    )
    xyz = surfels.unpacked(rows)["xyz"] + surfels.origin_m
    return xyz[np.linalg.norm(xyz[:, :2] - position_m[:2], axis=1) < 40.0]


def lost(before: np.ndarray, after: np.ndarray) -> int:
    """Return how many surfels have none within 1.2 m afterwards."""
    tree: Any = cKDTree(after)
    return int((tree.query(before)[0] > 1.2).sum())


@pytest.mark.usefixtures("serial")
def test_no_surface_is_lost_where_a_new_tile_appears(
    driven: tuple[Dataset, Dataset], encoder_file: Path, tmp_path: Path
) -> None:
    """The first map alone has the surfaces of both squares. The second survey gives the other square its own tile."""
    first, second = driven
    one, other = (built(each, encoder_file, tmp_path / name) for each, name in ((first, "one"), (second, "other")))
    T = first.survey_poses()[:, :3, 3]
    at = T[np.argmin(np.linalg.norm(T - second.survey_poses()[0, :3, 3], axis=1))]
    merge_tiled(one, other, tmp_path / "merged")
    update_tiled(one, second, tmp_path / "updated")
    before = seen_from(one, at)
    assert len(before) > 1000
    for name in ("merged", "updated"):
        assert len(tiles(tmp_path / name)) == 2
        assert damage_of(tmp_path / name) == []
        assert lost(before, seen_from(tmp_path / name, at)) == 0
        for square, tile in tiles(tmp_path / name).items():
            area = TileArea(Square(*square, TILE_M), set(tiles(tmp_path / name)), SETTINGS.voxel_m)
            assert area.is_in_cloud(voxels_of(MapBundle.open(tile)).means()).all()


@pytest.mark.usefixtures("serial")
def test_no_surface_of_the_survey_is_lost_where_a_tile_goes(
    driven: tuple[Dataset, Dataset], whole: Path, encoder_file: Path, tmp_path: Path
) -> None:
    """The polygon empties the whole map, and the survey drives in one of the two squares. It sees the other one too."""
    survey, _ = driven
    area = polygon(tmp_path / "all.geojson", (-5000.0, -5000.0), (5000.0, 5000.0))
    update_tiled(whole, survey, tmp_path / "m", replace_area=area)
    built(survey, encoder_file, tmp_path / "alone")
    assert tiles(tmp_path / "m").keys() == tiles(tmp_path / "alone").keys()
    for at in survey.survey_poses()[:, :3, 3]:
        assert lost(seen_from(tmp_path / "alone", at), seen_from(tmp_path / "m", at)) == 0


@pytest.mark.usefixtures("serial")
def test_a_plain_bundle_is_no_tile_among_others(
    small_dataset: Dataset, whole: Path, encoder_file: Path, tmp_path: Path
) -> None:
    build_map(small_dataset, encoder_file, tmp_path / "plain", replace(SETTINGS, name="plain"), threads=1)
    write_tiled(tmp_path / "one", {FAR: tmp_path / "plain"}, TILE_M, name="one")
    TiledMap.open(tmp_path / "one").tiles.get(0)
    refused = "its cloud does not fit to those of other tiles, as in a map of one bundle; build the map with --tile-m"
    with pytest.raises(BundleError, match=refused):
        update_tiled(tmp_path / "one", small_dataset, tmp_path / "m")
    both = dict([next(iter(tiles(whole).items())), (FAR, tmp_path / "plain")])
    with pytest.raises(BundleError, match=refused):
        write_tiled(tmp_path / "m", both, TILE_M, name="m")
    assert not (tmp_path / "m").exists()


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


@pytest.mark.usefixtures("serial")
def test_a_rebuilt_block_is_replaced_in_every_tile_that_sees_it(
    whole: Path, rebuilt: tuple[Dataset, Any], tmp_path: Path
) -> None:
    survey, standing = rebuilt
    before = standing_in(whole, standing)
    update_tiled(whole, survey, tmp_path / "added")
    update_tiled(whole, survey, tmp_path / "replaced", replace_covered=True)
    assert damage_of(tmp_path / "replaced") == []
    assert min(before) >= 20
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


@pytest.mark.usefixtures("serial")
def test_a_polygon_empties_tiles_that_the_survey_does_not_reach(
    whole: Path, small_dataset: Dataset, second: Dataset, tmp_path: Path
) -> None:
    """The tile far away has one place, which the polygon holds. So this tile goes."""
    everything = polygon(tmp_path / "area.geojson", (-5000, -5000), (5000, 5000))
    made = update_tiled(whole, second, tmp_path / "m", replace_area=everything)
    assert tiles(tmp_path / "m").keys() == tiles(whole).keys() - {FAR}
    assert made.counts.places == len(second.survey_poses())


@pytest.mark.usefixtures("serial")
def test_a_polygon_without_a_place_of_the_survey_is_refused(whole: Path, second: Dataset, tmp_path: Path) -> None:
    far = polygon(tmp_path / "area.geojson", (9000, 9000), (9100, 9100))
    with pytest.raises(DatasetError, match="no place of the new survey lies in the polygon"):
        update_tiled(whole, second, tmp_path / "m", replace_area=far)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["area.geojson"]


def files_of(path: Path) -> dict[str, bytes]:
    """Return every file of a map; manifests without the time of the update."""
    found = {str(p.relative_to(path)): p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}
    for name in [name for name in found if name.endswith("manifest.json")]:
        manifest = json.loads(found[name])
        del manifest["made_at"]
        found[name] = json.dumps(manifest).encode()
    return found


@pytest.fixture(scope="module")
def undisturbed(whole: Path, second: Dataset, folder: Path) -> dict[str, bytes]:
    """The files of an update in this process, which nothing disturbed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engines, "run", in_this_process)
        update_tiled(whole, second, folder / "undisturbed")
    return files_of(folder / "undisturbed")


@pytest.mark.usefixtures("serial")
def test_a_killed_update_keeps_its_finished_tiles(
    whole: Path, second: Dataset, undisturbed: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written_tiles: list[Path] = []

    def dying(path: Path, *arguments: Any) -> Any:
        if written_tiles:
            raise KeyboardInterrupt
        written_tiles.append(path)
        return write_bundle(path, *arguments)

    monkeypatch.setattr(WRITE, dying)
    with pytest.raises(KeyboardInterrupt):
        update_tiled(whole, second, tmp_path / "m")
    assert not (tmp_path / "m").exists()
    first = written_tiles.copy()
    written_tiles.clear()
    monkeypatch.setattr(WRITE, lambda path, *rest: written_tiles.append(path) or write_bundle(path, *rest))
    told: list[Any] = []
    update_tiled(whole, second, tmp_path / "m", report=lambda *event: told.append(event))
    assert len(written_tiles) == 1  # of two changed tiles
    assert written_tiles != first
    assert files_of(tmp_path / "m") == undisturbed
    assert not work_folder(tmp_path / "m").exists()
    # Each of the two tiles reads all scans, and one tile was finished.
    scans, done = len(second.survey_poses()), [event[1] for event in told if event[0] == "scans of 2 tiles"]
    assert (done[0], done[-1]) == (scans, 2 * scans)
    assert done == sorted(done)


@pytest.mark.usefixtures("serial")
def test_a_survey_in_object_storage_gives_the_same_map(
    whole: Path, second: Dataset, upload: Callable[[Dataset], str], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    """Each tile fetches its own scans and deletes them, so one tile's scans at most are there."""
    out, there = tmp_path / "m", list[int]()

    def report(stage: str, *_: int) -> None:
        there.append(len(list(work_folder(out).glob(".tile_*.scans"))))

    with dataset_at(upload(second), out) as survey:
        update_tiled(whole, survey, out, report=report)
    assert files_of(out) == undisturbed
    assert max(there) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m"]


def test_processes_give_the_same_bytes_although_one_is_killed(
    whole: Path, second: Dataset, undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    """The parent kills a process at its first report. A second one continues the tile."""
    killed: list[Any] = []
    said: list[str] = []

    def report(stage: str, *_: int) -> None:
        if stage.startswith("scans") and not killed and multiprocessing.active_children():
            killed.append(multiprocessing.active_children()[0])
            killed[0].kill()

    update_tiled(whole, second, tmp_path / "m", workers=2, report=report, warn=said.append)
    assert files_of(tmp_path / "m") == undisturbed
    assert len(killed) == len(said) == 1
    assert re.match(
        r"tile -?\d, -?\d: its process was killed by SIGKILL .*; the tile goes on in another process", said[0]
    )


def test_an_interrupted_update_ends_its_process_and_can_go_on(
    whole: Path, second: Dataset, undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    """Ctrl-C comes while the only worker is at its second tile."""
    out, scans = tmp_path / "m", len(second.survey_poses())

    def report(stage: str, done: int, _total: int) -> None:
        if stage.startswith("scans") and done >= scans and multiprocessing.active_children():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        update_tiled(whole, second, out, workers=1, report=report)
    assert multiprocessing.active_children() == []
    assert not out.exists()
    update_tiled(whole, second, out, workers=1)
    assert files_of(out) == undisturbed
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m"]


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the extra `ray`")
def test_ray_gives_the_same_bytes(whole: Path, second: Dataset, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from service.cli.start import main; main()", "map", "update", str(whole)]
    command += [str(second.folder), "--out", str(tmp_path / "m"), "--engine", "ray", "--workers", "2"]
    environment = {name: value for name, value in os.environ.items() if name != "RAY_ADDRESS"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    assert files_of(tmp_path / "m") == undisturbed


@pytest.fixture
def tasks_of(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return the planned tiles of an update that does not begin them."""

    def planned(dataset: Dataset, old: Path = whole) -> list[UpdateTask]:
        found: list[UpdateTask] = []

        def run(_engine: str, tasks: Any, *_: Any, **__: Any) -> None:
            found.extend(tasks)
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(engines, "run", run)
            with pytest.raises(KeyboardInterrupt):
                update_tiled(old, dataset, tmp_path / "planned")
        return found

    return planned


def test_a_task_can_be_sent_to_another_process(second: Dataset, tasks_of: Any, tmp_path: Path) -> None:
    task = tasks_of(second)[0]
    again = pickle.loads(pickle.dumps(task))  # noqa: S301  # of this test
    assert (again.key, again.folder, again.name) == (task.key, task.folder, task.name)
    assert again.update.key(again.update.survey(tmp_path)) == task.key
    assert all(path.is_absolute() for path in (task.update.old, task.update.source.folder, task.folder))


def test_a_process_that_sees_other_scans_refuses_the_tile(second: Dataset, tasks_of: Any, tmp_path: Path) -> None:
    own = Dataset(shutil.copytree(second.folder, tmp_path / "own"))
    task = tasks_of(own)[0]
    os.utime(scan_path(own.folder, 0), ns=(1, 1))
    with pytest.raises(
        BundleError, match=r"tile -?\d, -?\d: this process reads other scans, another map.*do not change"
    ):
        update_tile(task)
    assert not task.is_finished


def test_the_encoder_has_one_thread_whatever_the_machine_has(
    second: Dataset, tasks_of: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    class StoppedError(Exception):
        pass

    def opened(_: bytes, *, threads: int) -> Any:
        asked.append(threads)
        raise StoppedError

    task, asked = tasks_of(second)[0], list[int]()
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr("model_training.mapping.update_tile.Encoder.open", opened)
    with pytest.raises(StoppedError):
        update_tile(task)
    assert asked == [1]


def test_a_process_needs_memory_for_its_scans_and_for_the_voxels_of_the_old_tile(
    whole: Path, small_dataset: Dataset, second: Dataset, tasks_of: Any, tmp_path: Path
) -> None:
    """A new tile reads the tiles around it one after the other. The largest of them counts."""
    surfels = {square: read_manifest(tile).counts.cloud_points for square, tile in tiles(whole).items()}
    for task in tasks_of(second):
        square = task.update.part.square
        expected = engines.PROCESS_BYTES + len(second.survey_poses()) * engines.SCAN_BYTES
        assert memory_of(task) == expected + SURFEL_BYTES * surfels[square.column, square.row]
    present, missing = sorted(surfels.keys() - {FAR})
    write_tiled(tmp_path / "old", {present: tiles(whole)[present], FAR: tiles(whole)[FAR]}, TILE_M, name="town")
    new = {
        (task.update.part.square.column, task.update.part.square.row): task
        for task in tasks_of(small_dataset, tmp_path / "old")
    }
    expected = engines.PROCESS_BYTES + len(small_dataset.survey_poses()) * engines.SCAN_BYTES
    assert memory_of(new[missing]) == expected + SURFEL_BYTES * surfels[present]


@pytest.mark.usefixtures("serial")
def test_a_tile_that_lost_all_places_is_finished_too(
    whole: Path, second: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The update is killed after its last tile, while it joins the tiles."""
    everything = polygon(tmp_path / "area.geojson", (-5000, -5000), (5000, 5000))
    begun: list[int] = []

    def killed(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    def counting(engine: str, tasks: Any, do: Any, **options: Any) -> None:
        begun.append(len(tasks))
        in_this_process(engine, tasks, do, **options)

    monkeypatch.setattr(engines, "run", counting)
    with monkeypatch.context() as patch:
        patch.setattr("model_training.mapping.update_tiled.write_tiled", killed)
        with pytest.raises(KeyboardInterrupt):
            update_tiled(whole, second, tmp_path / "m", replace_area=everything)
    update_tiled(whole, second, tmp_path / "m", replace_area=everything)
    assert begun == [3, 0]
    assert FAR not in tiles(tmp_path / "m")


def test_an_engine_that_cannot_run_is_refused_before_the_work(
    whole: Path, second: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def update(**options: Any) -> None:
        update_tiled(whole, second, tmp_path / "m", report=lambda *_: pytest.fail("it began"), **options)

    with pytest.raises(DatasetError, match="engine: 'slurm' is unknown; give local or ray"):
        update(engine="slurm")
    with pytest.raises(DatasetError, match="workers: 0 is not valid; give 1 or more"):
        update(workers=0)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ExtraMissingError, match=r"--engine ray needs the package 'ray': .*\[ray\]"):
        update(engine="ray")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("serial")
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
            update_tiled(whole, dataset, tmp_path / "m", passes_vote=vote)
    assert len(set(written_tiles)) == 3


@pytest.mark.usefixtures("serial")
def test_the_usual_settings_work_on_tiles_too(
    first: Dataset, second: Dataset, encoder_file: Path, tmp_path: Path
) -> None:
    """Alignment, traffic vote, places between scans and the vote of passes."""
    usual = BuildSettings(name="town", headings=6, spacing_m=5.0, voxel_m=0.6, calibration=None)
    built(first, encoder_file, tmp_path / "old", usual)
    made = update_tiled(tmp_path / "old", second, tmp_path / "m", passes_vote=True)
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
@pytest.mark.usefixtures("serial")
def test_tiles_of_different_settings_are_refused(
    whole: Path, second: Dataset, tmp_path: Path, name: str, values: tuple[float, float]
) -> None:
    content = content_of(MapBundle.open(tiles(whole)[FAR]))
    for k, value in enumerate(values):
        parameters = {**content.parameters, name: value}
        write_bundle(tmp_path / f"{k}", replace(content, parameters=parameters))
    write_tiled(tmp_path / "old", {(k, 0): tmp_path / f"{k}" for k in range(2)}, TILE_M, name="town")
    with pytest.raises(BundleError, match=f"its tiles have different {name}") as refused:
        update_tiled(tmp_path / "old", second, tmp_path / "m")
    assert refused.value.field == name


@pytest.mark.usefixtures("serial")
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


@pytest.mark.usefixtures("serial")
def test_the_command_updates_a_tiled_map(whole: Path, second: Dataset, tmp_path: Path) -> None:
    found = CliRunner().invoke(app, ["update", str(whole), str(second.folder), "--out", str(tmp_path / "m")])
    assert found.exit_code == 0, found.output
    assert "map town" in found.output
    again = CliRunner().invoke(app, ["diff", str(whole), str(tmp_path / "m")])
    assert "2 changed, 1 kept" in again.output


@pytest.mark.usefixtures("serial")
def test_the_command_reads_a_survey_in_object_storage(
    whole: Path, second: Dataset, upload: Callable[[Dataset], str], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    found = CliRunner().invoke(app, ["update", str(whole), upload(second), "--out", str(tmp_path / "m")])
    assert found.exit_code == 0, found.output
    assert files_of(tmp_path / "m") == undisturbed


@pytest.mark.usefixtures("serial")
def test_an_error_names_the_url_of_the_survey(
    whole: Path, second: Dataset, upload: Callable[[Dataset], str], tmp_path: Path
) -> None:
    moved = Dataset(shutil.copytree(second.folder, tmp_path / "moved"))
    described = json.loads((moved.folder / "dataset.json").read_text())
    described["georeference"] = {"latitude_deg": 48.0, "longitude_deg": 9.0, "altitude_m": 0.0, "heading_deg": 0.0}
    (moved.folder / "dataset.json").write_text(json.dumps(described))
    url = upload(moved)
    with (
        pytest.raises(DatasetError, match=f"{re.escape(url)}: the georeference of the dataset is .* of the map"),
        dataset_at(url, tmp_path / "m") as survey,
    ):
        update_tiled(whole, survey, tmp_path / "m")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["moved"]


def test_the_options_of_the_command_reach_the_engine(
    whole: Path, second: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []

    def run(engine: str, tasks: Any, do: Any, *, workers: int | None, warn: Any, **options: Any) -> None:
        asked.append((engine, workers))
        warn("tile 1, 2: its process died")
        in_this_process(engine, tasks, do, **options)

    monkeypatch.setattr(engines, "run", run)
    arguments = ["update", str(whole), str(second.folder), "--out", str(tmp_path / "m")]
    found = CliRunner().invoke(app, [*arguments, "--engine", "local", "--workers", "3"])
    assert found.exit_code == 0, found.output
    assert asked == [("local", 3)]
    assert "tile 1, 2: its process died" in found.stderr


@pytest.mark.parametrize("option", [("--workers", "2"), ("--engine", "local")])
def test_the_command_refuses_options_of_tiles_for_a_map_of_one_bundle(
    whole: Path, second: Dataset, tmp_path: Path, option: tuple[str, str]
) -> None:
    bundle = tiles(whole)[FAR]
    found = CliRunner().invoke(app, ["update", str(bundle), str(second.folder), "--out", str(tmp_path / "m"), *option])
    assert found.exit_code == 2
    said = " ".join(found.output.split())
    assert f"Invalid value for {option[0]}: it builds tiles;" in said
    assert "is a map of one bundle, so omit the option" in said
    assert list(tmp_path.iterdir()) == []
