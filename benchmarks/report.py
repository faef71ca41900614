"""``reports/NAME.json``: rows with bars, each with the run that measured it."""

import json
import time
from collections.abc import Iterable, Iterator, Mapping
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
    """Collects rows; ``write`` replaces the file atomically.

    The file holds ``runs`` by name, ``rows`` that each name their ``run``, and ``notes``.

    Args:
        name: name of the file, without suffix.
        command: command that makes the report again.
        rows: rows so far.
        notes: notes by name.
        folder: folder of the file.
    """

    name: str
    command: str
    rows: list[dict[str, Any]] = field(default_factory=list)
    notes: dict[str, Any] = field(default_factory=dict)
    folder: Path = field(default_factory=lambda: REPORTS)
    _keep: bool = False
    _began: float = field(default_factory=time.monotonic)
    # The commit of the loaded code counts, not that at the time of writing.
    _commit: str = field(default_factory=head_commit)
    _dirty: bool | None = field(default_factory=is_dirty)
    _date: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))
    _made_by: Run | None = None  # run of rows that are added now; None is this run
    _if_new: set[str] = field(default_factory=set)  # ids of rows that replace no value of an earlier run
    _runs: dict[str, Run | None] = field(default_factory=dict)  # value of ``_made_by`` by row

    def row(
        self,
        row_id: str,
        value: float | None,
        unit: str,
        *,
        bar: float | tuple[float, float] | None = None,
        better: Literal["higher", "lower"] = "higher",
        n: int | None = None,
        ci95: list[float] | None = None,
        why: str | None = None,
    ) -> None:
        """Add a row; ``holds`` follows from value and bar.

        A figure of no sample is no figure: with a bar, the row then has no value, and its bar does not hold.
        ``benchmarks/why_missed.py`` holds the reasons that people found later.

        Args:
            row_id: id of the row.
            value: the figure; None if absent.
            unit: unit of the figure.
            bar: limit of the figure; two numbers are a range; None for no bar.
            better: whether higher or lower values are better.
            n: number of samples.
            ci95: 95 % interval, lower and upper end.
            why: remark of the run itself.
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
        _drop_figures_of_nothing([entry])
        explain([entry])
        self.rows = [r for r in self.rows if r["id"] != row_id] + [entry]
        self._runs[row_id] = self._made_by
        mark = "" if bar is None else ("  holds" if entry["holds"] else "  MISSED")
        shown = "-" if entry["value"] is None else f"{entry['value']:.4f}"
        print(f"{row_id:62} {shown:>10} {unit:8}{'' if bar is None else f' bar {bar}'}{mark}", flush=True)

    def absent(self, row_id: str, unit: str, why: str) -> None:
        """Add a row without a value, unless the file already has a value of another run.

        Args:
            row_id: id of the row.
            unit: unit of the figure.
            why: why this run cannot measure it.
        """
        self.row(row_id, None, unit, why=why)
        self._if_new.add(row_id)

    def share(
        self,
        row_id: str,
        right: NDArray[np.bool_],
        *,
        bar: float | None = None,
        better: Literal["higher", "lower"] = "higher",
        why: str | None = None,
    ) -> None:
        """Add a row of a share with its Wilson interval.

        Args:
            row_id: id of the row.
            right: outcome of each query (N,).
            bar: limit of the share; None for no bar.
            better: whether higher or lower values are better.
            why: remark of the run itself.
        """
        if not len(right):
            self.row(row_id, None, "share", bar=bar, better=better, why="no query of this type")
            return
        interval = list(wilson_interval(int(right.sum()), len(right)))
        self.row(row_id, float(right.mean()), "share", bar=bar, better=better, n=len(right), ci95=interval, why=why)

    @contextmanager
    def made_by(self, run: Run) -> Iterator[None]:
        """Attribute the rows added inside to another run, whose results were kept.

        Args:
            run: the run that measured the rows.
        """
        self._made_by = run
        try:
            yield
        finally:
            self._made_by = None

    def keep_others(self) -> None:
        """Keep the rows and runs of an existing file; this run's rows replace rows of the same id.

        ``write`` reads the file late, so that two parts can be measured at the same time. Notes are kept as well; a
        note that is None is dropped.
        """
        self._keep = True

    def write(self) -> Path:
        """Write the file and return its path."""
        path = self.folder / f"{self.name}.json"
        last = json.loads(path.read_text()) if self._keep and path.exists() else {"runs": {}, "rows": []}
        this = Run(
            commit=self._commit,
            dirty=self._dirty,
            date=self._date,
            machine=machine(),
            command=self.command,
            minutes=round((time.monotonic() - self._began) / 60, 2),
        )
        runs = dict(last["runs"])
        keys = {run: add_run(runs, run) for run in dict.fromkeys(self._runs[row["id"]] or this for row in self.rows)}
        rows = {row["id"]: row for row in last["rows"]}
        for row in self.rows:
            if row["id"] in self._if_new and rows.get(row["id"], {}).get("value") is not None:
                continue
            run = keys[self._runs[row["id"]] or this]
            rows[row["id"]] = {"id": row["id"], "run": run} | row
        notes = {name: note for name, note in (last.get("notes", {}) | self.notes).items() if note is not None}
        return write_report(path, {"runs": runs, "rows": list(rows.values())} | ({"notes": notes} if notes else {}))


def write_report(path: Path, report: Mapping[str, Any]) -> Path:
    """Write a report atomically with current reasons and stale marks, without unused runs.

    Args:
        path: file to write.
        report: ``runs``, ``rows`` and ``notes``; the rows are changed in place.
    """
    rows, runs, head = report["rows"], report["runs"], head_commit()
    _drop_figures_of_nothing(rows)
    explain(rows)
    mark_stale(path.stem, rows, runs, head)
    named = {row["run"] for row in rows}
    kept = {key: runs[key] for key in sorted(runs) if key in named}
    # Repeat the newest run for programs that expect one commit per report. The run of each row is what counts.
    dated = [run for run in kept.values() if run.get("date")]
    made = max(dated, key=lambda run: run["date"]) if dated else None
    told = {"made": made, "stale_as_of": head or None, "runs": kept, "rows": rows}
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(told | ({"notes": report["notes"]} if report.get("notes") else {}), indent=1) + "\n")
    part.rename(path)
    return path


def _drop_figures_of_nothing(rows: Iterable[dict[str, Any]]) -> None:
    """Remove the value of each row that has a bar and no sample. Its bar does not hold, because nothing shows it."""
    for row in rows:
        if row.get("n") == 0 and "bar" in row and row["value"] is not None:
            row |= {"value": None, "holds": False, "why": row.get("why", "there is no sample")}


def _holds(value: float, bar: float | tuple[float, float], better: str) -> bool:
    if isinstance(bar, tuple):
        return bar[0] <= value <= bar[1]
    return value >= bar if better == "higher" else value <= bar
