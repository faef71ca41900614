"""``streetfix evaluate`` as a user calls it."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from model_training.cli import evaluate as module
from model_training.datasets.dataset import Dataset
from model_training.evaluation.why_refused import NO_CAUSE, Cause
from service.cli.main import main
from service.maps.reader import MapBundle
from service.maps.writer import replace_calibration


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return int(end.value.code or 0)


@pytest.fixture
def two_sets(small_dataset: Dataset, tmp_path: Path) -> Path:
    """Return the small dataset with its five queries twice, as ``drive1_precise`` and ``drive2_precise``."""
    folder = shutil.copytree(small_dataset.folder, tmp_path / "two")
    shutil.copytree(folder / "queries" / "drive1_precise", folder / "queries" / "drive2_precise")
    return folder


@pytest.fixture
def raw_is(monkeypatch: pytest.MonkeyPatch, small_map: Path, two_sets: Path) -> Callable[..., None]:
    """Make the raw range image correct for the queries marked with 1, for each setting."""

    def put(**right: str) -> None:
        xy = MapBundle.open(small_map).T_map_place[:, :2, 3]
        truth = [
            f.T_map_camera[:2, 3]
            for name in ("drive1_precise", "drive2_precise")
            for f in Dataset(two_sets).queries(name)
            if f.T_map_camera is not None
        ]
        distance = np.linalg.norm(xy[None] - np.array(truth)[:, None], axis=2)
        assert distance.min(axis=1).max() < 5.0 < distance.max(axis=1).min()
        places = {
            setting: np.where([mark == "1" for mark in marks], distance.argmin(axis=1), distance.argmax(axis=1))
            for setting, marks in right.items()
        }
        monkeypatch.setattr(module, "raw_best_views", lambda *_, **__: places)

    return put


def test_the_raw_range_image_has_its_recall_over_all_and_in_each_set(
    raw_is: Callable[..., None],
    two_sets: Path,
    small_map: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    raw_is(cosine="1110010000", masked_l2="1000011100")
    assert run("evaluate", small_map, two_sets, "--raw-baseline", "--json", tmp_path / "found.json") == 0
    figures: dict[str, Any] = json.loads((tmp_path / "found.json").read_text())
    found = [figures, figures["sets"]["drive1_precise"], figures["sets"]["drive2_precise"]]
    assert [each["raw_recall_at_1_5m"] for each in found] == [0.4, 0.6, 0.6]
    assert [each["raw"]["best_setting"] for each in found][1:] == ["cosine", "masked_l2"]
    assert figures["sets"]["drive2_precise"]["raw"]["recall_at_1_5m"] == {"cosine": 0.2, "masked_l2": 0.6}
    row = next(line for line in capsys.readouterr().out.splitlines() if "raw range image R@1" in line)
    assert [cell.strip() for cell in row.strip("│").split("│")] == ["raw range image R@1", "40.00%", "60.00%", "60.00%"]


def test_a_report_folder_holds_page_answers_and_settings(
    small_dataset: Dataset, small_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("evaluate", small_map, small_dataset.folder, "--report", tmp_path / "runs" / "one") == 0
    assert {
        str(path.relative_to(tmp_path / "runs" / "one"))
        for path in (tmp_path / "runs" / "one").rglob("*")
        if path.is_file()
    } == {
        "index.html",
        "run.json",
        "figures.json",
        "answers/drive1_precise.npz",
    }
    assert f"report: {tmp_path}/runs/one/index.html" in capsys.readouterr().out.replace("\n", "")


@pytest.fixture
def calibrated(small_map: Path, tmp_path: Path, calibration_json: Callable[..., dict[str, Any]]) -> Path:
    """Return the small map with a calibration for its encoder."""
    folder = shutil.copytree(small_map, tmp_path / "town")
    sha256 = MapBundle.open(small_map).manifest.encoder_sha256
    replace_calibration(folder, calibration_json(measured_on={"encoder_sha256": sha256}))
    return folder


def test_what_to_check_is_printed_and_in_the_figures_and_the_report(
    small_dataset: Dataset,
    calibrated: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "causes", lambda *_: [Cause("the depth unit is off", "check <scale_m>")])
    given = ("--json", tmp_path / "found.json", "--report", tmp_path / "page")
    assert run("evaluate", calibrated, small_dataset.folder, *given) == 0
    assert "  1. the depth unit is off: check <scale_m>" in capsys.readouterr().out
    for file in (tmp_path / "found.json", tmp_path / "page" / "figures.json"):
        figures = json.loads(file.read_text())
        causes = [{"what": "the depth unit is off", "check": "check <scale_m>"}]
        assert figures["sets"]["drive1_precise"]["causes"] == causes
    page = (tmp_path / "page" / "index.html").read_text()
    assert "<li>the depth unit is off: check &lt;scale_m&gt;</li>" in page


def test_a_report_says_that_nothing_is_out_of_range_only_if_few_answers_are_accepted() -> None:
    from model_training.reporting.run_page import causes_of

    few, many = ({"sets": {"one": {"localized": share, "causes": []}}} for share in (0.2, 0.25))
    assert NO_CAUSE in causes_of(few)
    assert causes_of(many) == ""
    assert causes_of({"sets": {"one": {"localized": 0.0}}}) == ""  # not calibrated


def test_forced_figures_stand_beside_accepted_ones_and_every_error_has_its_status(
    small_dataset: Dataset, small_map: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    assert run("evaluate", small_map, small_dataset.folder, "--list", "2") == 0
    told = capsys.readouterr().out
    for label in (
        "accepted, within 1 m",
        "forced, within 1 m",
        "accepted, over 1 m off",
        "R@1 at 5 m, after registration",
        "drive1_precise: the 2 worst of 5 queries",
    ):
        assert label in told
    listed = told.split("the 2 worst of 5 queries")[1].splitlines()
    assert sum("LOCALIZED" in line and line.rstrip().endswith("°") for line in listed) == 2


def test_recall_of_retrieval_alone_is_not_called_registered(
    small_dataset: Dataset, small_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("evaluate", small_map, small_dataset.folder, "--no-refine", "--report", tmp_path / "page") == 0
    for told in (capsys.readouterr().out, (tmp_path / "page" / "index.html").read_text()):
        assert "R@1 at 5 m" in told
        assert "after registration" not in told


def test_a_dataset_in_the_place_of_the_map_is_named(
    small_dataset: Dataset, small_map: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("evaluate", small_dataset.folder, small_map) == 1
    assert (
        f"give the map bundle first: streetfix evaluate {small_map} {small_dataset.folder}" in capsys.readouterr().err
    )
    assert run("map", "update", small_dataset.folder, small_map, "--out", small_map.parent / "no") == 1
    assert f"streetfix map update {small_map} {small_dataset.folder}" in capsys.readouterr().err


def test_the_mode_is_in_the_table_the_figures_the_list_and_the_report(
    small_dataset: Dataset, small_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("--frames", "4", "--prior-std-m", "3", "--json", tmp_path / "found.json", "--report", tmp_path / "page")
    assert run("evaluate", small_map, small_dataset.folder, *given) == 0
    told, mode = capsys.readouterr().out, "4 consecutive images in one query, prior of 3 m"
    assert mode in " ".join(told.split())
    assert "ground truth, with simulated errors" in told
    listed = told.split("all 2 queries")[1]
    assert sorted(line.split()[0] for line in listed.splitlines() if "LOCALIZED" in line) == ["3", "4"]
    figures = json.loads((tmp_path / "found.json").read_text())
    assert (figures["mode"], figures["queries"]) == ({"frames": 4, "prior_std_m": 3.0, "track": False}, 2)
    assert figures["sets"]["drive1_precise"]["odometry"] == "ground truth, with simulated errors"
    page = (tmp_path / "page" / "index.html").read_text()
    assert f"{mode}, relative poses from ground truth, with simulated errors" in page
    assert "drive1_precise, query 4" in page
    assert "drive1_precise, query 0" not in page


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--frames", "3", "--track"), "--frames and --track exclude each other"),
        (("--track", "--workers", "2"), "--workers and --track exclude each other"),
        (("--track", "--no-refine"), "--no-refine and --track exclude each other"),
        (("--track", "--stages"), "leave out --stages or --track"),
        (("--frames", "3", "--stages"), "leave out --stages or --frames"),
        (("--prior-std-m", "3", "--stages"), "leave out --stages or --prior-std-m"),
        (("--frames", "3", "--raw-baseline"), "leave out --raw-baseline or --frames"),
        (("--frames", "17"), "--frames': Input should be less than or equal to 16"),
    ],
)
def test_modes_that_do_not_go_together_are_refused(
    options: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert run("evaluate", "map", "data", *options) == 2
    assert message in " ".join(capsys.readouterr().err.split())
