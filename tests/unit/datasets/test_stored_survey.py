"""A dataset in object storage: an S3 server over a socket, and files."""

import errno
import pickle
import shutil

import numpy as np
import pytest

from benchmarks.scale.s3_server import BUCKET
from model_training.datasets.dataset import Dataset
from model_training.datasets.stored_survey import StoredSurvey, dataset_at, source_of
from model_training.datasets.survey_part import FolderSource, SurveyPart
from service.errors import DatasetError, ExtraMissingError
from service.maps.store.remote import Remote

FIRST, SECOND = "survey/scans/000000.bin", "survey/scans/000001.bin"


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
    (tmp_path / "maps").mkdir()
    return tmp_path / "maps" / "town"


def fetched(out):
    """Return the names of the fetched scans."""
    return sorted(file.name for file in out.parent.glob(f".{out.name}.survey-*/survey/scans/*"))


def test_it_reads_what_the_folder_has(url, small_dataset, out):
    stored = StoredSurvey(url, out)
    assert stored.description == small_dataset.description
    assert stored.streets() == small_dataset.streets()
    np.testing.assert_array_equal(stored.survey_poses(), small_dataset.survey_poses())
    assert [each[:2] for each in stored.scan_files()] == [each[:2] for each in small_dataset.scan_files()]
    np.testing.assert_array_equal(stored.scan(3), small_dataset.scan(3))


def test_only_scans_that_are_read_are_fetched(url, out):
    stored = StoredSurvey(url, out)
    assert fetched(out) == []
    stored.scan(0)
    stored.scan(1)
    stored.scan(0)
    assert fetched(out) == ["000000.bin", "000001.bin"]


def test_all_scans_are_fetched_once_and_the_progress_is_told(url, small_dataset, out, monkeypatch):
    names, told = [], []
    save = Remote.save_listed
    monkeypatch.setattr(
        Remote,
        "save_listed",
        lambda self, file, *rest, **named: names.append(file.name) or save(self, file, *rest, **named),
    )
    stored = StoredSurvey(url, out)
    stored.scan(0)
    stored.fetch_all(lambda *event: told.append(event))
    stored.fetch_all()
    assert sorted(names) == [f"survey/scans/{number:06d}.bin" for number in range(len(small_dataset.survey_poses()))]
    stages, done, totals = zip(*told, strict=True)
    assert set(stages) == {"fetching scans (MB)"}
    assert max(done) == totals[0] == sum(size for _, size, _ in list(small_dataset.scan_files())[1:]) // 10**6


def test_another_process_opens_a_part_from_its_source(url, small_dataset, out, tmp_path):
    numbers = np.array([2, 5, 6])
    poses = small_dataset.survey_poses()[numbers]
    source = source_of(StoredSurvey(url, out), numbers)
    part = pickle.loads(pickle.dumps(source)).part(numbers, poses, scratch=tmp_path / "scratch")  # noqa: S301  # of this test
    expected = SurveyPart(small_dataset.folder, numbers, poses)
    assert [each[:2] for each in part.scan_files()] == [each[:2] for each in expected.scan_files()]
    np.testing.assert_array_equal(part.survey_trajectory()[0], expected.survey_trajectory()[0])
    part.prepare()
    assert sorted(file.name for file in (tmp_path / "scratch" / "survey" / "scans").iterdir()) == [
        "000002.bin",
        "000005.bin",
        "000006.bin",
    ]
    np.testing.assert_array_equal(part.scan(1), expected.scan(1))
    part.release()
    assert not (tmp_path / "scratch").exists()


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


def test_what_was_fetched_goes_at_the_end_and_stays_after_an_error(url, out):
    def interrupted():
        with dataset_at(url, out) as stored:
            stored.scan(0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert fetched(out) == ["000000.bin"]
    with dataset_at(url, out) as stored:
        stored.scan(1)
        assert fetched(out) == ["000000.bin", "000001.bin"]
    assert list(out.parent.iterdir()) == []


def test_a_folder_needs_no_copy(small_dataset, out):
    with dataset_at(str(small_dataset.folder), out) as opened:
        assert type(opened) is Dataset
    assert list(out.parent.iterdir()) == []


def test_a_survey_that_has_changed_is_fetched_again(url, out):
    StoredSurvey(url, out).scan(0)
    Remote.open(url).put(FIRST, np.ones((3, 4), np.float32).tobytes())
    stored = StoredSurvey(url, out)
    assert fetched(out) == []
    np.testing.assert_array_equal(stored.scan(0), np.ones((3, 4)))


def test_a_scan_that_changes_during_the_build_is_refused(url, out):
    stored = StoredSurvey(url, out)
    Remote.open(url).put(SECOND, np.ones((3, 4), np.float32).tobytes())
    with pytest.raises(
        DatasetError, match=r"drive/survey/scans/000001\.bin has changed since the command began; run it again"
    ):
        stored.scan(1)
    assert fetched(out) == []


def test_a_missing_scan_is_named(url, out, tmp_path, small_dataset):
    numbers = np.array([0, 40])
    stored = StoredSurvey(url, out)
    with pytest.raises(
        DatasetError, match=r"drive/survey/scans/000040\.bin is missing, but survey/poses.txt has a line for it"
    ):
        stored.scan(40)
    poses = small_dataset.survey_poses()[[0, 0]]
    part = source_of(stored, numbers).part(numbers, poses, scratch=tmp_path / "scratch")
    part.prepare()
    assert [name for name, *_ in part.scan_files()] == ["000000.bin"]
    with pytest.raises(DatasetError, match=r"000040\.bin is missing"):
        part.scan(1)


def test_a_url_without_a_dataset_is_named(url, out):
    with pytest.raises(DatasetError, match=r"drive/nothing.*; check the URL"):
        StoredSurvey(f"{url}/nothing", out)
    Remote.open(f"{url}/other", create=True).put("notes.txt", b"-")
    with pytest.raises(
        DatasetError, match=r"other/dataset\.json is missing in the store; check the URL, or copy the dataset"
    ):
        StoredSurvey(f"{url}/other", out)


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("ftp://host/drive", r"the URL ftp://\.\.\. of a dataset has no scheme of a store"),
        ("s3://key:secret@bucket/drive", r"of a dataset has credentials; give them in environment variables"),
    ],
)
def test_a_wrong_url_is_refused(place, message, out):
    with pytest.raises(DatasetError, match=message) as told:
        StoredSurvey(place, out)
    assert told.value.field == "dataset"
    assert "secret" not in told.value.message


def test_a_full_disk_leaves_no_half_scan(url, out, monkeypatch):
    stored = StoredSurvey(url, out)

    def full(_self, _file, target, **_):
        target.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device", "000000.bin")

    with monkeypatch.context() as patch:
        patch.setattr(Remote, "save_listed", full)
        with pytest.raises(DatasetError, match=r"cannot be written \(No space left on device\); free disk space"):
            stored.scan(0)
    assert fetched(out) == []
    assert stored.scan(0).size


def test_without_obstore_the_extra_is_named(out, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "obstore.exceptions", None)
    with pytest.raises(ExtraMissingError, match=r"s3://bucket/drive: a dataset in object storage"):
        StoredSurvey("s3://bucket/drive", out)


def test_a_process_that_died_while_it_fetched_does_no_harm(url, out):
    stored = StoredSurvey(url, out)
    folder = next(out.parent.glob(".town.survey-*")) / "survey" / "scans"
    folder.mkdir(parents=True)
    (folder / ".000000.bin.1-0").write_bytes(b"half")
    assert stored.scan(0).size
    stored.remove_fetched()
    assert list(out.parent.iterdir()) == []
    shutil.rmtree(out.parent)
    assert StoredSurvey(url, out).scan(0).size
