import json

import numpy as np
import pytest

from benchmarks import render
from benchmarks import report as module
from benchmarks.provenance import Run
from benchmarks.report import Report
from benchmarks.why_missed import WHY_MISSED, Reason


@pytest.fixture
def report(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "REPORTS", tmp_path / "reports")
    return Report("mine", "make mine")


def row_of(report, row_id):
    return next(row for row in report.rows if row["id"] == row_id)


def test_a_share_has_its_count_and_wilson_interval(report):
    """Eight of ten: 0.4902 to 0.9433, as in the textbooks."""
    report.share("a", np.arange(10) < 8, bar=0.75)
    row = row_of(report, "a")
    assert (row["value"], row["n"], row["unit"], row["holds"], row["better"]) == (0.8, 10, "share", True, "higher")
    assert row["ci95"] == pytest.approx([0.4902, 0.9433], abs=1e-4)


def test_a_row_that_cannot_be_measured_keeps_the_value_of_an_earlier_run(report):
    report.row("known", 0.5, "share")
    report.write()
    again = Report("mine", "make mine again", folder=report.folder)
    again.keep_others()
    again.absent("known", "share", "no such package")
    again.absent("new", "share", "no such package")
    rows = {row["id"]: row for row in json.loads(again.write().read_text())["rows"]}
    assert rows["known"]["value"] == 0.5
    assert (rows["new"]["value"], rows["new"]["why"]) == (None, "no such package")


@pytest.mark.parametrize(
    ("right", "bar", "better", "holds"),
    [(8, 0.8, "higher", True), (8, 0.81, "higher", False), (8, 0.8, "lower", True), (8, 0.79, "lower", False)],
)
def test_the_bar_of_a_share_holds_at_equality(report, right, bar, better, holds):
    report.share("a", np.arange(10) < right, bar=bar, better=better)
    assert row_of(report, "a")["holds"] is holds


def test_a_share_of_no_query_is_none_and_its_bar_is_missed(report):
    report.share("a", np.zeros(0, bool), bar=0.5)
    row = row_of(report, "a")
    assert (row["value"], row["holds"], row["why"]) == (None, False, "no query of this type")
    assert "ci95" not in row


def test_a_bar_does_not_hold_for_a_figure_of_nothing(report):
    """Rows of rigs without a LOCALIZED answer once said that no LOCALIZED answer is wrong."""
    report.row("a", 0.0, "share", bar=0.01, better="lower", n=0)
    report.row("b", 0.0, "share", bar=0.01, better="lower", n=0, why="no LOCALIZED answer")
    assert [(row["value"], row["holds"], row["why"]) for row in report.rows] == [
        (None, False, "there is no sample"),
        (None, False, "no LOCALIZED answer"),
    ]
    report.row("minutes", 0.0, "min", n=0)
    assert row_of(report, "minutes")["value"] == 0.0


def test_a_figure_of_nothing_of_an_earlier_run_loses_its_value_too(report):
    kept = {"id": "a", "run": "r", "unit": "share", "value": 0.0, "n": 0, "bar": 0.9, "better": "lower", "holds": True}
    module.write_report(module.REPORTS / "mine.json", {"runs": {"r": {"commit": "c", "date": None}}, "rows": [kept]})
    (row,) = written()["rows"]
    assert (row["value"], row["holds"], row["why"]) == (None, False, "there is no sample")


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
    lines = [render._line(row, 3) for row in report.rows]
    assert lines[0].endswith("| 0.9 to 0.98 | holds | 3 |  |")
    assert lines[1].endswith("| at most 0.98 | holds | 3 |  |")


def test_a_row_of_the_same_name_replaces_the_last(report):
    report.row("a", 1.0, "m")
    report.row("b", 2.0, "m")
    report.row("a", 3.0, "m")
    assert [(row["id"], row["value"]) for row in report.rows] == [("b", 2.0), ("a", 3.0)]


def written(name="mine"):
    return json.loads((module.REPORTS / f"{name}.json").read_text())


def made(row_id, name="mine"):
    """Return the run that measured a row, as the file has it."""
    told = written(name)
    return told["runs"][next(row["run"] for row in told["rows"] if row["id"] == row_id)]


def on(monkeypatch, machine):
    monkeypatch.setattr(module, "machine", lambda: machine)


def test_the_rows_of_the_last_run_are_kept_with_all_that_is_known_of_that_run(report, monkeypatch):
    """Machine, date and command of the newest run were once assigned to rows that it had only kept."""
    on(monkeypatch, "slow")
    report._commit, report._dirty, report._date = "first", True, "2026-01-01T00:00:00+00:00"
    report.row("old", 1.0, "m")
    report.row("both", 1.0, "m")
    report.notes["run"] = "slow machine"
    report.write()
    before = made("old")
    on(monkeypatch, "fast")
    later = Report("mine", "make mine ARGS=--only", _commit="second", _dirty=False, _date="2026-01-02T00:00:00+00:00")
    later.keep_others()
    later.row("both", 2.0, "m")
    later.row("new", 3.0, "m")
    later.write()
    assert {row["id"]: row["value"] for row in written()["rows"]} == {"old": 1.0, "both": 2.0, "new": 3.0}
    assert made("old") == before
    assert {name: before[name] for name in ("commit", "dirty", "date", "machine", "command")} == {
        "commit": "first",
        "dirty": True,
        "date": "2026-01-01T00:00:00+00:00",
        "machine": "slow",
        "command": "make mine",
    }
    for row_id in ("both", "new"):
        assert (made(row_id)["commit"], made(row_id)["dirty"], made(row_id)["machine"]) == ("second", False, "fast")
        assert made(row_id)["command"] == "make mine ARGS=--only"
    assert written()["notes"] == {"run": "slow machine"}


def test_a_run_that_writes_after_every_part_is_one_run(report):
    report.keep_others()
    for row_id in ("a", "b"):
        report.row(row_id, 1.0, "m")
        report.write()
    assert len(written()["runs"]) == 1


def test_a_run_of_which_no_row_is_left_is_dropped(report):
    report._date = "2026-01-01T00:00:00+00:00"
    report.row("a", 1.0, "m")
    report.write()
    later = Report("mine", "make mine", _date="2026-01-02T00:00:00+00:00")
    later.keep_others()
    later.row("a", 2.0, "m")
    later.write()
    assert [run["date"] for run in written()["runs"].values()] == ["2026-01-02T00:00:00+00:00"]


def test_two_runs_of_one_second_and_commit_stay_apart(report):
    parts = [
        Report("mine", f"make mine --only {part}", _commit="c", _date="2026-01-01T00:00:00+00:00") for part in "ab"
    ]
    for part, row_id in zip(parts, "ab", strict=True):
        part.keep_others()
        part.row(row_id, 1.0, "m")
        part.write()
    assert (made("a")["command"], made("b")["command"]) == ("make mine --only a", "make mine --only b")


def test_rows_of_kept_results_name_the_run_that_gave_them(report, monkeypatch):
    on(monkeypatch, "here")
    there = Run(commit="theirs", before="2026-01-01T00:00:00+00:00", machine="there")
    with report.made_by(there):
        report.row("kept", 1.0, "m")
    report.row("own", 1.0, "m")
    report.write()
    assert (made("kept")["commit"], made("kept")["machine"], made("kept")["date"]) == ("theirs", "there", None)
    assert made("kept")["before"] == "2026-01-01T00:00:00+00:00"
    assert made("own")["machine"] == "here"


def test_without_a_last_run_there_is_nothing_to_keep(report):
    report.keep_others()
    assert (report.rows, report.notes) == ([], {})


def test_without_keep_others_the_rows_of_the_last_run_are_removed(report):
    report.row("old", 1.0, "m")
    report.write()
    Report("mine", "make mine").write()
    assert written()["rows"] == []


def test_parts_that_are_measured_at_once_keep_each_others_rows(report):
    """The second part begins before the first one writes, and ends after it."""
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
    assert (made("a")["command"], made("b")["command"]) == ("make mine --only a", "make mine --only b")


def test_a_note_that_no_longer_speaks_of_the_rows_is_dropped(report):
    report.notes |= {"run": "of another encoder", "map": "a city"}
    report.row("a", 1.0, "m")
    report.write()
    again = Report("mine", "make mine")
    again.keep_others()
    again.notes["run"] = None
    assert json.loads(again.write().read_text())["notes"] == {"map": "a city"}


def test_a_reason_stands_by_the_value_that_it_explains_and_by_no_other(report, monkeypatch):
    monkeypatch.setitem(WHY_MISSED, "a", Reason(0.94026, "look-alike streets"))
    report.row("a", 0.9402555910543131, "share", bar=0.99)
    report.write()
    assert written()["rows"][0]["reason"] == {"explains": 0.94026, "text": "look-alike streets"}
    report.row("a", 0.94185, "share", bar=0.99)
    report.write()
    assert written()["rows"][0]["reason"] == {"explains": 0.94026, "outdated": True}
    report.row("a", 0.995, "share", bar=0.99)
    report.write()
    assert "reason" not in written()["rows"][0]


def test_the_reason_of_a_kept_row_is_looked_up_at_every_write(report, monkeypatch):
    report.row("a", 0.5, "share", bar=0.99, why="of 3 minutes only")
    report.write()
    monkeypatch.setitem(WHY_MISSED, "a", Reason(0.5, "found out later"))
    later = Report("mine", "make mine")
    later.keep_others()
    later.write()
    row = written()["rows"][0]
    assert (row["reason"]["text"], row["why"]) == ("found out later", "of 3 minutes only")


def test_one_query_of_three_thousand_makes_another_value():
    reason = Reason(round(2950 / 3130, 6), "")
    assert reason.fits(2950 / 3130)
    assert not reason.fits(2951 / 3130)
    assert Reason(None, "").fits(None)
    assert not Reason(None, "").fits(0.5)
    assert not Reason(0.5, "").fits(None)


def test_every_typed_reason_names_the_value_that_it_explains():
    for row_id, reason in WHY_MISSED.items():
        assert isinstance(reason, Reason), row_id
        assert reason.text, row_id
