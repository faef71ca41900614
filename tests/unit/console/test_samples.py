"""The console reads sample pairs from one folder only."""

import json
from pathlib import Path
from typing import Any

import pytest

from service.console.samples import Samples
from service.errors import DatasetError, UnknownSampleError

CAMERA = {"width": 64, "height": 48, "fx": 32, "fy": 32, "cx": 31.5, "cy": 23.5}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write(tmp_path / "samples" / "one")
    return tmp_path / "samples"


def write(sample: Path, **files: Any) -> None:
    sample.mkdir(parents=True)
    given = {"rgb.jpg": b"rgb", "depth.png": b"depth", "request.json": json.dumps({"camera": CAMERA}).encode()} | files
    for name, content in given.items():
        if content is not None:
            (sample / name).write_bytes(content)


def test_a_pair_has_pictures_request_and_no_truth_where_there_is_none(folder: Path) -> None:
    samples = Samples.open(folder)
    (sample,) = samples.by_name.values()
    assert sample.message().rgb == "samples/one/rgb"
    assert (sample.request.camera.width, sample.truth) == (64, None)
    assert samples.picture("one", "depth").path.read_bytes() == b"depth"
    assert samples.picture("one", "rgb").media_type == "image/jpeg"


def test_the_ground_truth_is_written(folder: Path) -> None:
    write(folder / "two", **{"truth.json": b'{"position": {"x": 1, "y": 2, "z": 3}, "heading_deg": 90}'})
    truth = Samples.open(folder).by_name["two"].truth
    assert truth is not None
    assert (truth.position.y, truth.heading_deg) == (2, 90)


@pytest.mark.parametrize("name", ["two", "../one", "", "one/rgb"])
def test_a_name_that_is_not_in_the_list_is_unknown(folder: Path, name: str) -> None:
    with pytest.raises(UnknownSampleError, match="known samples: one"):
        Samples.open(folder).picture(name, "rgb")


def test_a_link_out_of_the_folder_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "secret.png").write_bytes(b"secret")
    (folder / "one" / "depth.png").unlink()
    (folder / "one" / "depth.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(DatasetError, match="leads out of the folder"):
        Samples.open(folder)


@pytest.mark.parametrize(
    ("files", "told"),
    [
        ({"rgb.jpg": None}, "no rgb image"),
        ({"request.json": b"{"}, "not readable JSON"),
        ({"request.json": None}, "not readable JSON"),
        ({"request.json": b'{"camera": {}}'}, "Field required"),
        ({"truth.json": b"[]"}, "correct the file"),
    ],
)
def test_an_incomplete_pair_is_refused_by_name(folder: Path, files: dict[str, Any], told: str) -> None:
    write(folder / "two", **files)
    with pytest.raises(DatasetError, match=f"two.*{told}"):
        Samples.open(folder)


def test_a_folder_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="STREETFIX_SAMPLES"):
        Samples.open(tmp_path / "nowhere")


def test_names_that_no_address_holds_are_passed_over(folder: Path) -> None:
    for name in (".hidden", "with space", "ä"):
        (folder / name).mkdir()
    assert list(Samples.open(folder).by_name) == ["one"]
