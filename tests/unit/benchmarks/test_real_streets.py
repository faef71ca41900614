"""Rows of real drives: figures by status, and forced figures."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.real.confidence import (
    CalibrationErrors,
    calibrated_elsewhere_rows,
    pooled_confidence_rows,
    with_correction,
)
from benchmarks.real.peers import pooled_rows
from benchmarks.real.streets import answer_rows, inlier_rows, status_rows
from benchmarks.real.variants import EveryScan, grey
from benchmarks.report import Report
from model_training.datasets.dataset import Dataset
from model_training.evaluation.stages import QueryStages
from service.geometry.camera import PinholeCamera
from service.localization.localizer import Localizer
from service.maps.calibration import RigCorrection
from service.maps.reader import MapBundle
from service.retrieval.query import Query

CORRECTION = RigCorrection(
    scale=1.5,
    offset=-0.5,
    lower_only=False,
    source="drive",
    measured_on="a drive",
    frames=10,
    right=8,
    outside=5,
    error_before=0.1,
    error_after=0.05,
    accepted=5,
    accepted_wrong=0,
    wrong_share_upper=0.5,
    outside_accepted=0,
    outside_share_upper=0.5,
)


def rows_of(report):
    return {row["id"]: row for row in report.rows}


def test_figures_respect_the_status_and_forced_ones_stand_beside(tmp_path):
    report = Report("x", "x", folder=tmp_path)
    errors, accepted = np.array([0.1, 0.2, 5.0, 7.0, np.inf]), np.array([1, 0, 1, 0, 0], bool)
    status_rows(report, "real.d", errors, accepted, bars=(0.95, 0.02, 0.12))
    rows = rows_of(report)
    assert {name.removeprefix("real.d."): row["value"] for name, row in rows.items()} == {
        "answered": 0.4,
        "answered_within_1_m": 0.2,
        "answered_wrong": 0.2,
        "median_m": 2.55,
        "forced_within_1_m": 0.4,
        "forced_median_m": 2.6,
    }
    assert not any(rows[f"real.d.{name}"]["holds"] for name in ("answered_within_1_m", "answered_wrong", "median_m"))


def test_a_median_of_no_accepted_answer_misses_its_bar_and_says_why(tmp_path):
    report = Report("x", "x", folder=tmp_path)
    status_rows(report, "real.d", np.array([0.1, 0.2]), np.array([False, False]), bars=(1.0, 0.02, 0.12))
    row = rows_of(report)["real.d.median_m"]
    assert (row["value"], row["holds"], row["why"]) == (None, False, "no answer was accepted")


def test_recall_has_both_distances(tmp_path, answers_of):
    report = Report("x", "x", folder=tmp_path)
    answer_rows(report, "real.d", answers_of([[0, 0], [0, 0], [0, 0]], [[4, 0], [8, 0], [12, 0]]))
    rows = rows_of(report)
    assert rows["real.d.recall_at_1_5m"]["value"] == pytest.approx(1 / 3)
    assert rows["real.d.recall_at_1_10m"]["value"] == pytest.approx(2 / 3)


def test_figures_of_a_variant_have_no_bar(tmp_path, answers_of):
    report = Report("x", "x", folder=tmp_path)
    answer_rows(report, "real.d.grey", answers_of([[0, 0]], [[4, 0]]), bars=False)
    assert not any("bar" in row for row in report.rows)


def test_inliers_are_medians_beside_those_of_the_noise_model(tmp_path):
    """A query without enough points has none and does not count. Only the held-out drive has a bar."""
    report = Report("x", "x", folder=tmp_path)
    shares = [(0.3, 0.5, 0.4), (0.5, 0.6, 0.6), (0.6, 0.7, 0.7), (np.nan, np.nan, np.nan)]
    found = [
        QueryStages(number=k, rank=k, inliers_at_truth=at, inliers_predicted=predicted, inliers_from_truth=ended)
        for k, (at, predicted, ended) in enumerate(shares)
    ]
    inlier_rows(report, "kitti_0005", found)
    inlier_rows(report, "kitti_0013", found)
    rows = rows_of(report)
    names = ("retrieval_at_1_5m", "inliers_at_truth", "inliers_predicted", "inliers_from_truth")
    assert [rows[f"real.kitti_0005.{name}"]["value"] for name in names] == [0.25, 0.5, 0.6, 0.6]
    assert [rows[f"real.kitti_0005.{name}"]["n"] for name in names] == [4, 3, 3, 3]
    assert [row["id"] for row in report.rows if "bar" in row] == ["real.kitti_0013.inliers_at_truth"]
    assert rows["real.kitti_0013.inliers_at_truth"]["holds"]


def test_without_a_registered_query_no_share_of_inliers_is_claimed(tmp_path):
    report = Report("x", "x", folder=tmp_path)
    inlier_rows(report, "kitti_0013", [QueryStages(number=0)])
    row = rows_of(report)["real.kitti_0013.inliers_at_truth"]
    assert (row["value"], row["holds"], row["why"]) == (None, False, "no query has enough points to register")


@pytest.mark.parametrize(("each", "first", "kept"), [(2, 0, [0, 2, 4]), (2, 1, [1, 3]), (3, 2, [2])])
def test_a_sparse_survey_has_every_nth_scan(each, first, kept, monkeypatch):
    monkeypatch.setattr(Dataset, "__init__", lambda *_: None)
    monkeypatch.setattr(Dataset, "survey_poses", lambda _: np.arange(5.0))
    monkeypatch.setattr(Dataset, "scan", lambda _, number: number)
    sparse = EveryScan(Path("d"), each, first)
    assert sparse.survey_poses().tolist() == kept
    assert [sparse.scan(number) for number in range(len(kept))] == kept


def test_a_grey_image_has_three_equal_channels():
    rgb = np.zeros((2, 2, 3), np.uint8)
    rgb[..., 1] = 100
    camera = PinholeCamera(2, 2, 2.0, 2.0, 0.5, 0.5)
    found = grey(Query(rgb=rgb, depth_m=np.ones((2, 2), np.float32), camera=camera)).rgb
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, np.full((2, 2, 3), 59))  # 0.587 of green


def test_drives_are_pooled_by_their_queries_and_ours_must_be_higher(tmp_path):
    """Ten queries at 0.5 and thirty at 0.1 have a share of 0.2."""
    report = Report("x", "x", folder=tmp_path)
    pooled_rows(report, [(0.5, 0.2, 10), (0.1, 0.2, 30)])
    rows = rows_of(report)
    assert rows["real.peers.best_within_1_m"]["value"] == pytest.approx(0.2)
    assert rows["real.peers.ours_within_1_m"]["holds"] is False
    pooled_rows(report, [(0.5, 0.9, 10)])
    assert rows_of(report)["real.peers.ours_within_1_m"]["holds"] is True


def test_calibration_errors_are_pooled_by_the_queries_of_each_drive(tmp_path):
    report = Report("x", "x", folder=tmp_path)
    pooled_confidence_rows(
        report, [CalibrationErrors(10, 0.2, 0.1, CORRECTION), CalibrationErrors(30, 0.04, 0.02, CORRECTION)]
    )
    rows = rows_of(report)
    assert rows["real.ece"]["value"] == pytest.approx(0.08)
    assert rows["real.ece"]["n"] == 40
    assert rows["real.ece_after_rig_calibration"]["value"] == pytest.approx(0.04)
    assert [row["holds"] for row in rows.values()] == [True, True]


def test_without_a_drive_there_are_no_calibration_errors(tmp_path):
    report = Report("x", "x", folder=tmp_path)
    pooled_confidence_rows(report, [])
    assert report.rows == []


def test_the_correction_of_another_drive_changes_the_confidence(stock_map, small_dataset):
    """The corrected log odds are 1.5 times the log odds, less 0.5."""
    localizer = Localizer.open(MapBundle.open(stock_map))
    query = next(iter(small_dataset.queries("drive1_precise"))).query(localizer.bundle.grid)
    before, after = (each.localize(query).confidence for each in (localizer, with_correction(localizer, CORRECTION)))
    assert before is not None
    assert after is not None
    odds = np.log(before / (1 - before))
    assert np.log(after / (1 - after)) == pytest.approx(1.5 * odds - 0.5, abs=1e-6)


def test_rows_with_the_correction_of_another_drive(tmp_path, answers_of):
    """Of three accepted answers one is 3 m off. One of five queries is right and refused."""
    report = Report("x", "x", folder=tmp_path)
    status = ["LOCALIZED"] * 3 + ["AMBIGUOUS"] * 2
    found = answers_of([[0, 0]] * 5, [[0.1, 0], [0.2, 0], [3, 0], [0.3, 0], [9, 0]], status=status)
    calibrated_elsewhere_rows(report, "0005", CORRECTION, found)
    rows = rows_of(report)
    wrong, refused = (rows[f"real.calibrated_on_0005.{name}"] for name in ("wrong_of_localized", "right_but_refused"))
    assert (wrong["value"], wrong["n"], wrong["holds"]) == (pytest.approx(1 / 3), 3, False)
    assert (refused["value"], refused["n"], refused["holds"]) == (pytest.approx(0.2), 5, False)
    assert wrong["why"] == "scale 1.50, offset -0.50"


def test_without_a_localized_answer_no_share_of_them_is_claimed(tmp_path, answers_of):
    report = Report("x", "x", folder=tmp_path)
    found = answers_of([[0, 0]], [[0.1, 0]], status=["AMBIGUOUS"])
    calibrated_elsewhere_rows(report, "0005", CORRECTION, found)
    row = rows_of(report)["real.calibrated_on_0005.wrong_of_localized"]
    assert (row["value"], row["n"], row["holds"]) == (None, 0, False)
    assert row["why"] == "scale 1.50, offset -0.50; no LOCALIZED answer"
