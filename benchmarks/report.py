"""``reports/NAME.json``: rows with bars, each with the run that measured it."""

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.provenance import ROOT, Run, add_run, head_commit, is_dirty, loaded_commit, machine, mark_stale
from benchmarks.why_missed import explain
from model_training.evaluation.error_measures import wilson_interval

__all__ = ["REPORTS", "ROOT", "Report", "head_commit", "loaded_commit", "machine"]
REPORTS = ROOT / "reports"


@dataclass
class Report:
    """Collects rows; ``write`` replaces the file in one go.

    The file holds ``runs`` by name, ``rows`` that each name their ``run``, and ``notes``.

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
    _commit: str = field(default_factory=head_commit)
    _dirty: bool | None = field(default_factory=is_dirty)
    _date: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))
    _made_by: Run | None = None  # rows that are added now; None: this run
    _runs: dict[str, Run | None] = field(default_factory=dict)  # by row, as ``_made_by`` was

    def row(
        self, row_id: str, value: float | None, unit: str, *, bar: float | tuple[float, float] | None = None,
        better: Literal["higher", "lower"] = "higher", n: int | None = None, ci95: list[float] | None = None, why: str | None = None,
    ) -> None:  # fmt: skip
        """Add a row; ``holds`` follows from value and bar; a bar of two numbers is a range.

        ``why`` is what the run itself knows of the value; ``benchmarks/why_missed.py`` has what people found out.
        """
        entry: dict[str, Any] = {"id": row_id, "value": value, "unit": unit}
        if n is not None:
            entry["n"] = n
        if ci95 is not None:
            entry["ci95"] = ci95
        if bar is not None:
            holds = value is not None and _holds(value, bar, better)
            shown_bar: object = list(bar) if isinstance(bar, tuple) else bar
            entry |= {"bar": shown_bar, "better": "inside" if isinstance(bar, tuple) else better, "holds": holds}
        if why:
            entry["why"] = why
        explain([entry])
        self.rows = [r for r in self.rows if r["id"] != row_id] + [entry]
        self._runs[row_id] = self._made_by
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

    @contextmanager
    def made_by(self, run: Run) -> Iterator[None]:
        """Rows that are added inside were measured by another run, whose results were kept."""
        self._made_by = run
        try:
            yield
        finally:
            self._made_by = None

    def keep_others(self) -> None:
        """Keep the rows of earlier runs, each with the run that measured it; this run's replace them.

        What is kept is read when the report is written, so that two parts may be measured at once. Notes are kept as well; one
        that is None here is dropped.
        """
        self._keep = True

    def write(self) -> Path:
        """Write the file and say where."""
        path = self.folder / f"{self.name}.json"
        last = json.loads(path.read_text()) if self._keep and path.exists() else {"runs": {}, "rows": []}
        this = Run(
            commit=self._commit, dirty=self._dirty, date=self._date, machine=machine(), command=self.command,
            minutes=round((time.monotonic() - self._began) / 60, 2),
        )  # fmt: skip
        runs = dict(last["runs"])
        keys = {run: add_run(runs, run) for run in dict.fromkeys(self._runs[row["id"]] or this for row in self.rows)}
        rows = {row["id"]: row for row in last["rows"]}
        for row in self.rows:
            run = keys[self._runs[row["id"]] or this]
            rows[row["id"]] = {"id": row["id"], "run": run} | row
        notes = {name: note for name, note in (last.get("notes", {}) | self.notes).items() if note is not None}
        return write_report(path, {"runs": runs, "rows": list(rows.values())} | ({"notes": notes} if notes else {}))


def write_report(path: Path, report: Mapping[str, Any]) -> Path:
    """Write a report whole or not at all: with its reasons and with what is stale as they are now, without runs that no row names."""
    rows, runs, head = report["rows"], report["runs"], head_commit()
    explain(rows)
    mark_stale(path.stem, rows, runs, head)
    named = {row["run"] for row in rows}
    kept = {key: runs[key] for key in sorted(runs) if key in named}
    # The newest run once more, for programs that ask a report for one commit; each row's own run is what counts.
    dated = [run for run in kept.values() if run.get("date")]
    made = max(dated, key=lambda run: run["date"]) if dated else None
    told = {"made": made, "stale_as_of": head or None, "runs": kept, "rows": rows}
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(told | ({"notes": report["notes"]} if report.get("notes") else {}), indent=1) + "\n")
    part.rename(path)
    return path


def _holds(value: float, bar: float | tuple[float, float], better: str) -> bool:
    if isinstance(bar, tuple):
        return bar[0] <= value <= bar[1]
    return value >= bar if better == "higher" else value <= bar
