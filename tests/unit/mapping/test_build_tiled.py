"""A tiled build has the content of an untiled one. It does not depend on the engine, on kills, or on the number of processes."""

import importlib.util
import json
import multiprocessing
import os
import pickle
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import typer
from scipy.spatial import cKDTree

from model_training.cli.build_map import command
from model_training.datasets.dataset import Dataset
from model_training.datasets.stored_survey import dataset_at
from model_training.datasets.survey_part import SurveyPart
from model_training.mapping import build_tiled as driver
from model_training.mapping import engines, site_check, tile_area
from model_training.mapping.build import build_map, describe
from model_training.mapping.build_tile import build_tile, key_of_tile
from model_training.mapping.build_tiled import build_tiled
from model_training.mapping.seams import read_positions
from model_training.mapping.settings import BuildSettings
from model_training.mapping.tile_area import Square, TileArea
from model_training.mapping.work import work_folder
from model_training.tasks import local
from service.errors import BundleError, DatasetError, ExtraMissingError
from service.maps.manifest import read_manifest
from service.maps.reader import MapBundle
from service.retrieval.encoder import Encoder

#: 11 scans along 60 m; the map frame's axes cut them into two tiles.
SETTINGS = BuildSettings(name="tiled", headings=6, spacing_m=5.0, between_m=3.0, voxel_m=0.6, calibration=None)
TILE_M = 50.0
#: At the edge of a cloud, voxels are cut. Points whose surroundings are in the cloud do not count there, metres.
BESIDE = [(x, y, 0.0) for x in (-1.0, 1.0) for y in (-1.0, 1.0)]


class KilledError(Exception):
    """Stands for the end of the process."""


def files_of(folder):
    """Return every file of a map; manifests without the time of the build."""
    found = {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
    for name in [name for name in found if name.endswith("manifest.json")]:
        manifest = json.loads(found[name])
        del manifest["made_at"]
        found[name] = json.dumps(manifest).encode()
    return found


def in_this_process(_engine, tasks, do, *, on_progress, **_):
    """Replace both engines, because processes take seconds to start."""
    for index, task in enumerate(tasks):
        do(task, partial(on_progress, index))
        on_progress(index, 1.0)


@pytest.fixture
def serial(monkeypatch):
    monkeypatch.setattr(engines, "run", in_this_process)


@pytest.fixture(scope="module")
def small_dataset(sparse_survey):
    """Replace the dataset of other tests."""
    return sparse_survey


@pytest.fixture(scope="module")
def tiled(small_dataset, encoder_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("tiled") / "m"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engines, "run", in_this_process)
        build_tiled(small_dataset, encoder_file, out, SETTINGS, tile_m=TILE_M)
    return out


@pytest.fixture(scope="module")
def undisturbed(tiled):
    """Return the files of a build that nothing disturbed."""
    return files_of(tiled)


@pytest.fixture
def tasks_of(small_dataset, encoder_file, tmp_path, monkeypatch):
    """Return the planned tiles of a build that does not begin them."""

    def planned(dataset=small_dataset, settings=SETTINGS):
        found = []
        with monkeypatch.context() as patch:

            def run(_engine, tasks, _do, **_):
                found.extend(tasks)
                raise KilledError

            patch.setattr(engines, "run", run)
            with pytest.raises(KilledError):
                build_tiled(dataset, encoder_file, tmp_path / "planned", settings, tile_m=TILE_M)
        return found

    return planned


def test_a_build_says_how_far_its_tiles_disagree_and_warns_if_that_is_much(
    small_dataset, encoder_file, serial, tmp_path, monkeypatch
):
    """The poses of the survey are exact, so the tiles agree. Then the alignment of one tile puts its scans 7 cm aside."""
    told, warned = [], []
    build_tiled(
        small_dataset, encoder_file, tmp_path / "a", SETTINGS, tile_m=TILE_M, tell=told.append, warn=warned.append
    )
    assert len(told) == 1
    assert "scans are in several tiles" in told[0]
    assert warned == []
    aside_m = iter([0.0, 0.07])

    def moved(file):
        positions_m = read_positions(file)
        assert positions_m is not None
        return positions_m + [0.0, 0.0, next(aside_m)]

    monkeypatch.setattr(driver, "read_positions", moved)
    build_tiled(
        small_dataset, encoder_file, tmp_path / "b", SETTINGS, tile_m=TILE_M, tell=told.append, warn=warned.append
    )
    assert len(told) == 2
    assert len(warned) == 1
    assert "the tiles disagree by up to 7 cm" in warned[0]
    unaligned = replace(SETTINGS, align_survey=False)
    build_tiled(small_dataset, encoder_file, tmp_path / "c", unaligned, tile_m=TILE_M, tell=told.append)
    assert len(told) == 2


def test_a_tiled_map_has_every_place_of_an_untiled_one_in_its_square(small_dataset, encoder_file, serial, tmp_path):
    settings = replace(SETTINGS, align_survey=False)
    build_map(small_dataset, encoder_file, tmp_path / "whole", settings, threads=1)
    made = build_tiled(small_dataset, encoder_file, tmp_path / "tiled", settings, tile_m=TILE_M)
    whole = MapBundle.open(tmp_path / "whole")
    assert made.tile_m == TILE_M
    assert [(tile.column, tile.row) for tile in made.tiles] == [(-1, -1), (0, -1)]
    assert made.counts.places == whole.manifest.counts.places
    rows = []
    for tile in made.tiles:
        bundle = MapBundle.open(tmp_path / "tiled" / tile.folder)
        assert bundle.manifest.parameters["tile_overlap_m"] == pytest.approx(1.0 + 2 * 0.6)
        corner, xy = np.array([tile.column, tile.row]) * TILE_M, bundle.T_map_place[:, :2, 3]
        assert ((xy >= corner) & (xy < corner + TILE_M)).all()
        rows += places_of(bundle)
    rows, expected = sorted(rows, key=lambda row: row[0]), sorted(places_of(whole), key=lambda row: row[0])
    np.testing.assert_allclose([xy for xy, _ in rows], [xy for xy, _ in expected], atol=1e-9)
    np.testing.assert_array_equal([views for _, views in rows], [views for _, views in expected])


def places_of(bundle):
    """Return the position and the descriptors of each place."""
    views = bundle.view_index.vectors(np.arange(len(bundle.view_place)))
    return list(zip(bundle.T_map_place[:, :2, 3].tolist(), views.reshape(len(bundle.T_map_place), -1), strict=True))


def test_the_cloud_of_a_tile_is_that_of_an_untiled_map_around_its_square(small_dataset, encoder_file, serial, tmp_path):
    settings = replace(SETTINGS, align_survey=False, passes_vote=True)
    build_map(small_dataset, encoder_file, tmp_path / "whole", settings, threads=1)
    made = build_tiled(small_dataset, encoder_file, tmp_path / "tiled", settings, tile_m=TILE_M)
    whole = positions_of(MapBundle.open(tmp_path / "whole").cloud)
    squares = {(tile.column, tile.row) for tile in made.tiles}
    for tile in made.tiles:
        area = TileArea(Square(tile.column, tile.row, TILE_M), squares, SETTINGS.voxel_m)
        found = positions_of(MapBundle.open(tmp_path / "tiled" / tile.folder).cloud)
        assert area.is_in_cloud(found).all()
        for some, every in ((found, whole), (whole, found)):
            inner = some[np.all([area.is_in_cloud(some + beside) for beside in BESIDE], axis=0)]
            tree: Any = cKDTree(every)
            distance, nearest = tree.query(inner)
            assert len(inner) == len(set(nearest.tolist())) > 1000
            assert distance.max() < 1e-3  # half a step in each map


def positions_of(cloud):
    """Return the positions of the surfels in the map frame."""
    return cloud.unpacked(np.s_[:])["xyz"].astype(np.float64) + cloud.origin_m


def test_a_survey_of_one_square_gives_a_tiled_map_of_one_tile(small_dataset, encoder_file, serial, tmp_path):
    class Moved(Dataset):
        def survey_poses(self):
            poses = super().survey_poses()
            poses[:, :2, 3] += 500.0
            return poses

    made = build_tiled(Moved(small_dataset.folder), encoder_file, tmp_path / "m", SETTINGS, tile_m=1000.0)
    assert [(tile.column, tile.row) for tile in made.tiles] == [(0, 0)]
    assert describe(made).endswith(", tiles of 1000 m: 1")


def test_progress_counts_the_scans_of_all_tiles(small_dataset, encoder_file, serial, tmp_path):
    told = []
    build_tiled(
        small_dataset, encoder_file, tmp_path / "m", SETTINGS, tile_m=TILE_M, report=lambda *event: told.append(event)
    )
    done = [event[1] for event in told if event[0] == "scans of 2 tiles"]
    assert done == sorted(done)
    assert (done[0], done[-1]) == (0, 2 * len(small_dataset.survey_poses()))
    assert Counter(stage for stage, *_ in told).keys() == {"planning tiles", "scans of 2 tiles", "joining tiles"}
    assert not work_folder(tmp_path / "m").exists()


def test_a_killed_build_goes_on_with_the_unfinished_tiles(
    small_dataset, encoder_file, undisturbed, serial, tmp_path, monkeypatch
):
    def killed_after_one(engine, tasks, do, **options):
        in_this_process(engine, tasks[:1], do, **options)
        raise KeyboardInterrupt

    out, built = tmp_path / "m", []
    with monkeypatch.context() as patch:
        patch.setattr(engines, "run", killed_after_one)
        with pytest.raises(KeyboardInterrupt):
            build_tiled(small_dataset, encoder_file, out, SETTINGS, tile_m=TILE_M)
    assert not out.exists()
    monkeypatch.setattr(
        engines, "run", lambda *args, **options: built.append(len(args[1])) or in_this_process(*args, **options)
    )
    build_tiled(small_dataset, encoder_file, out, SETTINGS, tile_m=TILE_M)
    assert built == [1]
    assert files_of(out) == undisturbed
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m"]


def test_tiles_of_other_settings_are_removed(small_dataset, encoder_file, undisturbed, serial, tmp_path, monkeypatch):
    out = tmp_path / "m"
    with monkeypatch.context() as patch:
        patch.setattr(driver, "write_tiled", lambda *_, **__: (_ for _ in ()).throw(KilledError))
        for settings in (replace(SETTINGS, headings=5), SETTINGS):
            with pytest.raises(KilledError):
                build_tiled(small_dataset, encoder_file, out, settings, tile_m=TILE_M)
    kept = [path for path in work_folder(out).iterdir() if path.is_dir()]
    assert [read_manifest(path).headings for path in kept] == [6, 6]
    build_tiled(small_dataset, encoder_file, out, SETTINGS, tile_m=TILE_M)
    assert files_of(out) == undisturbed


def test_only_the_scans_of_a_tile_are_in_its_key(tasks_of, small_dataset, tmp_path):
    own = Dataset(shutil.copytree(small_dataset.folder, tmp_path / "own"))
    task = tasks_of(own)[0]
    few = np.arange(5)
    part = SurveyPart(own.folder, few, task.poses[few])

    def key(**changed):
        settings = replace(task.settings, **changed)
        return key_of_tile(part, "e", settings, task.part, task.common)

    before = key()
    os.utime(own.folder / "survey" / "scans" / "000007.bin", ns=(1, 1))
    assert key() == before
    others = [key(name="other"), key(licence="CC0-1.0"), key(passes_vote=True), key(headings=7)]
    os.utime(own.folder / "survey" / "scans" / "000002.bin", ns=(1, 1))
    assert len({before, key(), *others}) == 6


def test_a_task_can_be_sent_to_another_process(tasks_of):
    task = tasks_of()[0]
    again = pickle.loads(pickle.dumps(task))  # noqa: S301  # of this test
    assert (again.key, again.folder, again.part.square) == (task.key, task.folder, task.part.square)
    assert len(task.numbers) == len(task.poses) == len(task.part.order)


def test_a_process_that_sees_other_scans_refuses_the_tile(tasks_of, small_dataset, tmp_path):
    own = Dataset(shutil.copytree(small_dataset.folder, tmp_path / "own"))
    task = tasks_of(own)[0]
    os.utime(own.folder / "survey" / "scans" / "000002.bin", ns=(1, 1))
    with pytest.raises(BundleError, match=r"tile -1, -1: this process reads other scans.*do not change the dataset"):
        build_tile(task)


def test_a_damaged_scan_stops_the_tile_and_is_named(tasks_of, small_dataset, tmp_path):
    own = Dataset(shutil.copytree(small_dataset.folder, tmp_path / "own"))
    task = tasks_of(own)[0]
    (own.folder / "survey" / "scans" / "000003.bin").write_bytes(b"cut")
    part = SurveyPart(own.folder, task.numbers, task.poses)
    sha256 = Encoder.open(task.encoder_file).sha256
    with pytest.raises(DatasetError, match=r"000003\.bin.*truncated") as refused:
        build_tile(replace(task, key=key_of_tile(part, sha256, task.settings, task.part, task.common)))
    assert refused.value.field == "000003.bin"


def test_processes_give_the_same_bytes_although_one_is_killed(small_dataset, encoder_file, undisturbed, tmp_path):
    """The parent kills a process at its first report. A second one continues the tile."""
    killed, said = [], []

    def report(stage, _done, _total):
        if stage.startswith("scans") and not killed and multiprocessing.active_children():
            process = multiprocessing.active_children()[0]
            killed.append(process)
            process.kill()

    out = tmp_path / "m"
    build_tiled(small_dataset, encoder_file, out, SETTINGS, tile_m=TILE_M, workers=2, report=report, warn=said.append)
    assert files_of(out) == undisturbed
    assert len(killed) == len(said) == 1
    assert "its process was killed by SIGKILL (is the memory full?); the tile goes on in another process" in said[0]


def test_a_survey_in_object_storage_gives_the_same_map(survey_url, encoder_file, undisturbed, serial, tmp_path):
    """Each tile fetches its own scans and deletes them, so one tile's scans at most are there."""
    out, there = tmp_path / "m", []

    def report(stage, *_):
        there.append(len(list(work_folder(out).glob(".tile_*.scans"))))

    with dataset_at(survey_url, out) as survey:
        build_tiled(survey, encoder_file, out, SETTINGS, tile_m=TILE_M, report=report)
    assert files_of(out) == undisturbed
    assert max(there) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m"]


def test_a_process_that_is_killed_after_it_fetched_leaves_nothing(survey_url, encoder_file, undisturbed, tmp_path):
    killed, said, scans = [], [], []

    def report(stage, _done, _total):
        if stage.startswith("scans") and not killed and multiprocessing.active_children():
            scans.extend(work_folder(tmp_path / "m").glob(".tile_*.scans/survey/scans/*.bin"))
            if scans:
                process = multiprocessing.active_children()[0]
                killed.append(process)
                process.kill()

    with dataset_at(survey_url, tmp_path / "m") as survey:
        build_tiled(
            survey, encoder_file, tmp_path / "m", SETTINGS, tile_m=TILE_M, workers=1, report=report, warn=said.append
        )
    assert files_of(tmp_path / "m") == undisturbed
    assert len(killed) == len(said) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m"]


def test_a_tile_whose_process_dies_again_and_again_stops_the_build(small_dataset, encoder_file, tmp_path):
    """No process is left, and the next build can begin."""
    said = []

    def report(stage, _done, _total):
        if stage.startswith("scans"):
            for child in multiprocessing.active_children():
                child.kill()

    with pytest.raises(BundleError, match="in each of 2 attempts; give fewer --workers or a smaller --tile-m"):
        build_tiled(
            small_dataset,
            encoder_file,
            tmp_path / "m",
            SETTINGS,
            tile_m=TILE_M,
            workers=1,
            report=report,
            warn=said.append,
        )
    assert len(said) == 1
    assert multiprocessing.active_children() == []
    assert not (tmp_path / "m").exists()


def test_an_interrupted_build_ends_its_processes_and_can_go_on(
    small_dataset, encoder_file, undisturbed, tmp_path, monkeypatch
):
    def report(stage, _done, _total):
        if stage.startswith("scans") and multiprocessing.active_children():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_tiled(small_dataset, encoder_file, tmp_path / "m", SETTINGS, tile_m=TILE_M, workers=1, report=report)
    assert multiprocessing.active_children() == []
    monkeypatch.setattr(engines, "run", in_this_process)
    build_tiled(small_dataset, encoder_file, tmp_path / "m", SETTINGS, tile_m=TILE_M)
    assert files_of(tmp_path / "m") == undisturbed


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the extra `ray`")
def test_ray_gives_the_same_bytes(small_dataset, encoder_file, undisturbed, tmp_path):
    command = [
        sys.executable,
        "-c",
        "from service.cli.start import main; main()",
        "build-map",
        str(small_dataset.folder),
    ]
    command += ["--out", str(tmp_path / "m"), "--encoder", str(encoder_file), "--name", "tiled", "--headings", "6"]
    command += ["--spacing", "5", "--voxel", "0.6", "--tile-m", f"{TILE_M:g}", "--engine", "ray", "--workers", "2"]
    environment = {name: value for name, value in os.environ.items() if name != "RAY_ADDRESS"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    assert files_of(tmp_path / "m") == undisturbed


def test_tiles_check_the_confidence_with_scans_of_their_own(
    small_dataset, encoder_file, calibration_file_of, serial, tmp_path, monkeypatch
):
    """They are places whose surroundings are in the cloud of the tile alone."""
    monkeypatch.setattr(site_check, "_EACH", 2)
    monkeypatch.setattr(site_check, "FEWEST", 1)
    monkeypatch.setattr(tile_area, "SURROUNDING_M", 5.0)
    calibration = calibration_file_of(Encoder.open(encoder_file).sha256)
    settings = replace(SETTINGS, calibration=calibration)
    made = build_tiled(small_dataset, encoder_file, tmp_path / "m", settings, tile_m=TILE_M)
    queries, counted, squares = 0, 0, {(tile.column, tile.row) for tile in made.tiles}
    for tile in made.tiles:
        bundle = MapBundle.open(tmp_path / "m" / tile.folder)
        assert bundle.calibration is not None
        assert bundle.calibration.site is not None
        queries += bundle.calibration.site.queries
        at_scan = tile.counts.places - int(bundle.manifest.parameters["places_between"])
        area = TileArea(Square(tile.column, tile.row, TILE_M), squares, SETTINGS.voxel_m)
        inner = area.surrounds(bundle.T_map_place[:at_scan, :2, 3])
        assert 2 <= inner.sum() < at_scan
        counted += int(inner.sum()) // 2
    assert queries == counted
    whole = json.loads((tmp_path / "m" / "calibration.json").read_text())
    assert whole["site"]["queries"] == queries


def test_an_existing_map_a_wrong_edge_and_a_wrong_engine_are_refused_before_the_work(
    small_dataset, encoder_file, tiled, tmp_path, monkeypatch
):
    def build(out, *, tile_m=TILE_M, engine=None, workers=None):
        def report(*_):
            pytest.fail("it began")

        build_tiled(
            small_dataset,
            encoder_file,
            out,
            SETTINGS,
            tile_m=tile_m,
            engine=engine or "local",
            workers=workers,
            report=report,
        )

    with pytest.raises(BundleError, match="already exists"):
        build(tiled)
    with pytest.raises(DatasetError, match="tile_m: 20 is not valid; give 50 to 10,000 metres"):
        build(tmp_path / "m", tile_m=20.0)
    with pytest.raises(DatasetError, match="engine: 'slurm' is unknown; give local or ray"):
        build(tmp_path / "m", engine="slurm")
    with pytest.raises(DatasetError, match="workers: 0 is not valid; give 1 or more"):
        build(tmp_path / "m", workers=0)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ExtraMissingError, match=r"--engine ray needs the package 'ray': .*\[ray\]"):
        build(tmp_path / "m", engine="ray")
    assert list(tmp_path.iterdir()) == []


def test_the_longest_tile_starts_first_and_no_more_tiles_than_fit_into_memory(tasks_of, monkeypatch):
    """The second of two tiles has more scans."""
    tasks, told = [replace(task, numbers=np.arange(count)) for task, count in zip(tasks_of(), (9, 11), strict=True)], []
    largest = engines.PROCESS_BYTES + 11 * engines.SCAN_BYTES
    monkeypatch.setattr(local, "_cores", lambda: 8)
    monkeypatch.setattr(engines, "run_job", lambda _engine, job, workers, **usual: told.append((job, workers, usual)))
    for free in (largest // 2, largest, 2 * largest - 1, 2 * largest, 9 * largest):
        monkeypatch.setattr(local, "_free_bytes", lambda free=free: free)
        engines.run(
            "local",
            tasks,
            build_tile,
            memory_of=engines.memory_of,
            remedy="give fewer --workers",
            workers=None,
            on_progress=lambda *_: None,
            warn=lambda _: None,
        )
    assert [usual["usual_workers"] for _, _, usual in told] == [1, 1, 1, 2, 2]
    assert {workers for _, workers, _ in told} == {None}
    assert [list(job.order) for job, _, _ in told] == [[1, 0]] * 5


@pytest.mark.parametrize("option", [{"workers": 2}, {"engine": "local"}])
def test_options_of_tiles_without_an_edge_are_refused(small_dataset, option, tmp_path):
    with pytest.raises(typer.BadParameter, match="it builds tiles; give --tile-m too") as refused:
        command(str(small_dataset.folder), tmp_path / "m", **option)
    assert refused.value.param_hint == f"--{next(iter(option))}"
    assert list(tmp_path.iterdir()) == []
