import numpy as np
import pytest

from benchmarks import rigs
from benchmarks.full import gross_error_row
from benchmarks.report import Report
from model_training.calibration.answer_code import code_of_answers
from model_training.calibration.cross_check import FamilyFigures
from model_training.calibration.fit import CalibrationData, pooled
from service.confidence.features import FEATURES

COUNT, MARGIN, SHARE = len(FEATURES), FEATURES.index("margin"), FEATURES.index("log_share")


def family(name, seed, *, count=1000):
    """Half of the queries are in the map. All answers to these are right, with unit errors and unit covariances."""
    rng = np.random.default_rng(seed)
    known = np.arange(count) % 2 == 0
    evidence = rng.normal(size=(count, COUNT))
    evidence[:, MARGIN] += np.where(known, 4.0, -4.0)
    evidence[:, SHARE] = 0.0
    error = np.where(known[:, None], 0.1 * rng.normal(size=(count, 6)), np.nan)
    return CalibrationData(
        evidence=evidence,
        right=known,
        known=known,
        kind=np.where(known, "clear", "other_city"),
        family=np.full(count, name),
        error=error,
        covariance=np.tile(0.01 * np.eye(6), (count, 1, 1)),
        heading_rad=np.where(known, 0.5, np.nan),
    )


@pytest.fixture
def rows(monkeypatch, tmp_path, encoder_file):
    data = pooled([family("car", 1), family("rings", 2), family("robot", 3), family("lorry", 4)])
    monkeypatch.setattr(rigs, "collected", lambda *_, **__: data)
    monkeypatch.setattr(rigs, "related", lambda: {"lidar.hdl": ("car", "rings", "robot"), "depth.none": ("rings",)})
    report = Report("accuracy", "make evaluate")
    rigs.rig_rows(report, encoder_file, tmp_path)
    return {row["id"]: row for row in report.rows}


def test_every_family_has_its_rows(rows):
    for name in ("car", "rings", "robot"):
        assert rows[f"rigs.{name}.within_1_m"]["value"] == 1.0
        assert rows[f"rigs.{name}.ece"]["n"] == 1000
        assert rows[f"rigs.{name}.ece"]["value"] < 0.1
        assert rows[f"rigs.{name}.covariance_95_coverage"]["value"] == pytest.approx(0.95, abs=0.04)
        assert rows[f"rigs.{name}.sigma_coverage_gap"]["value"] < 0.1


def test_families_with_the_same_sensor_are_left_out_together(rows):
    """The group has two families that are fitted, and the third takes part in no fit. A group of one has no row."""
    assert rows["rigs.without.lidar.hdl.ece"]["n"] == 2000
    assert rows["rigs.without.lidar.hdl.ece"]["why"] == "car, robot"
    assert rows["rigs.without.lidar.hdl.ece"]["value"] < 0.1
    assert rows["rigs.without.worst_ece"]["value"] == rows["rigs.without.lidar.hdl.ece"]["value"]
    assert not [row for row in rows if row.startswith("rigs.without.depth")]


def test_the_worst_family_is_named(rows):
    """The calibration is not fitted to sparse rings. They count for the calibration error all the same."""

    def worst_of(*names):
        return max(names, key=lambda name: rows[f"rigs.{name}.ece"]["value"])

    assert rows["rigs.worst_ece"]["why"] == worst_of("car", "rings", "robot", "lorry")
    assert rows["rigs.worst_fitted_ece"]["why"] == worst_of("car", "robot", "lorry")
    assert rows["rigs.worst_within_1_m"]["why"] in ("car", "robot", "lorry")
    gap = rows["rigs.worst_sigma_coverage_gap"]
    assert gap["value"] == max(
        rows[f"rigs.{name}.sigma_coverage_gap"]["value"] for name in ("car", "rings", "robot", "lorry")
    )
    assert rows[f"rigs.{gap['why']}.sigma_coverage_gap"]["value"] == gap["value"]


def test_a_rig_without_a_localized_answer_has_no_share_of_wrong_ones(tmp_path):
    """Its bar does not hold, because nothing shows it. A share of out-of-map queries needs such queries."""
    report = Report("x", "x", folder=tmp_path)
    none = float("nan")
    rigs._figure_rows(report, "rigs.phone", FamilyFigures("phone", 500, 0, 0, 0.02, 0.08, 0.0, 0.08, none, none))
    rows = {row["id"].removeprefix("rigs.phone."): row for row in report.rows}
    wrong = rows["wrong_of_localized"]
    assert (wrong["value"], wrong["n"], wrong["holds"], wrong["why"]) == (None, 0, False, "no LOCALIZED answer")
    assert rows["right_but_refused"]["value"] == 0.08
    assert "outside_accepted" not in rows


def test_a_family_without_a_query_in_the_map_refuses_no_right_answer(tmp_path):
    report = Report("x", "x", folder=tmp_path)
    none = float("nan")
    rigs._figure_rows(report, "rigs.lost", FamilyFigures("lost", 0, 40, 0, 0.0, none, none, none, none, 0.0))
    row = next(row for row in report.rows if row["id"] == "rigs.lost.right_but_refused")
    assert (row["value"], row["holds"], row["why"]) == (None, False, "no query in the map")


def test_the_coverage_of_fitted_families_is_said_to_be_in_sample(rows):
    """The factors of the covariance were fitted to the answers of the car, not to those of the sparse rings."""
    assert rows["rigs.car.covariance_95_coverage"]["why"].startswith("in-sample")
    assert "; in-sample" in rows["rigs.car.sigma_coverage_gap"]["why"]
    assert "why" not in rows["rigs.rings.covariance_95_coverage"]
    assert "in-sample" not in rows["rigs.rings.sigma_coverage_gap"]["why"]


def test_stored_answers_of_the_present_code_belong_to_this_run():
    assert rigs.run_of_answers({"a.npz": code_of_answers()}, "make it") == (None, None)


def test_rows_of_older_answers_belong_to_the_oldest_commit_that_gave_them(monkeypatch):
    commits = {"new": "b" * 40, "old": "a" * 40}
    ages = {"a" * 40: "7", "b" * 40: "12"}
    monkeypatch.setattr(rigs, "commit_with_code", commits.get)
    monkeypatch.setattr(rigs, "git", lambda *arguments: ages[arguments[-1]])
    codes: dict[str, str | None] = {"a.npz": "new", "b.npz": "old", "c.npz": code_of_answers()}
    run, note = rigs.run_of_answers(codes, "make it")
    assert run is not None
    assert (run.commit, run.command, run.date) == ("a" * 40, "make it", None)
    assert run.before
    assert note == "Rows `rigs.*`: the answers of 2 of 3 files are of commits aaaaaaaaaa, bbbbbbbbbb."


@pytest.mark.parametrize("code", [None, "of no commit"])
def test_answers_of_an_unknown_version_are_said_to_be_so(monkeypatch, code):
    monkeypatch.setattr(rigs, "commit_with_code", lambda _: None)
    run, note = rigs.run_of_answers({"a.npz": code, "b.npz": code_of_answers()}, "make it")
    assert run is None
    assert note is not None
    assert "the commit that gave the answers is unknown for 1 of 2 files, for example a.npz" in note


def test_the_safe_default_has_a_bar_on_wrong_answers_of_the_accepted_ones(tmp_path):
    """One of 100 LOCALIZED answers is more than 1 m off: the bar of 0.01 holds. With two it does not."""
    for wrong, holds in ((1, True), (2, False)):
        report = Report("x", "x", folder=tmp_path)
        accepted = np.arange(150) < 100
        gross_error_row(report, "stereo", accepted, accepted & (np.arange(150) >= wrong))
        (row,) = report.rows
        assert (row["id"], row["value"], row["n"]) == ("doubt.gross_errors.stereo", wrong / 100, 100)
        assert row["holds"] is holds
    gross_error_row(report, "precise", np.zeros(5, bool), np.zeros(5, bool))
    assert report.rows[-1]["value"] is None
