"""``make reports``: every ``reports/*.json`` as one Markdown page with a plot each."""

import json
from pathlib import Path
from typing import Any

import matplotlib

from benchmarks.report import REPORTS
from benchmarks.why_missed import WHY_MISSED

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def main() -> None:
    """Write ``reports/README.md`` and ``reports/NAME.png``."""
    lines = [
        "# Reports",
        "",
        "Made by `make reports` from the JSON files beside this page; none of it is typed by hand.",
        "",
    ]
    for path in sorted(REPORTS.glob("*.json")):
        report = json.loads(path.read_text())
        if explain(report["rows"]):
            path.write_text(json.dumps(report, indent=1) + "\n")
        made = report["made"]
        lines += [
            f"## {path.stem}", "",
            f"`{made['command']}` on {made['date'][:10]} at commit `{made['commit'][:10]}`,",
            f"{made['minutes']:g} minutes, {made['machine']}.", "",
            *_other_commits(report["rows"]),
            *(f"{text}\n" for text in report.get("notes", {}).values() if isinstance(text, str)),
            "| row | value | 95 % interval | n | bar | |", "|---|---|---|---|---|---|",
        ]  # fmt: skip
        lines += [_line(row) for row in report["rows"]]
        whys = [f"- `{row['id']}`: {row['why']}" for row in report["rows"] if row.get("why")]
        lines += ["", *whys, ""] if whys else [""]
        picture = _plot(path.stem, report["rows"])
        if picture is not None:
            lines += [f"![{path.stem}]({picture.name})", ""]
        if "reliability" in report.get("notes", {}):
            lines += [f"![reliability]({_reliability(path.stem, report['notes']['reliability']).name})", ""]
    (REPORTS / "README.md").write_text("\n".join(lines))


def explain(rows: list[dict[str, Any]]) -> bool:
    """Give missed rows what is known now of why they miss; values stay. Whether anything changed."""
    changed = False
    for row in rows:
        why = WHY_MISSED.get(row["id"])
        if why is not None and not row.get("holds", True) and row.get("why") != why:
            row["why"], changed = why, True
    return changed


def _other_commits(rows: list[dict[str, Any]]) -> list[str]:
    """Which rows an earlier run measured, where a run made parts of the report alone."""
    found: dict[str, list[str]] = {}
    for row in rows:
        if "commit" in row:
            part = row["id"].split(".")[0]
            found.setdefault(row["commit"][:10], []).append(part)
    return [f"Measured at commit `{commit}`: {', '.join(sorted(set(parts)))}.\n" for commit, parts in found.items()]


def _reliability(name: str, points: list[dict[str, float]]) -> Path:
    """How often answers of a confidence are right; on the line it is what it says."""
    figure, axes = plt.subplots(figsize=(4.5, 4.5))
    axes.plot([0, 1], [0, 1], color="#5b6b7b", lw=1, ls="--")
    axes.plot([p["confidence"] for p in points], [p["right"] for p in points], "o", color="#2a7f62", ms=5)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02), aspect="equal", xlabel="confidence", ylabel="share within 1 m")
    axes.grid(alpha=0.3)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.tight_layout()
    path = REPORTS / f"{name}_reliability.png"
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def _line(row: dict[str, Any]) -> str:
    value = "-" if row["value"] is None else f"{row['value']:.4g} {row['unit']}"
    interval = "{:.4f} - {:.4f}".format(*row["ci95"]) if "ci95" in row else ""
    bar = _bar(row) if "bar" in row else ""
    mark = "" if "bar" not in row else ("holds" if row["holds"] else "**missed**")
    return f"| `{row['id']}` | {value} | {interval} | {row.get('n', '')} | {bar} | {mark} |"


def _bar(row: dict[str, Any]) -> str:
    if isinstance(row["bar"], list):
        return "{:g} to {:g}".format(*row["bar"])
    return f"{'at least' if row['better'] == 'higher' else 'at most'} {row['bar']:g}"


def _plot(name: str, rows: list[dict[str, Any]]) -> Path | None:
    """Shares that have a bar, with their intervals; reports without such get no picture."""
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
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.tight_layout()
    path = REPORTS / f"{name}.png"
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


if __name__ == "__main__":
    main()
