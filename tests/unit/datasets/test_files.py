"""Files that vanish, cannot be read or are truncated while a command reads them give a clear error that names the file."""

import shutil

import numpy as np
import pytest

from model_training.datasets import files
from model_training.datasets.dataset import Dataset, scan_path
from model_training.datasets.files import read_arrays, read_bytes, read_rows, reading, size_of
from service.errors import DatasetError, StreetfixError


def frames_of(dataset):
    return [frame for name in dataset.query_sets(with_truth=True) for frame in dataset.queries(name)]


def read_all(dataset, frames=None):
    """Read as build-map and evaluate do, with images. ``frames`` were listed before."""
    for number in range(len(dataset.survey_poses())):
        dataset.scan(number)
    dataset.streets()
    for frame in frames_of(dataset) if frames is None else frames:
        frame.rgb()
        frame.depth_m()


@pytest.fixture
def dataset(small_dataset, tmp_path):
    shutil.copytree(small_dataset.folder, tmp_path / "copy")
    return Dataset(tmp_path / "copy")


def kinds_of(folder):
    """Return one file of every kind that is read after the dataset was opened."""
    found = sorted(path for path in folder.rglob("*") if path.is_file() and path.parent != folder)
    return {(path.parent.name, path.suffix): path for path in found}.values()


def test_every_file_that_vanishes_while_a_dataset_is_read_is_named(dataset):
    checked, frames = 0, frames_of(dataset)
    for path in list(kinds_of(dataset.folder)):
        if path.suffix == ".txt" and path.parent.name != "survey":
            continue  # read when the frames were listed
        content = path.read_bytes()
        path.unlink()
        with pytest.raises(DatasetError) as error:
            read_all(dataset, frames)
        assert path.stem in error.value.message
        path.write_bytes(content)
        checked += 1
    read_all(dataset)
    assert checked >= 4


@pytest.mark.parametrize("share", [0.0, 0.37, 0.9])
def test_every_file_that_is_cut_off_gives_an_error_of_ours_or_is_read(dataset, share):
    """A scan truncated at a row end, or a text truncated at a line end, is a valid shorter file."""
    for path in list(kinds_of(dataset.folder)):
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])
        told = ""
        try:
            read_all(dataset)
        except StreetfixError as error:
            told = error.message
        assert not told or path.stem in told or path.parent.name in told
        path.write_bytes(content)
    read_all(dataset)


@pytest.mark.parametrize("kind", ["rgb", "depth"])
def test_a_damaged_picture_is_named(dataset, kind):
    """Earlier, the error named a field of a request. A user who reads a dataset sends no request."""
    frame = next(dataset.queries("drive1_precise"))
    path = frame.rgb_path if kind == "rgb" else frame.depth_path
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DatasetError, match=path.name):
        (frame.rgb if kind == "rgb" else frame.depth_m)()


def test_a_scan_that_becomes_shorter_between_two_looks_is_refused(dataset, monkeypatch):
    path = scan_path(dataset.folder, 3)
    size = path.stat().st_size
    path.write_bytes(path.read_bytes()[:160])
    with pytest.raises(DatasetError, match=rf"the file changed while it was read \(from {size} to 160 bytes\)"):
        read_rows(path, size)
    monkeypatch.setattr("model_training.datasets.dataset.size_of", lambda _: size)
    with pytest.raises(DatasetError, match=r"000003\.bin"):
        dataset.scan(3)


def test_a_system_error_is_reported_with_the_file(tmp_path):
    path = tmp_path / "a.bin"
    for read in (read_bytes, size_of):
        with pytest.raises(DatasetError, match=r"a\.bin: the file is missing, or was removed"):
            read(path)
    with pytest.raises(DatasetError, match=r"a\.bin: the file cannot be read \(Input/output error\)"), reading(path):
        raise OSError(5, "Input/output error")
    assert files.unreadable(path, PermissionError(13, "Permission denied")).field == "a.bin"


@pytest.mark.parametrize("kept", [0, 5, 40, 100, 300])
@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_arrays_that_were_written_in_part_are_named_with_the_remedy(tmp_path, suffix, kept):
    path = tmp_path / f"a{suffix}"
    with path.open("wb") as file:
        np.save(file, np.arange(100.0)) if suffix == ".npy" else np.savez(file, a=np.arange(100.0))
    path.write_bytes(path.read_bytes()[:kept])

    def read():
        with path.open("rb") as file:
            found = np.load(file, allow_pickle=False)
            return found if suffix == ".npy" else found["a"]

    with pytest.raises(DatasetError, match=rf"a\{suffix}: the file is damaged .*; make it anew"):
        read_arrays(path, read, remedy="make it anew")
