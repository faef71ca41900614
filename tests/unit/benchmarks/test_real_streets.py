"""Rows of real drives: the status applied, and forced figures beside."""

import numpy as np
import pytest

from benchmarks.real.streets import answer_rows, status_rows
from benchmarks.report import Report


def rows_of(report):
    return {row["id"]: row for row in report.rows}


def test_figures_respect_the_status_and_forced_ones_stand_beside(tmp_path):
    report = Report("x", "x", folder=tmp_path)
    errors, accepted = np.array([0.1, 0.2, 5.0, 7.0, np.inf]), np.array([1, 0, 1, 0, 0], bool)
    status_rows(report, "real.d", errors, accepted, bars=(0.95, 0.02, 0.12))
    rows = rows_of(report)
    assert {name.removeprefix("real.d."): row["value"] for name, row in rows.items()} == {
        "answered": 0.4, "answered_within_1_m": 0.2, "answered_wrong": 0.2, "median_m": 2.55, "forced_within_1_m": 0.4,
        "forced_median_m": 2.6,
    }  # fmt: skip
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
