"""``make reports``: write a Markdown page and plots of every ``reports/*.json``, and update figures in documents."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import matplotlib

from benchmarks import decisions, fell
from benchmarks.figures import write_figures
from benchmarks.kitti.published import NOTE as PUBLISHED_NOTE
from benchmarks.kitti.published import published_lines
from benchmarks.report import REPORTS, ROOT, write_report

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

#: Introduction of the page.
HEAD = """# Reports

`make reports` writes this page from the JSON files beside it. The figures in the tables come from runs; the column *run* names the run
that measured the row. People write the reasons below a table (`benchmarks/why_missed.py`). Each reason explains one value. If the value
has changed since, the page says so instead of the reason.

**Stale** means that code that the row measures has changed since the row's commit. Changes of comments, docstrings and layout do not count.
*Same answers* means that code changed, but `make same-answers` compared both versions: maps and answers were equal to the bit.
`checks/same_answers.json` names the datasets. *Age unknown* means that Git could not tell.
"""

#: Terms in the notes of earlier runs, and the terms of the glossary that replaced them.
_TERMS = {"watch city": "validation city"}


def main() -> None:
    """Update figures in documents; write ``reports/README.md``, ``reports/NAME.png`` and the index of decisions."""
    lines = [HEAD]
    for path in sorted(REPORTS.glob("*.json")):
        write_report(path, json.loads(path.read_text()))
        lines += _section(path.stem, json.loads(path.read_text()))
    (REPORTS / "README.md").write_text("\n".join(lines))
    decisions.write_index()
    for page in write_figures():
        print(f"figures updated: {page.relative_to(ROOT)}")


def _section(name: str, report: dict[str, Any]) -> list[str]:
    """Return one report: its runs, rows, reasons and images, and the rows of the accuracy report that fell."""
    rows, notes = report["rows"], report.get("notes", {})
    numbers = {key: number for number, key in enumerate(report["runs"], 1)}
    stale, same, unknown = (
        sum(row.get("stale") == state for row in rows) for state in (True, "same answers", "unknown")
    )
    lines = [
        f"## {name}",
        "",
        "| run | rows | command | date | commit | machine | minutes |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        _run_line(number, report["runs"][key], [row for row in rows if row["run"] == key])
        for key, number in numbers.items()
    ]
    lines += [""]
    if stale or same or unknown:
        as_of = f"commit `{report['stale_as_of'][:10]}`" if report["stale_as_of"] else "no commit: there is no Git"
        lines += [f"Of {len(rows)} rows {stale} are stale and {unknown} of unknown age, as of {as_of}.", ""]
    if same:
        lines += [
            f"{same} rows have the same answers although code changed. `make same-answers` compared both versions.",
            "",
        ]
    lines += [f"{_in_present_terms(text)}\n" for text in notes.values() if isinstance(text, str)]
    lines += ["| row | value | 95 % interval | n | bar | | run | |", "|---|---|---|---|---|---|---|---|"]
    lines += [_line(row, numbers[row["run"]]) for row in rows]
    lines += _conditions({row["id"]: row["value"] for row in rows})
    if PUBLISHED_NOTE in notes:
        lines += ["", *published_lines({row["id"]: row["value"] for row in rows}, notes[PUBLISHED_NOTE])]
    if notes.get("missing"):
        lines += [
            "",
            "The machine of the last run lacks these recordings:",
            "",
            *(f"- {each}" for each in notes["missing"]),
        ]
    if notes.get("left_out"):
        lines += ["", "The last run left these recordings out:", "", *(f"- {each}" for each in notes["left_out"])]
    remarks = [f"- `{row['id']}`: {text}" for row in rows for text in _remarks(row)]
    lines += ["", *remarks, ""] if remarks else [""]
    picture = _plot(name, rows)
    if picture is not None:
        lines += [f"![{name}]({picture.name})", ""]
    if "reliability" in notes:
        lines += [f"![reliability]({_reliability(name, notes['reliability']).name})", ""]
    if "accepts" in notes:
        picture = _accepts(name, notes["accepts"])
        lines += [f"![false accepts against true accepts, for each kind of out-of-map query]({picture.name})", ""]
    if name == fell.REPORT.stem:
        lines += fell.lines(fell.fallen(fell.kept_values(), rows))
    return lines


def _in_present_terms(note: str) -> str:
    for old, new in _TERMS.items():
        note = note.replace(old, new)
    return note


def _run_line(number: int, run: dict[str, Any], rows: list[dict[str, Any]]) -> str:
    groups = ", ".join(
        f"{group} {count}" for group, count in sorted(Counter(row["id"].split(".")[0] for row in rows).items())
    )
    date = run["date"][:10] if run["date"] else f"before {run['before'][:10]}" if "before" in run else "not kept"
    dirty = {True: ", with changes that were not committed", False: "", None: ", not kept whether with other changes"}[
        run["dirty"]
    ]
    command = "not kept" if run["command"] is None else f"`{run['command']}`"
    minutes = "" if run["minutes"] is None else f"{run['minutes']:g}"
    return f"| {number} | {groups} | {command} | {date} | `{run['commit'][:10]}`{dirty} | {run['machine'] or 'not kept'} | {minutes} |"


def _remarks(row: dict[str, Any]) -> list[str]:
    """Return the run's remark on a row, and the reason for a missed bar if it was written for this value."""
    told = [row["why"]] if "why" in row else []
    reason = row.get("reason")
    if reason is not None and reason.get("outdated"):
        explained = "no value" if reason["explains"] is None else f"{reason['explains']:.5g}"
        told.append(f"Reason outdated, value changed (it explained {explained})")
    elif reason is not None:
        told.append(reason["text"])
    return [". ".join(each.rstrip(".") for each in told)] if told else []


def _conditions(values: dict[str, float | None]) -> list[str]:
    """Return a table of hard conditions: each figure beside the clear day's, and the stage with the largest loss."""
    head, tail = "full.condition.", ".within_1_m"
    clear = values.get(f"{head}clear{tail}")
    names = [row.removeprefix(head).removesuffix(tail) for row in values if row.startswith(head) and row.endswith(tail)]
    names = [name for name in names if not name.endswith(".forced") and name != "clear"]
    if clear is None or not names:
        return []
    lines = [
        "",
        "| condition | within 1 m | clear day | difference | most is lost by | R@1 at 5 m | of the raw range image |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in names:
        right, found, forced = (
            values.get(f"{head}{name}.{figure}") for figure in ("within_1_m", "recall_at_10_5m", "forced_within_1_m")
        )
        if right is None:
            continue
        lost = {}
        if found is not None and forced is not None:
            lost = {"retrieval": 1 - found, "choice and registration": found - forced, "doubt": forced - right}
        most = max(lost, key=lambda stage: lost[stage]) if lost else ""
        told = f"{most} ({100 * lost[most]:.1f} points)" if most else ""
        first = _told(values.get(f"{head}{name}.recall_at_1_5m"))
        raw = _told(values.get(f"raw.condition.{name}.recall_at_1_5m"))
        lines.append(
            f"| {name.replace('_', ' ')} | {right:.3f} | {clear:.3f} | {right - clear:+.3f} | {told} | {first} | {raw} |"
        )
    return lines


def _told(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def _reliability(name: str, points: list[dict[str, float]]) -> Path:
    """Draw the share of correct answers over confidence; a calibrated confidence lies on the diagonal."""
    figure, axes = plt.subplots(figsize=(4.5, 4.5))
    axes.plot([0, 1], [0, 1], color="#5b6b7b", lw=1, ls="--")
    axes.plot([p["confidence"] for p in points], [p["right"] for p in points], "o", color="#2a7f62", ms=5)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02), aspect="equal", xlabel="confidence", ylabel="share within 1 m")
    axes.grid(alpha=0.3)
    return _saved(figure, f"{name}_reliability.png")


def _saved(figure: Figure, name: str, *, dpi: int = 110) -> Path:
    """Hide the upper and the right border of all panels, write the figure to the reports, and return its file."""
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    path = REPORTS / name
    figure.savefig(path, dpi=dpi)
    plt.close(figure)
    return path


def _line(row: dict[str, Any], run: int) -> str:
    value = "-" if row["value"] is None else f"{row['value']:.4g} {row['unit']}"
    interval = "{:.4f} - {:.4f}".format(*row["ci95"]) if "ci95" in row else ""
    bar = _bar(row) if "bar" in row else ""
    mark = "" if "bar" not in row else ("holds" if row["holds"] else "**missed**")
    age = {True: "**stale**", "same answers": "same answers", "unknown": "age unknown", None: ""}[row.get("stale")]
    return f"| `{row['id']}` | {value} | {interval} | {row.get('n', '')} | {bar} | {mark} | {run} | {age} |"


def _bar(row: dict[str, Any]) -> str:
    if isinstance(row["bar"], list):
        return "{:g} to {:g}".format(*row["bar"])
    return f"{'at least' if row['better'] == 'higher' else 'at most'} {row['bar']:g}"


def _accepts(name: str, curves: dict[str, list[list[float]]]) -> Path:
    """Draw out-of-map queries accepted against queries accepted and correct, by kind."""
    presets = sorted({kind.rpartition(".")[2] for kind in curves})
    figure, panels = plt.subplots(1, len(presets), figsize=(4.6 * len(presets), 3.8), sharey=True, squeeze=False)
    for axes, preset in zip(panels[0], presets, strict=True):
        for number, (kind, points) in enumerate(
            (kind, points) for kind, points in curves.items() if kind.endswith(f".{preset}")
        ):
            label = kind.removesuffix(f".{preset}").replace("_", " ")
            axes.plot([p[0] for p in points], [p[1] for p in points], label=label, color=f"C{number}")
        axes.set(xlim=(0, 1), ylim=(0.5, 1.01), title=preset, xlabel="out-of-map queries accepted")
        axes.set_xscale("symlog", linthresh=0.01)
        axes.set_xticks([0, 0.01, 0.1, 1], ["0", "1 %", "10 %", "all"])
        axes.grid(alpha=0.3)
    panels[0][0].set_ylabel("accepted and within 1 m")
    panels[0][0].legend(frameon=False, fontsize=8, loc="lower right")
    return _saved(figure, f"{name}_accepts.png", dpi=120)


def _plot(name: str, rows: list[dict[str, Any]]) -> Path | None:
    """Draw the shares that have a bar, with their intervals; return None without any."""
    shares = [row for row in rows if row["unit"] == "share" and row["value"] is not None and "bar" in row]
    if not shares:
        return None
    figure, axes = plt.subplots(figsize=(9, 0.32 * len(shares) + 1))
    for k, row in enumerate(reversed(shares)):
        low, high = row.get("ci95", [row["value"]] * 2)
        colour = {True: "#2a7f62", False: "#c0392b"}[row["holds"]]
        axes.plot([low, high], [k, k], color=colour, lw=2, alpha=0.5)
        axes.plot(row["value"], k, "o", color=colour, ms=5)
        for bar in row["bar"] if isinstance(row["bar"], list) else [row["bar"]]:
            axes.plot(bar, k, "|", color="black", ms=12, mew=1.5)
    axes.set_yticks(range(len(shares)), [row["id"] for row in reversed(shares)], fontsize=7)
    axes.set_xlim(0, 1.005)
    axes.grid(axis="x", alpha=0.3)
    axes.set_xlabel("share; black mark: the bar")
    return _saved(figure, f"{name}.png")


if __name__ == "__main__":
    main()
