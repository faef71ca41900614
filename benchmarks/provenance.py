"""Where a figure comes from: the run that measured it, and whether the code that it measures has changed since."""

import os
import platform
import subprocess
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """What a reader needs to judge a figure, or to measure it again. None: not kept at the time.

    Attributes:
        commit: of the code as it was loaded.
        dirty: whether the code differed from that commit.
        date: when the run began, UTC.
        before: where ``date`` was not kept, a moment at which the row was already there.
        machine: processor, cores, Python.
        command: that makes the row.
        minutes: how long the whole run took, up to the last time that it wrote.
    """

    commit: str
    dirty: bool | None = None
    date: str | None = None
    before: str | None = None
    machine: str | None = None
    command: str | None = None
    minutes: float | None = None

    @property
    def key(self) -> str:
        """Name of the run in a report file; the same however often the run writes."""
        moment = self.date or (f"before {self.before}" if self.before else "undated")
        return f"{moment.removesuffix('+00:00')} {self.commit[:8]}"

    def as_json(self) -> dict[str, Any]:
        """All fields but ``before``, which is there where ``date`` is not."""
        return {name: value for name, value in asdict(self).items() if name != "before" or value is not None}


def add_run(runs: dict[str, dict[str, Any]], run: Run) -> str:
    """Put a run among others, and give its name there; a later state of the same run replaces the earlier one."""
    told, key = run.as_json(), run.key
    same = {name: told[name] for name in ("dirty", "machine", "command")}
    number = 1
    while key in runs and {name: runs[key][name] for name in same} != same:
        number += 1
        key = f"{run.key} #{number}"
    runs[key] = told
    return key


_CORE = (
    "service/imaging",
    "service/geometry",
    "service/maps",
    "service/registration",
    "service/localization",
    "native",  # how the C code of these is compiled
    "model_training/stock",
)
_DATA = ("model_training/simulation", "model_training/datasets", "model_training/mapping", "model_training/evaluation")
_ALL = ("streetfix", "service", "model_training", "native")
#: What rows of each report measure, by the beginning of their ids: the longest that fits counts, "" is for all others. Programs that
#: measure are left out: a row is as old as what it measures.
MEASURED: dict[str, dict[str, tuple[str, ...]]] = {
    "accuracy": {
        "": (*_CORE, *_DATA),
        "raw.": (*_CORE, *_DATA, "model_training/baselines/raw_range.py"),
        "real.": (*_CORE, "model_training/importing", "model_training/datasets", "model_training/mapping"),
        "trained_on_paper_city.": (*_CORE, *_DATA, "model_training/training"),
    },
    "choices": {"": (*_CORE, *_DATA, "model_training/training")},
    "console": {"": ("service/console", "service/http"), "docs.": (*_ALL, "README.md", "docs")},
    "house": {"": (*_ALL, "pyproject.toml", "README.md", "docs")},
    "kitti": {"": (*_CORE, *_DATA, "model_training/importing")},
    "paper": {"": (*_CORE, *_DATA, "model_training/baselines", "model_training/training")},
    "real_data": {"": (*_CORE, *_DATA, "model_training/importing", "model_training/odometry", "model_training/exporting"),
                  "real.matcher.": ("model_training/importing", "model_training/simulation",
                                    "model_training/evaluation/disparity_errors.py"),
                  "real.peers.": (*_CORE, *_DATA, "model_training/importing", "model_training/baselines"),
                  "ros2.": (*_CORE, "service/bridge")},
    "serving": {"": ("service", "native"), "fuzz.": _ALL,
                "native.": (*_CORE, "service/compiled.py", "service/layout.h", "native"),
                "sanitizers.": ("service/imaging", "service/registration", "service/layout.h", "native",
                                "tests/unit/imaging", "tests/unit/registration")},
    "training": {"": ("model_training/training", "model_training/simulation", "service/imaging", "service/geometry"),
                 "demo.": _ALL, "test.": (*_ALL, "tests")},
}  # fmt: skip


def measured_paths(report: str, row_id: str) -> tuple[str, ...]:
    """The files and folders that a row measures; all code where nothing is said of the report."""
    by_beginning = MEASURED.get(report, {"": _ALL})
    fitting = [beginning for beginning in by_beginning if row_id.startswith(beginning)]
    return by_beginning[max(fitting, key=len)]


def mark_stale(report: str, rows: Iterable[dict[str, Any]], runs: Mapping[str, Mapping[str, Any]], head: str) -> None:
    """Say of each row whether the code that it measures differs between its commit and ``head``.

    ``stale`` is true, or "unknown" where Git cannot tell: there is no repository, or it lacks the commit. Rows that are up to date
    have no such field.
    """
    for row in rows:
        changed = _changed_files(runs[row["run"]]["commit"], head)
        row.pop("stale", None)
        if changed is None:
            row["stale"] = "unknown"
        elif _touches(changed, measured_paths(report, row["id"])):
            row["stale"] = True


def _touches(changed: frozenset[str], paths: tuple[str, ...]) -> bool:
    return any(file == path or file.startswith(f"{path}/") for file in changed for path in paths)


@cache
def _changed_files(commit: str, head: str) -> frozenset[str] | None:
    """Files that differ between two commits; None where Git cannot tell. Code that was changed and changed back is the same."""
    told = git("diff", "--name-only", "--no-renames", "-z", commit, head) if commit and head else None
    return None if told is None else frozenset(told.split("\0"))


def git(*arguments: str) -> str | None:
    """What Git answers in this repository; None where there is no Git, or it refuses."""
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def head_commit() -> str:
    """The commit that is checked out; empty without Git."""
    return git("rev-parse", "HEAD") or ""


@cache
def loaded_commit() -> str:
    """The commit that was checked out when this was first asked in this process: that of the code that runs, if asked early."""
    return head_commit()


def is_dirty() -> bool | None:
    """Whether the code differs from the commit that is checked out; None without Git."""
    told = git("status", "--porcelain", "--", "streetfix", "service", "model_training", "benchmarks", "native")
    return None if told is None else bool(told)


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


@cache
def this_process(command: str) -> Run:
    """The run that this process is, as it was when this was first asked: the code as it was loaded, if asked early."""
    return Run(
        commit=loaded_commit(), dirty=is_dirty(), date=datetime.now(UTC).isoformat(timespec="seconds"), machine=machine(), command=command
    )  # fmt: skip
