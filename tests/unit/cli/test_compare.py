"""``streetfix compare`` as a user calls it."""

import json
import shutil
from pathlib import Path

import pytest

from model_training.cli.compare import command
from model_training.evaluation.predict import Predictions
from service.errors import DatasetError

SET = "drive1_precise"


@pytest.fixture
def moved(saved_run: Path, tmp_path: Path) -> Path:
    """Return the same run with the first query answered at the truth and the others 40 m away. All answers are accepted."""
    folder = shutil.copytree(saved_run, tmp_path / "moved")
    p = Predictions.load(folder / "answers" / f"{SET}.npz")
    p.T_answer[:] = p.T_true
    p.T_answer[1:, 0, 3] += 40.0
    p.status[:] = "LOCALIZED"
    p.save(folder / "answers" / f"{SET}.npz")
    return folder


def test_it_writes_a_page_with_the_pictures_of_what_changed_and_figures(
    saved_run: Path, moved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], page_of
) -> None:
    command(moved, saved_run, out=tmp_path / "out", json_file=tmp_path / "deep" / "found.json", dataset=None)
    figures = json.loads((tmp_path / "deep" / "found.json").read_text())
    told = " ".join(capsys.readouterr().out.split())
    assert figures["verdict"] in told
    page = page_of((tmp_path / "out" / "index.html").read_text())
    changed = len(figures["gained"]) + len(figures["lost"])
    assert changed > 0
    assert len([image for image in page.of("img") if image.get("class") != "plot"]) == 2 * changed
    assert len([drawing for drawing in page.of("svg") if drawing["class"] == "small-plan"]) == changed
    assert [image["id"] for image in page.of("image")] == ["ground"]
    assert figures["verdict"] in page.text


def test_without_data_and_map_the_page_says_so_and_is_written(
    saved_run: Path, moved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], page_of
) -> None:
    for run in (own := shutil.copytree(saved_run, tmp_path / "own"), moved):
        settings = json.loads((run / "run.json").read_text())
        settings["dataset"]["path"] = settings["map"]["path"] = str(tmp_path / "gone")
        (run / "run.json").write_text(json.dumps(settings))
    command(moved, own, out=tmp_path / "out", json_file=None, dataset=None)
    told = capsys.readouterr().out
    assert "the page has no images" in told
    assert "the page has no map" in told
    page = page_of((tmp_path / "out" / "index.html").read_text())
    assert [image.get("class") for image in page.of("img")] == ["plot", "plot"]


def test_a_dataset_that_was_named_must_be_one(saved_run: Path, moved: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="not a complete dataset"):
        command(moved, saved_run, out=tmp_path / "out", json_file=None, dataset=tmp_path)
