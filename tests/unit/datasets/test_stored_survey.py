"""A dataset in object storage: an S3 server over a socket, and files."""

import errno
import hashlib
import os
import pickle
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scale.s3_server import BUCKET
from model_training.datasets.dataset import Dataset
from model_training.datasets.stored_survey import StoredSource, StoredSurvey, dataset_at, source_of
from model_training.datasets.survey_part import FolderSource, SurveyPart
from service.errors import BundleError, DatasetError, ExtraMissingError
from service.maps.manifest import FileEntry
from service.maps.store.remote import Remote

FIRST = "survey/scans/000000.bin"


@pytest.fixture(params=["s3", "file"])
def url(request, small_dataset, tmp_path, monkeypatch):
    """Return the URL of a copy of the dataset without its queries."""
    if request.param == "file":
        found = f"file://{tmp_path}/store/drive"
    else:
        for key, value in request.getfixturevalue("s3").items():
            monkeypatch.setenv(key, value)
        found = f"s3://{BUCKET}/{tmp_path.name}/drive"
    remote = Remote.open(found, create=True)
    for file in small_dataset.folder.rglob("*"):
        name = str(file.relative_to(small_dataset.folder))
        if file.is_file() and not name.startswith("queries/"):
            remote.put(name, file)
    return found


@pytest.fixture
def out(tmp_path):
    """Return the path of a map in a folder that has nothing else."""
    (tmp_path / "maps").mkdir()
    return tmp_path / "maps" / "town"


@pytest.fixture
def opened(url, tmp_path):
    return StoredSurvey(StoredSource.found(url), tmp_path / "fetched")


def scans_in(folder):
    return sorted(file.name for file in (folder / "survey" / "scans").glob("*"))


def test_it_reads_what_the_folder_has(opened, small_dataset):
    assert opened.description == small_dataset.description
    assert opened.streets() == small_dataset.streets()
    np.testing.assert_array_equal(opened.survey_poses(), small_dataset.survey_poses())
    assert [each[:2] for each in opened.scan_files()] == [each[:2] for each in small_dataset.scan_files()]
    np.testing.assert_array_equal(opened.scan(3), small_dataset.scan(3))


def test_only_scans_that_are_read_are_fetched(opened):
    assert scans_in(opened.folder) == []
    for number in (0, 1, 0):
        opened.scan(number)
    assert scans_in(opened.folder) == ["000000.bin", "000001.bin"]


def test_scans_are_fetched_once_and_the_progress_is_told(opened, small_dataset, monkeypatch):
    names, told = [], []
    save = Remote.save_listed
    monkeypatch.setattr(
        Remote,
        "save_listed",
        lambda self, file, *rest, **named: names.append(file.name) or save(self, file, *rest, **named),
    )
    wanted = np.array([0, 2, 4])
    opened.scan(0)
    opened.fetch(wanted, lambda *event: told.append(event))
    opened.fetch(wanted)
    assert sorted(names) == [f"survey/scans/{number:06d}.bin" for number in wanted]
    stages, done, totals = zip(*told, strict=True)
    assert set(stages) == {"fetching scans (MB)"}
    assert list(done) == sorted(done)
    assert done[-1] == totals[0] == sum(list(small_dataset.scan_files())[number][1] for number in (2, 4)) // 10**6


def test_another_process_opens_a_part_from_its_source(opened, small_dataset, tmp_path):
    numbers, folder = np.array([2, 5, 6]), tmp_path / "scratch"
    poses = small_dataset.survey_poses()[numbers]
    source = pickle.loads(pickle.dumps(source_of(opened, numbers)))  # noqa: S301  # of this test
    part, expected = source.part(numbers, poses, scratch=folder), SurveyPart(small_dataset.folder, numbers, poses)
    assert [each[:2] for each in part.scan_files()] == [each[:2] for each in expected.scan_files()]
    np.testing.assert_array_equal(part.survey_trajectory()[0], expected.survey_trajectory()[0])
    assert part.streets() == expected.streets()
    part.prepare()
    assert scans_in(folder) == ["000002.bin", "000005.bin", "000006.bin"]
    np.testing.assert_array_equal(part.scan(1), expected.scan(1))
    part.release()
    assert not folder.exists()


def test_a_folder_is_the_source_of_its_parts(small_dataset, tmp_path):
    numbers = np.array([1, 4])
    source = source_of(small_dataset, numbers)
    assert source == FolderSource(small_dataset.folder.resolve())
    part = source.part(numbers, small_dataset.survey_poses()[numbers], scratch=tmp_path / "unused")
    part.prepare()
    np.testing.assert_array_equal(part.scan(1), small_dataset.scan(4))
    part.release()
    assert small_dataset.scan(4).size
    assert not (tmp_path / "unused").exists()


def interrupted_at(url, out, *numbers):
    with dataset_at(url, out) as survey:
        for number in numbers:
            survey.scan(number)
        raise KeyboardInterrupt


def test_scans_go_at_the_end_and_stay_after_an_error(url, out):
    with pytest.raises(KeyboardInterrupt):
        interrupted_at(url, out, 0)
    assert scans_in(out.parent / ".town.survey") == ["000000.bin"]
    with dataset_at(url, out) as survey:
        survey.scan(1)
        assert scans_in(survey.folder) == ["000000.bin", "000001.bin"]
    assert list(out.parent.iterdir()) == []


def test_an_error_before_the_first_scan_leaves_nothing(url, out):
    with pytest.raises(KeyboardInterrupt):
        interrupted_at(url, out)
    assert list(out.parent.iterdir()) == []


def test_a_folder_needs_no_copy(small_dataset, out):
    with dataset_at(str(small_dataset.folder), out) as survey:
        assert type(survey) is Dataset
    assert list(out.parent.iterdir()) == []


def test_a_survey_that_has_changed_is_fetched_again(url, out, small_dataset):
    """The new scan has the size of the old one."""
    with pytest.raises(KeyboardInterrupt):
        interrupted_at(url, out, 0, 1)
    other = np.ones_like(small_dataset.scan(0))
    Remote.open(url).put(FIRST, other.tobytes())
    with dataset_at(url, out) as survey:
        assert scans_in(survey.folder) == []
        np.testing.assert_array_equal(survey.scan(0), other)


def test_two_processes_do_not_share_the_folder(url, out):
    with dataset_at(url, out) as survey:
        survey.scan(0)
        with pytest.raises(DatasetError, match=r"\.town\.survey is used by another process.*choose another --out"):
            interrupted_at(url, out)
        assert survey.scan(0).size
        assert survey.streets()


def test_folders_of_other_maps_stay(url, out):
    other = out.parent / ".town.survey-2026.building"
    other.mkdir()
    with dataset_at(url, out):
        pass
    assert list(out.parent.iterdir()) == [other]


@pytest.mark.parametrize("has_mark", [True, False])
def test_a_scan_that_changes_during_the_build_is_refused(url, small_dataset, tmp_path, has_mark):
    """It keeps its size. Without an ETag, the time of the change tells."""
    source = StoredSource.found(url)
    if not has_mark:
        early = {
            name: replace(file, e_tag=None, modified_ns=file.modified_ns - 10**10)
            for name, file in source.scans.items()
        }
        source = replace(source, scans=early)
    survey = StoredSurvey(source, tmp_path / "fetched")
    Remote.open(url).put(FIRST, np.ones_like(small_dataset.scan(0)).tobytes())
    with pytest.raises(
        DatasetError, match=r"drive/survey/scans/000000\.bin has changed since the command began; run it again"
    ):
        survey.scan(0)
    assert scans_in(survey.folder) == []


def test_a_file_that_is_written_over_while_it_is_read_is_refused(small_dataset, tmp_path):
    path = tmp_path / "store" / FIRST
    for name in ("dataset.json", "survey/poses.txt", FIRST):
        (tmp_path / "store" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "store" / name).write_bytes((small_dataset.folder / name).read_bytes())
    source = StoredSource.found(f"file://{tmp_path}/store")
    size = path.stat().st_size

    def written_over(*_):
        with path.open("r+b") as stream:
            stream.write(bytes(size))

    with pytest.raises(DatasetError, match=r"000000\.bin has changed since the command began"):
        source.fetch_scans(tmp_path / "fetched", [0], written_over)


@pytest.mark.parametrize("left", [50, 10, 0])
def test_a_file_that_becomes_shorter_while_it_is_read_is_refused(tmp_path, monkeypatch, left):
    monkeypatch.setattr("service.maps.store.remote._CHUNK", 20)
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(100))
    remote = Remote.open(f"file://{tmp_path}")
    (listed,) = remote.files("")
    with (
        (tmp_path / "copy").open("wb") as copy,
        pytest.raises(BundleError, match=r"a\.bin has changed while it was read; try again"),
    ):
        remote.save_listed(listed, copy, on_bytes=lambda _: os.truncate(path, left))


def test_a_file_that_is_replaced_while_it_is_read_is_not_mixed_with_the_new_one(tmp_path, monkeypatch):
    monkeypatch.setattr("service.maps.store.remote._CHUNK", 20)
    path, other = tmp_path / "a.bin", tmp_path / "new"
    path.write_bytes(bytes(100))
    remote = Remote.open(f"file://{tmp_path}")
    entry = FileEntry(size=100, sha256=hashlib.sha256(bytes(100)).hexdigest())

    def replace_it(_):
        other.write_bytes(bytes(100))
        other.replace(path)

    with (
        (tmp_path / "copy").open("wb") as copy,
        pytest.raises(BundleError, match=r"a\.bin has changed while it was read; try again"),
    ):
        remote.save("a.bin", entry, copy, on_bytes=replace_it)


def test_a_file_in_a_subfolder_is_no_scan(url, small_dataset, tmp_path):
    Remote.open(url).put("survey/scans/backup/000001.bin", np.ones((3, 4), np.float32).tobytes())
    survey = StoredSurvey(StoredSource.found(url), tmp_path / "fetched")
    np.testing.assert_array_equal(survey.scan(1), small_dataset.scan(1))


def test_a_missing_scan_is_named(opened, tmp_path, small_dataset):
    numbers, message = (
        np.array([0, 40]),
        r"drive/survey/scans/000040\.bin is missing, but survey/poses.txt has a line for it",
    )
    with pytest.raises(DatasetError, match=message):
        opened.scan(40)
    part = source_of(opened, numbers).part(numbers, small_dataset.survey_poses()[[0, 0]], scratch=tmp_path / "scratch")
    part.prepare()
    assert [name for name, *_ in part.scan_files()] == ["000000.bin"]
    with pytest.raises(DatasetError, match=message):
        part.scan(1)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (FIRST, r"/drive/survey/scans/000000\.bin: 5 bytes are not a multiple of 16.*; copy the dataset there"),
        ("dataset.json", r"/drive/dataset\.json: .*; copy the dataset there"),
        ("survey/poses.txt", r"/drive/survey/poses\.txt.*; copy the dataset there"),
        ("streets.geojson", r"/drive/streets\.geojson: not valid JSON.*; copy the dataset there"),
    ],
)
def test_a_damaged_file_is_named_by_its_url(url, out, name, message):
    Remote.open(url).put(name, b"wrong")

    def read():
        with dataset_at(url, out) as survey:
            survey.survey_poses()
            survey.streets()
            survey.scan(0)

    with pytest.raises(DatasetError, match=message) as told:
        read()
    assert str(out.parent) not in told.value.message


def test_a_url_without_a_dataset_is_named(url, out):
    with pytest.raises(DatasetError, match=r"drive/nothing.*; check the URL"):
        interrupted_at(f"{url}/nothing", out)
    Remote.open(f"{url}/other", create=True).put("notes.txt", b"-")
    with pytest.raises(
        DatasetError, match=r"other/dataset\.json is missing in the store; check the URL, or copy the dataset"
    ):
        interrupted_at(f"{url}/other", out)
    assert list(out.parent.iterdir()) == []


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("ftp://host/drive", r"the URL ftp://\.\.\. of a dataset has no scheme of a store"),
        ("s3://key:secret@bucket/drive", r"of a dataset has credentials; give them in environment variables"),
    ],
)
def test_a_wrong_url_is_refused(place, message, out):
    with pytest.raises(DatasetError, match=message) as told:
        interrupted_at(place, out)
    assert told.value.field == "dataset"
    assert "secret" not in told.value.message


def test_a_scheme_may_have_capital_letters(small_dataset, out):
    with dataset_at(f"FILE://{small_dataset.folder}", out) as survey:
        assert survey.scan(0).size


def test_a_full_disk_leaves_no_half_scan(opened, monkeypatch):
    def full(_self, _file, target, **_):
        target.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device", "000000.bin")

    with monkeypatch.context() as patch:
        patch.setattr(Remote, "save_listed", full)
        with pytest.raises(DatasetError, match=r"cannot be written \(No space left on device\); free disk space"):
            opened.scan(0)
    assert scans_in(opened.folder) == []
    assert opened.scan(0).size


def test_a_scan_that_a_crash_has_cut_is_fetched_again(opened, small_dataset):
    opened.scan(0)
    (opened.folder / FIRST).write_bytes(b"")
    np.testing.assert_array_equal(opened.scan(0), small_dataset.scan(0))


def test_what_a_killed_process_left_does_no_harm(opened):
    left = opened.folder / "survey" / "scans" / ".000000.bin.1-0"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"half")
    assert opened.scan(0).size


def test_without_obstore_the_extra_is_named(out, monkeypatch):
    monkeypatch.setitem(sys.modules, "obstore.exceptions", None)
    with pytest.raises(ExtraMissingError, match=r"s3://bucket/drive: a dataset in object storage"):
        interrupted_at("s3://bucket/drive", out)


def test_the_state_changes_with_every_file(opened):
    source, name = opened.source, Path(FIRST).name
    changed = replace(source.scans[name], e_tag="other")
    states = {
        source.state,
        replace(source, scans={**source.scans, name: changed}).state,
        replace(source, files={}).state,
        replace(source, url="s3://bucket/other").state,
    }
    assert len(states) == 4
    assert all(re.fullmatch("[0-9a-f]{64}", state) for state in states)
