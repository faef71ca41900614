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
        lines += _conditions({row["id"]: row["value"] for row in report["rows"]})
        whys = [f"- `{row['id']}`: {row['why']}" for row in report["rows"] if row.get("why")]
        lines += ["", *whys, ""] if whys else [""]
        picture = _plot(path.stem, report["rows"])
        if picture is not None:
            lines += [f"![{path.stem}]({picture.name})", ""]
        if "reliability" in report.get("notes", {}):
            lines += [f"![reliability]({_reliability(path.stem, report['notes']['reliability']).name})", ""]
        if "accepts" in report.get("notes", {}):
            picture = _accepts(path.stem, report["notes"]["accepts"])
            lines += [f"![false accepts against true accepts, for each kind of stranger]({picture.name})", ""]
    (REPORTS / "README.md").write_text("\n".join(lines))


def explain(rows: list[dict[str, Any]]) -> bool:
    """Give missed rows what is known now of why they miss; values stay. Whether anything changed."""
    changed = False
    for row in rows:
        why = WHY_MISSED.get(row["id"])
        if why is not None and not row.get("holds", True) and row.get("why") != why:
            row["why"], changed = why, True
    return changed


def _conditions(values: dict[str, float | None]) -> list[str]:
    """Hard conditions as a table, the clear day's figure beside each, and which stage loses most of what is lost."""
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


def _accepts(name: str, curves: dict[str, list[list[float]]]) -> Path:
    """What accepting more costs: strangers of each kind that are accepted, against queries accepted and right."""
    presets = sorted({kind.rpartition(".")[2] for kind in curves})
    figure, panels = plt.subplots(1, len(presets), figsize=(4.6 * len(presets), 3.8), sharey=True, squeeze=False)
    for axes, preset in zip(panels[0], presets, strict=True):
        for number, (kind, points) in enumerate(
            (kind, points) for kind, points in curves.items() if kind.endswith(f".{preset}")
        ):
            label = kind.removesuffix(f".{preset}").replace("_", " ")
            axes.plot([p[0] for p in points], [p[1] for p in points], label=label, color=f"C{number}")
        axes.set(xlim=(0, 1), ylim=(0.5, 1.01), title=preset, xlabel="strangers accepted")
        axes.set_xscale("symlog", linthresh=0.01)
        axes.set_xticks([0, 0.01, 0.1, 1], ["0", "1 %", "10 %", "all"])
        axes.grid(alpha=0.3)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    panels[0][0].set_ylabel("accepted and within 1 m")
    panels[0][0].legend(frameon=False, fontsize=8, loc="lower right")
    figure.tight_layout()
    path = REPORTS / f"{name}_accepts.png"
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path


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
