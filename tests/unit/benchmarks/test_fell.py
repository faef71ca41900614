"""Rows that fell since the commit that issue 36 names."""

import json

import pytest

from benchmarks import fell, render
from benchmarks.fell import NO_REASON, Fallen, fallen, interval_of, kept_values, lines
from benchmarks.why_fell import CONFIDENCE, WHY_FELL


def share(value, ci95, **more):
    return {"id": "a", "unit": "share", "value": value, "ci95": ci95} | more


def fell_of(then, row):
    return [each.row_id for each in fallen({row["id"]: then}, [row], {})]


@pytest.mark.parametrize(
    ("then", "row", "is_fallen"),
    [
        (0.96, share(0.9, [0.85, 0.95]), True),
        (0.95, share(0.9, [0.85, 0.95]), False),
        (0.5, share(0.9, [0.85, 0.95]), False),
        (0.96, share(0.9, [0.85, 0.95], better="lower"), False),
        (0.84, share(0.9, [0.85, 0.95], better="lower"), True),
        (0.84, share(0.9, [0.85, 0.95], id="x.wrong_and_accepted"), True),
        (1.0, share(1.0, [0.98, 0.9999999]), False),
    ],
)
def test_a_row_fell_if_its_old_value_is_better_than_the_whole_interval(then, row, is_fallen):
    assert bool(fell_of(then, row)) is is_fallen


@pytest.mark.parametrize(
    ("then", "row", "is_fallen"),
    [
        (0.10, {"id": "a_m", "unit": "m", "value": 0.11}, True),
        (0.10, {"id": "a_m", "unit": "m", "value": 0.09}, False),
        (0.10, {"id": "a_m", "unit": "m", "value": 0.100009}, False),
        (0.5, {"id": "doubt.sigma_coverage_gap.up.stereo", "unit": "share", "value": 0.6}, True),
        (0.5, {"id": "doubt.x.average_precision", "unit": "share", "value": 0.4}, True),
        (0.92, {"id": "doubt.covariance_95_coverage.position.stereo", "unit": "share", "value": 0.97}, False),
        (0.92, {"id": "doubt.covariance_95_coverage.position.stereo", "unit": "share", "value": 0.99}, True),
        (0.86, {"id": "doubt.covariance_95_coverage.position.stereo", "unit": "share", "value": 0.88}, False),
        (0.89, {"id": "doubt.covariance_95_coverage", "unit": "share", "value": 0.88, "better": "inside"}, True),
        (0.5, {"id": "a", "unit": "share", "value": None}, True),
    ],
)
def test_a_row_without_an_interval_fell_if_its_value_is_worse(then, row, is_fallen):
    """A coverage is worse if it is farther outside of 0.90 to 0.98."""
    assert bool(fell_of(then, row)) is is_fallen


def test_a_share_of_counted_queries_has_its_wilson_interval():
    """Eight of ten: 0.4902 to 0.9433, as in the textbooks. A calibration error is no such share."""
    row = {"id": "a.forced_within_1_m", "unit": "share", "value": 0.8, "n": 10}
    assert interval_of(row) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert fell_of(0.94, row) == []
    assert fell_of(0.95, row) == ["a.forced_within_1_m"]
    assert interval_of({"id": "ece", "unit": "share", "value": 0.0228769, "n": 4000}) is None
    assert interval_of({"id": "a", "unit": "m", "value": 1.0, "n": 10}) is None


def test_a_row_that_vanished_fell_and_other_methods_do_not_count():
    then = {"gone": 0.5, "raw.unseen": 0.9, "new": 0.1}
    rows = [{"id": "raw.unseen", "unit": "share", "value": 0.1}, {"id": "new", "unit": "share", "value": 0.2}]
    assert [(each.row_id, each.now) for each in fallen(then, rows, {})] == [("gone", None)]


def test_a_reason_names_the_values_of_then_and_now():
    then, rows = {"a": 0.9, "b": 0.25}, [share(0.5, [0.4, 0.6]), {"id": "b", "unit": "share", "value": 0.75}]
    reasons = {"a": "forced: {then b} -> {now b}, {now c else 0.1 in May}"}
    (found,) = fallen(then, rows, reasons)
    assert found == Fallen("a", 0.9, 0.5, (0.4, 0.6), "forced: 0.250 -> 0.750, 0.1 in May")
    with pytest.raises(ValueError, match=r"why_fell.py: \{now c\}: the report has no value of this row"):
        fallen(then, rows, {"a": "{now c}"})


def test_a_row_without_a_reason_says_so():
    (found,) = fallen({"a": 0.9}, [share(0.5, [0.4, 0.6])], {})
    assert lines([found])[-2] == "| `a` | 0.9 | 0.5 | 0.4000 - 0.6000 | no reason written |"
    assert lines([])[-2] == "No row fell."


def test_the_page_has_the_table_below_the_accuracy_rows(monkeypatch, tmp_path):
    kept = tmp_path / "kept.json"
    kept.write_text(json.dumps({"rows": {"a": 0.9, "none": None}}))
    monkeypatch.setattr(fell, "kept_values", lambda: kept_values(kept))
    told = {"stale_as_of": "f" * 40, "runs": {"r": RUN}, "rows": [share(0.5, [0.4, 0.6], run="r")]}
    assert [line for line in render._section("accuracy", told) if NO_REASON in line]
    assert not [line for line in render._section("other", told) if NO_REASON in line]


RUN = {
    "commit": "c" * 40,
    "dirty": False,
    "date": None,
    "before": "2026-01-01",
    "machine": None,
    "command": "x",
    "minutes": None,
}


def test_every_fallen_row_of_the_committed_report_has_a_reason():
    rows = json.loads(fell.REPORT.read_text())["rows"]
    found = fallen(kept_values(), rows)
    assert [each.row_id for each in found if each.reason == NO_REASON] == []
    assert set(WHY_FELL) <= set(kept_values())


def test_no_row_blames_the_confidence_whose_forced_figure_fell_too():
    rows = json.loads(fell.REPORT.read_text())["rows"]
    then, found = kept_values(), fallen(kept_values(), rows)
    fallen_rows = {each.row_id for each in found}
    blaming = [each for each in fallen_rows if WHY_FELL[each].startswith(CONFIDENCE)]
    assert blaming
    forced = {f"{row.rsplit('.', 1)[0]}.forced_within_1_m" for row in blaming}
    assert forced & set(then)
    assert not forced & fallen_rows


def test_the_values_of_then_are_those_of_the_commit(monkeypatch, tmp_path, capsys):
    """The command reads them from Git. Without the commit it changes nothing."""
    monkeypatch.setattr(fell, "ROOT", tmp_path)
    monkeypatch.setattr(fell, "KEPT", tmp_path / "checks" / "kept.json")
    report = tmp_path / "accuracy.json"
    report.write_text(json.dumps({"rows": [share(0.5, [0.4, 0.6])]}))
    monkeypatch.setattr(fell, "REPORT", report)
    monkeypatch.setattr(fell, "git", lambda *_: None)
    assert fell.main([]) == 1
    assert not fell.KEPT.exists()
    asked = []
    old = json.dumps({"rows": [{"id": "a", "value": 0.9}, {"id": "b", "value": None}]})
    monkeypatch.setattr(fell, "git", lambda *arguments: asked.append(arguments) or old)
    monkeypatch.setattr(fell, "kept_values", lambda: kept_values(fell.KEPT))
    assert fell.main([]) == 0
    assert asked == [("show", f"{fell.BEFORE}:reports/accuracy.json")]
    assert json.loads(fell.KEPT.read_text()) == {"commit": fell.BEFORE, "rows": {"a": 0.9, "b": None}}
    assert "| `a` | 0.9 | 0.5 |" in capsys.readouterr().out
