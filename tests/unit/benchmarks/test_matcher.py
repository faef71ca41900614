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


def rows_of(tmp_path, monkeypatch, simulated, recorded=None):
    monkeypatch.setattr(matcher, "imported", lambda *_: "recording")
    monkeypatch.setattr(matcher, "disparity_errors", lambda *_: recorded or errors_of(0.5))
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


def points_of(*points):
    """Return points of one image row, from triples of error (pixels), texture and depth (metres)."""
    error_px, textured, z_m = (np.array(each) for each in zip(*points, strict=True))
    count = len(points)
    return DisparityErrors(error_px.astype(float), textured, z_m.astype(float), np.zeros(count, int), np.arange(count))


def test_outliers_are_counted_by_texture_and_distance_with_their_matched_points(tmp_path, monkeypatch):
    """An outlier is off by more than 3 px. A point at 10 m counts for the range that begins there."""
    nan = float("nan")
    recorded = points_of(
        *((-3.5, True, 6.0), (1.0, True, 6.0), (nan, True, 6.0)),
        *((4.0, True, 10.0), (3.0, True, 12.0), (0.5, True, 15.0), (0.5, True, 19.9)),
        *((9.0, False, 6.0), (1.0, False, 7.0), (1.0, False, 8.0), (nan, False, 30.0)),
        *((9.0, True, 4.9), (9.0, True, 40.0)),  # outside of all ranges
    )
    rows = rows_of(tmp_path, monkeypatch, errors_of(0.5), recorded)

    def shares(kind, suffix=""):
        found = [
            rows[f"real.matcher.{kind}outliers_{range_m}_m{suffix}"] for range_m in ("5_to_10", "10_to_20", "20_to_40")
        ]
        return [(each["value"], each["n"]) for each in found]

    assert shares("textured.") == [(1 / 2, 2), (1 / 4, 4), (None, 0)]
    assert shares("untextured.") == [(1 / 3, 3), (None, 0), (None, 0)]
    assert shares("") == [(2 / 5, 5), (1 / 4, 4), (None, 0)]
    assert shares("untextured.", ".simulated") == [
        (None, 0),
        (0.0, 5000),
        (None, 0),
    ]  # all points without a match are textured
    assert rows["real.matcher.untextured.outliers_20_to_40_m"]["why"] == "no matched point at this distance"
    unmatched = [rows[f"real.matcher.{kind}.unmatched"] for kind in ("textured", "untextured")]
    assert [(each["value"], each["n"]) for each in unmatched] == [(1 / 9, 9), (1 / 4, 4)]
    assert rows["real.matcher.correlation_length"]["n"] == 11


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
