"""``reports/NAME.json``: rows with bars, and the run that they were made by."""

import json
import os
import platform
import subprocess
import sys
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.why_missed import WHY_MISSED
from model_training.evaluation.error_measures import wilson_interval

ROOT = Path(__file__).resolve().parents[1]
REPORTS = ROOT / "reports"


@dataclass
class Report:
    """Collects rows; ``write`` replaces the file in one go.

    Args:
        name: of the file.
        command: that makes it, for people who want to run it again.
        folder: where it lies.
    """

    name: str
    command: str
    rows: list[dict[str, Any]] = field(default_factory=list)
    notes: dict[str, Any] = field(default_factory=dict)
    folder: Path = field(default_factory=lambda: REPORTS)
    _keep: bool = False
    _began: float = field(default_factory=time.monotonic)
    # What is measured is the code as it was loaded, not as it is when the report is written.
    _commit: str = field(default_factory=lambda: _git("rev-parse", "HEAD"))
    _dirty: bool = field(
        default_factory=lambda: bool(_git("status", "--porcelain", "--", "service", "model_training", "benchmarks"))
    )

    def row(
        self, row_id: str, value: float | None, unit: str, *, bar: float | tuple[float, float] | None = None,
        better: Literal["higher", "lower"] = "higher", n: int | None = None, ci95: list[float] | None = None, why: str | None = None,
    ) -> None:  # fmt: skip
        """Add a row; ``holds`` follows from value and bar; a bar of two numbers is a range."""
        entry: dict[str, Any] = {"id": row_id, "value": value, "unit": unit}
        if n is not None:
            entry["n"] = n
        if ci95 is not None:
            entry["ci95"] = ci95
        if bar is not None:
            holds = value is not None and _holds(value, bar, better)
            shown_bar: object = list(bar) if isinstance(bar, tuple) else bar
            entry |= {"bar": shown_bar, "better": "inside" if isinstance(bar, tuple) else better, "holds": holds}
        told = [each for each in (why, None if entry.get("holds", True) else WHY_MISSED.get(row_id)) if each]
        if told:
            entry["why"] = "; ".join(told)
        self.rows = [r for r in self.rows if r["id"] != row_id] + [entry]
        mark = "" if bar is None else ("  holds" if entry["holds"] else "  MISSED")
        shown = "-" if value is None else f"{value:.4f}"
        print(f"{row_id:62} {shown:>10} {unit:8}{'' if bar is None else f' bar {bar}'}{mark}", flush=True)

    def share(
        self, row_id: str, right: NDArray[np.bool_], *, bar: float | None = None, better: Literal["higher", "lower"] = "higher"
    ) -> None:  # fmt: skip
        """Add a row of a share with its Wilson interval."""
        if not len(right):
            self.row(row_id, None, "share", bar=bar, better=better, why="no query of this kind")
            return
        interval = list(wilson_interval(int(right.sum()), len(right)))
        self.row(row_id, float(right.mean()), "share", bar=bar, better=better, n=len(right), ci95=interval)

    def keep_others(self) -> None:
        """Keep the rows of earlier runs, each with the commit that it was measured at; this run's replace them.

        What is kept is read when the report is written, so that two parts may be measured at once. Notes are kept as well; one
        that is None here is dropped.
        """
        self._keep = True

    def _with_others(self) -> tuple[list[dict[str, Any]], dict[str, Any]]:
        """Rows and notes of the file as it is now, this run's in their places."""
        path = self.folder / f"{self.name}.json"
        if not self._keep or not path.exists():
            return self.rows, self.notes
        last = json.loads(path.read_text())
        rows = {row["id"]: {"commit": last["made"]["commit"]} | row for row in last["rows"]}
        rows.update({row["id"]: row for row in self.rows})
        notes = last.get("notes", {}) | self.notes
        return list(rows.values()), {name: note for name, note in notes.items() if note is not None}

    def write(self) -> Path:
        """Write the file and say where."""
        made = {
            "commit": self._commit, "dirty": self._dirty,
            "date": datetime.now(UTC).isoformat(timespec="seconds"), "machine": machine(), "command": self.command,
            "minutes": round((time.monotonic() - self._began) / 60, 2),
        }  # fmt: skip
        self.folder.mkdir(parents=True, exist_ok=True)
        rows, notes = self._with_others()
        path = self.folder / f"{self.name}.json"
        part = path.with_suffix(".part")
        part.write_text(json.dumps({"made": made, "rows": rows} | ({"notes": notes} if notes else {}), indent=1) + "\n")
        part.rename(path)
        return path


def _holds(value: float, bar: float | tuple[float, float], better: str) -> bool:
    if isinstance(bar, tuple):
        return bar[0] <= value <= bar[1]
    return value >= bar if better == "higher" else value <= bar


def machine() -> str:
    """Processor, cores, Python: what a reader needs to judge a time."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        model = next(
            (
                line.split(":", 1)[1].strip()
                for line in cpuinfo.read_text().splitlines()
                if line.startswith("model name")
            ),
            model,
        )
    return f"{model}, {os.cpu_count()} cores, Python {sys.version.split()[0]}"


def head_commit() -> str:
    """The commit that is checked out."""
    return _git("rev-parse", "HEAD")


@cache
def loaded_commit() -> str:
    """The commit that was checked out when this was first asked in this process: that of the code that runs, if asked early."""
    return head_commit()


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip()
