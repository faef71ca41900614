import json

import numpy as np
import pytest

from benchmarks import render
from benchmarks import report as module
from benchmarks.report import Report


@pytest.fixture
def report(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "REPORTS", tmp_path / "reports")
    return Report("mine", "make mine")


def row_of(report, row_id):
    return next(row for row in report.rows if row["id"] == row_id)


def test_a_share_is_told_with_its_number_and_wilsons_interval(report):
    """Eight of ten: 0.4902 to 0.9433, as in the textbooks."""
    report.share("a", np.arange(10) < 8, bar=0.75)
    row = row_of(report, "a")
    assert (row["value"], row["n"], row["unit"], row["holds"], row["better"]) == (0.8, 10, "share", True, "higher")
    assert row["ci95"] == pytest.approx([0.4902, 0.9433], abs=1e-4)


@pytest.mark.parametrize(
    ("right", "bar", "better", "holds"),
    [(8, 0.8, "higher", True), (8, 0.81, "higher", False), (8, 0.8, "lower", True), (8, 0.79, "lower", False)],
)
def test_a_shares_bar_holds_where_it_is_met(report, right, bar, better, holds):
    report.share("a", np.arange(10) < right, bar=bar, better=better)
    assert row_of(report, "a")["holds"] is holds


def test_a_share_of_no_query_is_none_and_its_bar_is_missed(report):
    report.share("a", np.zeros(0, bool), bar=0.5)
    row = row_of(report, "a")
    assert (row["value"], row["holds"], row["why"]) == (None, False, "no query of this kind")
    assert "ci95" not in row


def test_a_share_without_a_bar_neither_holds_nor_misses(report, capsys):
    report.share("a", np.ones(3, bool))
    assert not {"bar", "holds", "better"} & set(row_of(report, "a"))
    assert "holds" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("value", "holds"),
    [(0.9, True), (0.98, True), (0.95, True), (0.899, False), (0.981, False), (1.0, False), (None, False)],
)
def test_a_bar_of_two_numbers_is_a_range_with_its_ends(report, value, holds, capsys):
    report.row("a", value, "share", bar=(0.9, 0.98))
    row = row_of(report, "a")
    assert (row["bar"], row["better"], row["holds"]) == ([0.9, 0.98], "inside", holds)
    assert ("  holds" if holds else "  MISSED") in capsys.readouterr().out
    json.dumps(row)


def test_a_range_is_rendered_as_one(report):
    report.row("a", 0.95, "share", bar=(0.9, 0.98))
    report.row("b", 0.97, "share", bar=0.98, better="lower")
    lines = [render._line(row) for row in report.rows]
    assert lines[0].endswith("| 0.9 to 0.98 | holds |")
    assert lines[1].endswith("| at most 0.98 | holds |")


def test_a_row_of_the_same_name_replaces_the_last(report):
    report.row("a", 1.0, "m")
    report.row("b", 2.0, "m")
    report.row("a", 3.0, "m")
    assert [(row["id"], row["value"]) for row in report.rows] == [("b", 2.0), ("a", 3.0)]


def written(name="mine"):
    return json.loads((module.REPORTS / f"{name}.json").read_text())


def test_the_rows_of_the_last_run_are_kept_with_the_commit_that_they_were_measured_at(report, monkeypatch):
    report._commit = "first"
    report.row("old", 1.0, "m")
    report.row("both", 1.0, "m")
    report.notes["run"] = "slow machine"
    report.write()
    later = Report("mine", "make mine", _commit="second")
    later.keep_others()
    later.row("both", 2.0, "m")
    later.row("new", 3.0, "m")
    later.write()
    rows = {row["id"]: (row.get("commit"), row["value"]) for row in written()["rows"]}
    assert rows == {"old": ("first", 1.0), "both": (None, 2.0), "new": (None, 3.0)}
    assert (written()["made"]["commit"], written()["notes"]) == ("second", {"run": "slow machine"})
    third = Report("mine", "make mine", _commit="third")
    third.keep_others()
    third.write()
    assert {row["id"]: row["commit"] for row in written()["rows"]} == {
        "old": "first",
        "both": "second",
        "new": "second",
    }


def test_without_a_last_run_there_is_nothing_to_keep(report):
    report.keep_others()
    assert (report.rows, report.notes) == ([], {})


def test_without_keeping_them_the_rows_of_the_last_run_are_gone(report):
    report.row("old", 1.0, "m")
    report.write()
    Report("mine", "make mine").write()
    assert written()["rows"] == []


def test_parts_that_are_measured_at_once_keep_each_others_rows(report):
    """The second one began before the first one wrote, and ends after it."""
    report.row("old", 1.0, "m")
    report.write()
    first, second = Report("mine", "make mine --only a"), Report("mine", "make mine --only b")
    for part, row_id in ((first, "a"), (second, "b")):
        part.keep_others()
        part.row(row_id, 2.0, "m")
    first.row("old", 3.0, "m")
    first.write()
    path = second.write()
    rows = {row["id"]: row for row in json.loads(path.read_text())["rows"]}
    assert {row_id: row["value"] for row_id, row in rows.items()} == {"old": 3.0, "a": 2.0, "b": 2.0}
    assert "commit" in rows["a"]
    assert "commit" not in rows["b"]


def test_a_note_that_no_longer_speaks_of_the_rows_is_dropped(report):
    report.notes |= {"run": "of another encoder", "map": "a city"}
    report.row("a", 1.0, "m")
    report.write()
    again = Report("mine", "make mine")
    again.keep_others()
    again.notes["run"] = None
    assert json.loads(again.write().read_text())["notes"] == {"map": "a city"}
