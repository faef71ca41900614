"""Rows that compare simulated with real matching errors, for known errors."""

import numpy as np
import pytest

from benchmarks.real import matcher
from benchmarks.report import Report
from model_training.evaluation.disparity_errors import DisparityErrors


def errors_of(size):
    """Return 10,000 errors of one magnitude and both signs. Half are textured, and every tenth point has no match."""
    count = 10_000
    error = size * np.random.default_rng(0).choice([-1.0, 1.0], count)
    error[::10] = np.nan
    return DisparityErrors(
        error, np.arange(count) % 2 == 0, np.full(count, 12.0), np.arange(count) // 100, np.arange(count) % 100
    )


def rows_of(tmp_path, monkeypatch, simulated):
    monkeypatch.setattr(matcher, "imported", lambda *_: "recording")
    monkeypatch.setattr(matcher, "disparity_errors", lambda *_: errors_of(0.5))
    monkeypatch.setattr(matcher, "simulated_errors", lambda _: simulated)
    report = Report("x", "x", folder=tmp_path)
    matcher.matcher_rows(report, tmp_path, tmp_path)
    return {row["id"]: row for row in report.rows}


@pytest.mark.parametrize(("size", "holds"), [(0.5, True), (0.39, False), (0.6, True), (0.7, False)])
def test_ratios_are_simulated_over_recorded_sizes_and_must_be_near_one(tmp_path, monkeypatch, size, holds):
    rows = rows_of(tmp_path, monkeypatch, errors_of(size))
    for kind in ("textured", "untextured"):
        for name in ("median", "percentile_90"):
            row = rows[f"real.matcher.error_ratio.{kind}.{name}"]
            assert row["value"] == pytest.approx(size / 0.5)
            assert row["holds"] is holds
    assert rows["real.matcher.textured.unmatched"]["value"] == pytest.approx(0.2)  # every tenth is an even one
    assert rows["real.matcher.outliers_10_to_20_m"]["value"] == 0.0


def test_cities_are_joined_with_their_rows_apart(tmp_path, monkeypatch):
    monkeypatch.setattr(matcher, "simulate", lambda *_: None)
    monkeypatch.setattr(matcher, "Dataset", lambda folder: folder)
    monkeypatch.setattr(matcher, "disparity_errors", lambda *_: errors_of(1.0))
    found = matcher.simulated_errors(tmp_path)
    assert len(found.error_px) == matcher.DRIVES * 10_000
    assert len(np.unique(found.line)) == matcher.DRIVES * 100


def test_without_recordings_the_row_says_so(tmp_path, monkeypatch):
    report = Report("x", "x", folder=tmp_path)
    monkeypatch.setattr(matcher, "imported", lambda *_: None)
    matcher.matcher_rows(report, tmp_path / "data", tmp_path)
    (row,) = report.rows
    assert (row["value"], row["why"]) == (None, "no recordings at data")
