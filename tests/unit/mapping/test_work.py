"""A killed build continues where it stopped. It never uses results of other input."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from model_training.datasets.dataset import Dataset
from model_training.mapping import build, work
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.mapping.survey import thinned
from model_training.mapping.work import key_of, work_beside, work_folder
from service.errors import BundleError, DatasetError
from service.maps.reader import MapBundle

#: No places between scans: the tests of the build kill a build with such places.
SETTINGS = BuildSettings(name="small", headings=6, spacing_m=5.0, between_m=0.0, calibration=None, align_survey=False)


class KilledError(Exception):
    """Stands for the end of the process."""


def files_of(folder):
    """Return every file of a bundle; the manifest without its timestamp."""
    found = {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
    manifest = json.loads(found["manifest.json"])
    del manifest["made_at"]
    return found | {"manifest.json": json.dumps(manifest)}


@pytest.fixture(scope="module")
def small_dataset(sparse_survey):
    """Replace the dataset of other tests."""
    return sparse_survey


@pytest.fixture
def small_chunks(monkeypatch):
    monkeypatch.setattr(work, "CHUNK", 3)


@pytest.fixture(scope="module")
def undisturbed_files(small_dataset, encoder_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed") / "small"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(work, "CHUNK", 3)
        build_map(small_dataset, encoder_file, out, SETTINGS, threads=1)
    return files_of(out)


@pytest.fixture
def undisturbed(undisturbed_files, small_chunks):
    """Return the files of a build that nothing killed. The test's own builds use the same small chunks."""
    return undisturbed_files


def build_killed_at(place, dataset, encoder_file, out, settings=SETTINGS):
    def report(stage, done, _total):
        if stage == "places" and done == place:
            raise KilledError

    with pytest.raises(KilledError):
        build_map(dataset, encoder_file, out, settings, threads=1, report=report)


@pytest.mark.parametrize("place", [1, 4, 8])
def test_a_killed_build_ends_with_the_same_bytes(place, small_dataset, encoder_file, undisturbed, tmp_path):
    out, told = tmp_path / "small", []
    build_killed_at(place, small_dataset, encoder_file, out)
    assert not out.exists()
    build_map(small_dataset, encoder_file, out, SETTINGS, threads=1, report=lambda *event: told.append(event))
    assert files_of(out) == undisturbed
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []
    finished = (place - 1) // 3 * 3  # chunks of three: only the end of a finished one is reported
    ends = list(range(3, finished + 1, 3))
    assert [done for _, done, _ in told][: len(ends) + 1] == [*ends, finished + 1]


def test_a_build_killed_again_and_again_ends_with_the_same_bytes(small_dataset, encoder_file, undisturbed, tmp_path):
    for place in (2, 5, 8, 11):
        build_killed_at(place, small_dataset, encoder_file, tmp_path / "small")
    build_map(small_dataset, encoder_file, tmp_path / "small", SETTINGS, threads=1)
    assert files_of(tmp_path / "small") == undisturbed


def test_a_build_killed_while_it_writes_leaves_no_bundle_and_goes_on(
    small_dataset, encoder_file, undisturbed, tmp_path, monkeypatch
):
    """The next build removes the remains of the killed one."""
    out = tmp_path / "small"
    (tmp_path / ".small.x1.partial").mkdir()
    with monkeypatch.context() as patch:
        patch.setattr(build, "write_bundle", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            build_map(small_dataset, encoder_file, out, SETTINGS, threads=1)
    assert not out.exists()
    told = []
    build_map(small_dataset, encoder_file, out, SETTINGS, threads=1, report=lambda *event: told.append(event))
    assert files_of(out) == undisturbed
    count = len(thinned(small_dataset.survey_poses(), SETTINGS.spacing_m))
    ends = [*range(3, count, 3), count]  # all parts were kept: only their ends are reported
    assert [event for event in told if event[0] != "writing"] == [
        (stage, done, count) for stage in ("places", "traffic") for done in ends
    ]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["small"]


def test_a_part_that_lost_power_halved_is_made_again(small_dataset, encoder_file, undisturbed, tmp_path):
    out = tmp_path / "small"
    build_killed_at(8, small_dataset, encoder_file, out)
    halved = sorted(work_folder(out).glob("places-*"))[0]
    halved.write_bytes(halved.read_bytes()[: halved.stat().st_size // 2])
    build_map(small_dataset, encoder_file, out, SETTINGS, threads=1)
    assert files_of(out) == undisturbed


def test_a_changed_scan_is_never_mixed_with_what_was_made_of_the_old_one(
    small_dataset, encoder_file, small_chunks, tmp_path
):
    changing = Dataset(shutil.copytree(small_dataset.folder, tmp_path / "changing"))
    build_killed_at(8, changing, encoder_file, tmp_path / "killed")
    scan = changing.folder / "survey" / "scans" / "000000.bin"
    scan.write_bytes(scan.read_bytes()[: -16 * 1000])
    build_map(changing, encoder_file, tmp_path / "killed", SETTINGS, threads=1)
    build_map(changing, encoder_file, tmp_path / "anew", SETTINGS, threads=1)
    assert files_of(tmp_path / "killed") == files_of(tmp_path / "anew")


@pytest.fixture
def key(small_dataset):
    return lambda dataset=small_dataset, encoder="e", settings=SETTINGS, threads=1, **more: key_of(
        dataset, encoder, settings, threads=threads, **more
    )


def test_all_that_parts_are_made_of_is_in_their_name(key, small_dataset, tmp_path, monkeypatch):
    found = {
        key(),
        key(encoder="f"),
        key(settings=replace(SETTINGS, spacing_m=4.0)),
        key(settings=replace(SETTINGS, headings=7)),
        key(settings=replace(SETTINGS, voxel_m=0.2)),
        key(settings=replace(SETTINGS, remove_weather=True)),
        key(threads=2),
        key(held_out=20),
        key(map="another"),
    }
    moved = Dataset(shutil.copytree(small_dataset.folder, tmp_path / "moved"))
    poses = moved.folder / "survey" / "poses.txt"
    poses.write_text("\n".join(poses.read_text().splitlines()[:-1]) + "\n")
    found.add(key(moved))
    monkeypatch.setattr(work, "_code", lambda: "other code")
    found.add(key())
    assert len(found) == 11


def test_a_name_and_a_licence_change_no_part(key):
    assert key() == key(settings=replace(SETTINGS, name="other", licence="CC0-1.0"))


def test_a_scan_that_was_touched_is_another(key, small_dataset, tmp_path):
    own = Dataset(shutil.copytree(small_dataset.folder, tmp_path / "own"))
    before = key(own)
    os.utime(own.folder / "survey" / "scans" / "000002.bin", ns=(1, 1))
    assert key(own) != before


_HOLDER = """
import sys
from pathlib import Path
from model_training.mapping.work import work_beside
with work_beside(Path(sys.argv[1]), "k" * 24) as work:
    work.part("one", lambda: {})
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    """Start another process that builds ``tmp_path / "m"``."""
    process = subprocess.Popen(
        [sys.executable, "-c", _HOLDER, str(tmp_path / "m")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def test_a_second_build_at_once_is_refused_and_names_the_first(holder, small_dataset, encoder_file, tmp_path):
    with pytest.raises(BundleError, match=f"process {holder.pid} already builds this map"):
        build_map(small_dataset, encoder_file, tmp_path / "m", SETTINGS, threads=1)
    assert not (tmp_path / "m").exists()


def test_the_lock_of_a_killed_process_is_taken_over(holder, tmp_path):
    holder.kill()
    holder.wait()
    assert (work_folder(tmp_path / "m") / "lock").read_text() == str(holder.pid)
    with work_beside(tmp_path / "m", "k" * 24) as mine:
        assert (mine.folder / "lock").read_text() == str(os.getpid())
        assert mine.part("one", lambda: pytest.fail("it was finished")) == {}
    assert not work_folder(tmp_path / "m").exists()


def killed_with_part(out, key, make):
    with work_beside(out, key) as mine:
        mine.part("one", make)
        raise KilledError


def test_parts_of_another_key_are_removed(tmp_path):
    made = []
    for key in "aab":
        with pytest.raises(KilledError):
            killed_with_part(tmp_path / "m", key * 24, lambda key=key: made.append(key) or {"x": np.arange(3)})
    assert made == ["a", "b"]
    assert sorted(p.name for p in work_folder(tmp_path / "m").iterdir()) == ["lock", f"one-{'b' * 24}.npz"]


def test_a_build_that_is_refused_at_once_leaves_nothing(small_dataset, encoder_file, tmp_path):
    own = Dataset(shutil.copytree(small_dataset.folder, tmp_path / "own"))
    (own.folder / "survey" / "scans" / "000000.bin").write_bytes(b"")
    with pytest.raises(DatasetError, match="truncated"):
        build_map(own, encoder_file, tmp_path / "m", SETTINGS, threads=1)
    assert [p.name for p in tmp_path.iterdir()] == ["own"]


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with (
        pytest.raises(BundleError, match="the intermediate results of the build cannot be stored"),
        work_beside(tmp_path / "file" / "m", "k"),
    ):
        pass


def test_a_killed_build_with_votes_and_a_site_check_ends_with_the_same_bytes(
    small_dataset, encoder_file, small_chunks, calibration_file_of, tmp_path, monkeypatch
):
    from model_training.mapping import site_check
    from service.retrieval.encoder import Encoder

    monkeypatch.setattr(site_check, "_EACH", 4)
    monkeypatch.setattr(site_check, "FEWEST", 2)
    calibration = calibration_file_of(Encoder.open(encoder_file).sha256)
    settings = replace(SETTINGS, calibration=calibration, passes_vote=True)
    build_map(small_dataset, encoder_file, tmp_path / "a", settings, threads=1)
    for stage, done in (("site check", 2), ("passes", 4)):

        def report(told, count, _total, stage=stage, done=done):
            if (told, count) == (stage, done):
                raise KilledError

        with pytest.raises(KilledError):
            build_map(small_dataset, encoder_file, tmp_path / "b", settings, threads=1, report=report)
    build_map(small_dataset, encoder_file, tmp_path / "b", settings, threads=1)
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")
    bundle = MapBundle.open(tmp_path / "b")
    assert bundle.calibration is not None
    assert bundle.calibration.site is not None
    assert bundle.calibration.site.queries >= 2
    assert bundle.manifest.parameters["passes_vote"] == 1.0
