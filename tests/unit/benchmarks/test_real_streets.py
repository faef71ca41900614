"""Rows of real drives: figures by status, and forced figures."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.real import streets
from benchmarks.real.confidence import (
    DriveConfidence,
    JudgedQueries,
    calibrated_elsewhere_rows,
    confidence_rows,
    judged_answers,
    pooled_confidence_rows,
    with_correction,
)
from benchmarks.real.peers import pooled_rows
from benchmarks.real.streets import answer_rows, inlier_rows, status_rows
from benchmarks.real.variants import EveryScan, grey
from benchmarks.report import Report
from model_training.calibration import elsewhere
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


def judged(name, *, inside, outside):
    """Queries as (confidence, right) in the map, and confidences outside it. A correction halves each confidence."""
    before = np.array([confidence for confidence, _ in inside] + outside)
    right = np.array([is_right for _, is_right in inside] + [False] * len(outside), bool)
    return JudgedQueries(name, np.arange(len(before)) >= len(inside), right, before, before / 2)


def test_calibration_errors_are_those_of_all_queries_together(tmp_path):
    """One bin: half of the weight on three queries in the map (mean confidence 0.9, all right), half on six outside it (0.5).

    The mean confidence is 0.7 and half of the weight is right, so the error is 0.2. Halved, the mean is 0.35 and the error 0.15.
    """
    report = Report("x", "x", folder=tmp_path)
    drive = judged("kitti_0005", inside=[(0.9, True), (0.9, True)], outside=[0.5, 0.5])
    strangers = judged("kitti_0013 on the map of kitti_0005", inside=[], outside=[0.5] * 4)
    stereo = judged("kitti_stereo", inside=[(0.9, True)], outside=[])
    pooled_confidence_rows(report, [drive, strangers, stereo])
    rows = rows_of(report)
    assert rows["real.ece"]["value"] == pytest.approx(0.2)
    assert rows["real.ece"]["n"] == 9
    assert rows["real.ece_after_rig_calibration"]["value"] == pytest.approx(0.15)
    assert [row["holds"] for row in rows.values()] == [False, False]
    assert rows["real.ece"]["why"].startswith(
        "3 queries in the map and 6 outside it. Of these, kitti_0005: 2 and 2. "
        "kitti_0013 on the map of kitti_0005: 0 and 4. kitti_stereo: 1 and 0. No real query"
    )
    assert "drive 0005 helped to choose the features" in rows["real.ece"]["why"]


def test_the_bins_of_pooled_queries_follow_from_their_number(tmp_path):
    """Forty queries have two bins of equal weight. Outside the map the confidence is 0. In it, it is 0.75, and all are right."""
    report = Report("x", "x", folder=tmp_path)
    pooled_confidence_rows(report, [judged("d", inside=[(0.75, True)] * 4, outside=[0.0] * 36)])
    assert rows_of(report)["real.ece"]["value"] == pytest.approx(0.5 * 0.25)


def test_answers_outside_the_map_are_wrong_and_have_the_correction_of_others(answers_of):
    """Log odds of 0.5 are 0, and the corrected ones -0.5: a confidence of 0.3775. An answer without registration has a confidence of 0."""
    near, far = [[0, 0], [0, 0], [0, 0]], [[0.1, 0], [3, 0], [0.2, 0]]
    found = replace(answers_of(near, far), confidence=np.array([0.5, 0.5, np.nan]))
    inside = judged_answers("a", found, CORRECTION, outside=False)
    assert inside.right.tolist() == [True, False, True]
    np.testing.assert_allclose(inside.before, [0.5, 0.5, 0.0])
    np.testing.assert_allclose(inside.after, [0.37754, 0.37754, 0.0], atol=1e-5)
    outside = judged_answers("b", found, CORRECTION, outside=True)
    assert not outside.right.any()
    assert outside.outside.all()


def test_a_drive_is_judged_by_corrections_of_its_other_blocks(stock_map, small_dataset, monkeypatch, tmp_path):
    monkeypatch.setattr(elsewhere, "FEWEST_LEFT", 2)
    report, localizer = Report("x", "x", folder=tmp_path), Localizer.open(MapBundle.open(stock_map))
    found = confidence_rows(report, "d", small_dataset, localizer, "drive1_precise")
    rows, judged_of = rows_of(report), found.judged
    assert rows["real.d.ece"]["value"] == pytest.approx(judged_of.error(judged_of.before))
    assert rows["real.d.ece_after_rig_calibration"]["value"] == pytest.approx(judged_of.error(judged_of.after))
    assert rows["real.d.ece"]["n"] == len(judged_of.right) > 5
    assert (~judged_of.outside).sum() == 5


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


def test_all_recordings_take_part_in_the_pooled_error(tmp_path, monkeypatch, answers_of):
    """Two drives of two queries, each asked on both maps, and one stereo frame."""
    two, one = ([[0, 0], [0, 0]], [[0.1, 0], [0.2, 0]]), ([[0, 0]], [[0.1, 0]])
    answers = {
        "kitti_0005": answers_of(*two),
        "kitti_0013": answers_of(*two, status=["LOCALIZED", "AMBIGUOUS"]),
        "frames": answers_of(*one),
    }
    stand_in: dict[str, Any] = {name: SimpleNamespace(name=name) for name in streets.DRIVES}
    made = {name: streets.Street(name, each, each) for name, each in stand_in.items()}
    drive = judged("d", inside=[(0.9, True)] * 2, outside=[0.1] * 2)
    monkeypatch.setattr(streets, "_street", lambda _report, _data, _work, name: made[name])
    monkeypatch.setattr(streets, "predict", lambda _localizer, dataset, _queries: answers[dataset.name])
    monkeypatch.setattr(streets, "stereo_frames", lambda *_: (SimpleNamespace(name="frames"), tmp_path))
    monkeypatch.setattr(streets, "confidence_rows", lambda *_: DriveConfidence(drive, CORRECTION))
    monkeypatch.setattr(streets, "peer_rows", lambda *_: (0.1, 0.2, 2))
    monkeypatch.setattr(streets, "with_correction", lambda localizer, _: localizer)
    monkeypatch.setattr(streets, "MapBundle", SimpleNamespace(open=lambda _: None))
    monkeypatch.setattr(streets, "Localizer", SimpleNamespace(open=lambda _: None))
    for name in ("paper_network", "_stage_rows", "track_rows", "prior_rows", "sequence_rows", "answer_rows"):
        monkeypatch.setattr(streets, name, lambda *_: None)
    report = Report("x", "x", folder=tmp_path)
    streets.street_rows(report, tmp_path, tmp_path)
    rows = rows_of(report)
    assert rows["real.strangers.accepted"]["value"] == 0.75
    assert rows["real.ece"]["n"] == 13
    assert (
        "kitti_0013 on the map of kitti_0005: 0 and 2. kitti_0005 on the map of kitti_0013: 0 and 2. kitti_stereo: 1 and 0."
        in (rows["real.ece"]["why"])
    )
