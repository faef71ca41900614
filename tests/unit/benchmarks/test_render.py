import pytest

pytest.importorskip("matplotlib")

from benchmarks import render
from benchmarks.kitti.published import NOTE

RUN = {
    "commit": "c" * 40,
    "dirty": False,
    "date": "2026-01-01T00:00:00+00:00",
    "machine": "one core",
    "command": "make it",
    "minutes": 2.5,
}


def test_conditions_stand_beside_the_clear_day_with_the_stage_that_loses_most():
    head = "full.condition."
    values: dict[str, float | None] = {
        f"{head}clear.within_1_m": 0.98,
        f"{head}clear.recall_at_10_5m": 1.0,
        f"{head}night.within_1_m": 0.90,
        f"{head}night.recall_at_10_5m": 0.99,
        f"{head}night.forced_within_1_m": 0.92,
        f"{head}fog.within_1_m": 0.80,
        f"{head}fog.recall_at_10_5m": 0.85,
        f"{head}fog.forced_within_1_m": 0.82,
        f"{head}night.recall_at_1_5m": 0.95,
        "raw.condition.night.recall_at_1_5m": 0.5,
        f"{head}five.within_1_m": 0.99,
        "full.unseen.precise.within_1_m": 0.5,
    }
    lines = render._conditions(values)
    assert lines[3:] == [
        "| night | 0.900 | 0.980 | -0.080 | choice and registration (7.0 points) | 0.950 | 0.500 |",
        "| fog | 0.800 | 0.980 | -0.180 | retrieval (15.0 points) |  |  |",
        "| five | 0.990 | 0.980 | +0.010 |  |  |  |",
    ]
    assert render._conditions({"full.unseen.precise.within_1_m": 0.5}) == []


def test_each_kind_of_out_of_map_query_has_a_curve(tmp_path, monkeypatch):
    monkeypatch.setattr(render, "REPORTS", tmp_path)
    points = [[0.0, 0.5], [0.01, 0.8], [0.2, 0.9]]
    picture = render._accepts("any", {"sky.precise": points, "sky.stereo": points, "noise.stereo": points})
    assert picture == tmp_path / "any_accepts.png"
    assert picture.read_bytes().startswith(b"\x89PNG")


def section(*rows, runs=None):
    told = {
        "stale_as_of": "f" * 40,
        "runs": runs or {"r": RUN},
        "rows": [{"run": "r", "unit": "m", "value": 1.0} | row for row in rows],
    }
    return render._section("mine", told)


def test_every_run_is_listed_with_its_machine_and_its_rows_and_every_row_names_its_run():
    kept = RUN | {
        "commit": "d" * 40,
        "date": None,
        "before": "2025-12-31T00:00:00+00:00",
        "machine": None,
        "dirty": True,
        "minutes": None,
    }
    lines = section({"id": "a.x"}, {"id": "a.y"}, {"id": "b.x", "run": "s"}, runs={"r": RUN, "s": kept})
    assert "| 1 | a 2 | `make it` | 2026-01-01 | `cccccccccc` | one core | 2.5 |" in lines
    assert (
        "| 2 | b 1 | `make it` | before 2025-12-31 | `dddddddddd`, with changes that were not committed | not kept |  |"
        in lines
    )
    assert [line.split("|")[-3].strip() for line in lines if line.startswith(("| `a", "| `b"))] == ["1", "1", "2"]


def test_stale_rows_are_marked_and_counted():
    lines = section(
        {"id": "a", "stale": True}, {"id": "b", "stale": "unknown"}, {"id": "c"}, {"id": "d", "stale": "same answers"}
    )
    marks = {line.split("|")[1].strip(): line.split("|")[-2].strip() for line in lines if line.startswith("| `")}
    assert marks == {"`a`": "**stale**", "`b`": "age unknown", "`c`": "", "`d`": "same answers"}
    assert any(line.startswith("1 rows have the same answers") for line in lines)
    assert "Of 4 rows 1 are stale and 1 of unknown age, as of commit `ffffffffff`." in lines


def test_a_reason_for_another_value_is_not_shown():
    missed = {"bar": 2.0, "better": "higher", "holds": False}
    lines = section(
        {"id": "a", **missed, "why": "of 3 minutes", "reason": {"explains": 1.0, "text": "a wall"}},
        {"id": "b", **missed, "reason": {"explains": 1.5, "outdated": True}},
    )
    assert "- `a`: of 3 minutes. a wall" in lines
    assert "- `b`: Reason outdated, value changed (it explained 1.5)" in lines


def test_published_figures_stand_beside_ours_and_missing_recordings_are_listed():
    report = {
        "stale_as_of": "f" * 40,
        "runs": {"r": RUN},
        "rows": [
            {"id": "kitti.published.02.recall_at_1_10m", "run": "r", "unit": "share", "value": 0.915},
            {"id": "kitti.published.2011_drive.recall_at_1_10m", "run": "r", "unit": "share", "value": 0.5},
            {"id": "kitti.published.05.recall_at_1_10m", "run": "r", "unit": "share", "value": None},
            {"id": "kitti.loops.06.recall_at_1_10m", "run": "r", "unit": "share", "value": 0.25},
        ],
        "notes": {
            NOTE: {"weak": [1, 2, 3, 4, 5, 6], "strong": [91, 92, 93, 94, 95, 96.5]},
            "missing": ["odometry sequence 00", "raw drive"],
            "left_out": ["2011_drive: why"],
        },
    }
    lines = render._section("kitti", report)
    start = lines.index("| recording | ours | strong | weak |")
    assert lines[start + 2 : start + 10] == [
        "| 00 | not measured | 91 | 1 |",
        "| 02 | 92 | 92 | 2 |",
        "| 05 | not measured | 93 | 3 |",
        "| 06 | not measured | 94 | 4 |",
        "| 07 | not measured | 95 | 5 |",
        "| 08 | not measured | 96.5 | 6 |",
        "| 2011_drive | 50 |  |  |",
        "",
    ]
    assert any("arXiv 2502.11742" in line for line in lines[:start])
    missing = lines.index("The machine of the last run lacks these recordings:")
    assert lines[missing + 2 : missing + 4] == ["- odometry sequence 00", "- raw drive"]
    left_out = lines.index("The last run left these recordings out:")
    assert lines[left_out + 2] == "- 2011_drive: why"


def test_a_report_without_these_notes_has_neither():
    text = "\n".join(section({"id": "a"}))
    assert "recording" not in text


def test_notes_of_earlier_runs_are_shown_in_present_terms():
    report = {"runs": {}, "rows": [], "notes": {"trainings": "the watch city's 3196 places"}}
    assert "the validation city's 3196 places\n" in render._section("choices", report)
