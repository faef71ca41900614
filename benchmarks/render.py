"""``make reports``: every ``reports/*.json`` as one Markdown page with a plot each."""

import json
from pathlib import Path
from typing import Any

import matplotlib

from benchmarks.report import REPORTS

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
        made = report["made"]
        lines += [
            f"## {path.stem}", "",
            f"`{made['command']}` on {made['date'][:10]} at commit `{made['commit'][:10]}`,",
            f"{made['minutes']:g} minutes, {made['machine']}.", "",
            *(f"{text}\n" for text in report.get("notes", {}).values()),
            "| row | value | 95 % interval | n | bar | |", "|---|---|---|---|---|---|",
        ]  # fmt: skip
        lines += [_line(row) for row in report["rows"]]
        whys = [f"- `{row['id']}`: {row['why']}" for row in report["rows"] if row.get("why")]
        lines += ["", *whys, ""] if whys else [""]
        picture = _plot(path.stem, report["rows"])
        if picture is not None:
            lines += [f"![{path.stem}]({picture.name})", ""]
    (REPORTS / "README.md").write_text("\n".join(lines))


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
    """Shares with their intervals and bars; reports without shares get no picture."""
    shares = [row for row in rows if row["unit"] == "share" and row["value"] is not None]
    if not shares:
        return None
    figure, axes = plt.subplots(figsize=(9, 0.32 * len(shares) + 1))
    for k, row in enumerate(reversed(shares)):
        low, high = row.get("ci95", [row["value"]] * 2)
        colour = {True: "#2a7f62", False: "#c0392b"}.get(row.get("holds"), "#5b6b7b")  # type: ignore[arg-type]  # None: no bar
        axes.plot([low, high], [k, k], color=colour, lw=2, alpha=0.5)
        axes.plot(row["value"], k, "o", color=colour, ms=5)
        if "bar" in row:
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
