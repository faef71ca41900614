"""Provenance of a figure: the run that measured it, and whether the measured code has changed since."""

import json
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

from benchmarks.program_text import PROGRAMS, same_program
from model_training.calibration.answer_code import CODE, hash_of

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """Information to interpret a figure or to measure it again. None means that it was not kept.

    Attributes:
        commit: commit of the loaded code.
        dirty: whether the code differed from that commit.
        date: start of the run, UTC.
        before: without ``date``, a time at which the row already existed.
        machine: processor, cores and Python version.
        command: command that makes the row.
        minutes: duration of the run until its last write, minutes.
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
        """Name of the run in a report file, the same for every write of the run."""
        moment = self.date or (f"before {self.before}" if self.before else "undated")
        return f"{moment.removesuffix('+00:00')} {self.commit[:8]}"

    def as_json(self) -> dict[str, Any]:
        """Return all fields; ``before`` only if it is set."""
        return {name: value for name, value in asdict(self).items() if name != "before" or value is not None}


def add_run(runs: dict[str, dict[str, Any]], run: Run) -> str:
    """Add a run to others and return its name; a later state of the same run replaces the earlier one.

    Args:
        runs: runs by name; changed in place.
        run: run to add.
    """
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
    "service/retrieval",
    "service/scoring",
    "service/confidence",
    "service/localization",
    "native",  # build of the C code
    # the card and other texts beside them measure nothing
    "model_training/stock/encoder.onnx",
    "model_training/stock/calibration.json",
)
_DATA = ("model_training/simulation", "model_training/datasets", "model_training/mapping", "model_training/evaluation")
_ALL = ("streetfix", "service", "model_training", "native")
_SEARCH = (
    *("service/maps/index.py", "service/maps/inverted_file.py", "service/retrieval", "service/imaging"),
    "model_training/stock/encoder.onnx",
)
#: Rows of real drives for which a calibration is made.
_OF_CALIBRATED = (
    "real.calibrated_on_0005.",
    "real.ece_after_rig_calibration",
    *(f"real.kitti_{drive}.ece_after_rig_calibration" for drive in ("0005", "0013")),
)
#: Paths that the rows of each report measure, by the beginning of their ids. The longest match counts; "" matches all
#: other rows. The benchmark programs are left out: a row is as old as the code that it measures.
MEASURED: dict[str, dict[str, tuple[str, ...]]] = {
    "accuracy": {
        "": (*_CORE, *_DATA),
        "filter.carried.": (*_CORE, *_DATA, "service/runtime/seal.py"),
        "real.": (*_CORE, "model_training/importing", "model_training/datasets", "model_training/mapping"),
        "rig.": (*_CORE, *_DATA, "model_training/calibration"),
        "rigs.": (*_CORE, *_DATA, "model_training/calibration"),
        "trained_on_paper_city.": (*_CORE, *_DATA, "model_training/training"),
    },
    "choices": {"": (*_CORE, *_DATA, "model_training/training")},
    "console": {"": ("service/console", "service/http")},
    "house": {"": (*_ALL, "pyproject.toml", "README.md", "docs")},
    "kitti": {"": (*_CORE, *_DATA, "model_training/importing")},
    "paper": {"": (*_CORE, *_DATA, "research/baselines", "model_training/training")},
    "real_data": {
        "": (*_CORE, *_DATA, "model_training/importing", "model_training/odometry", "model_training/exporting"),
        "real.matcher.": (
            "model_training/importing",
            "model_training/simulation",
            "model_training/evaluation/disparity_errors.py",
        ),
        **dict.fromkeys(_OF_CALIBRATED, (*_CORE, *_DATA, "model_training/importing", "model_training/calibration")),
        "real.peers.": (*_CORE, *_DATA, "model_training/importing", "research/baselines"),
        "ros2.": (*_CORE, "service/bridge"),
    },
    "scale": {
        "": _SEARCH,
        "search.": (*_SEARCH, "service/maps/joined_index.py", "service/maps/tiles.py"),
        "town.ready_s": (*_SEARCH, "service", "native"),
        "town.resident_mib": (*_SEARCH, "service", "native"),
    },
    "serving": {
        "": ("service", "native"),
        "fuzz.": _ALL,
        "native.": (*_CORE, "service/compiled.py", "service/layout.h", "native"),
        "sanitizers.": (
            "service/imaging",
            "service/registration",
            "service/layout.h",
            "native",
            "tests/unit/imaging",
            "tests/unit/registration",
        ),
    },
    "training": {
        "": ("model_training/training", "model_training/simulation", "service/imaging", "service/geometry"),
        "demo.": _ALL,
        "test.": (*_ALL, "research", "tests"),
    },
}

#: Tiled maps, object storage and Qdrant.
TILED_AND_STORED = (
    "service/maps/ahead.py",
    "service/maps/checked_tiles.py",
    "service/maps/joined_index.py",
    "service/maps/qdrant.py",
    "service/maps/search_address.py",
    "service/maps/store",
    "service/maps/tiled_writer.py",
    "service/maps/tiles.py",
)
#: The comparison of the stages of an answer with its ground truth.
STAGES = "model_training/evaluation/stages.py"
#: ``map update``. Among the rows of ``accuracy``, only surveys of two passes run it.
_UPDATE = (
    "model_training/mapping/area.py",
    "model_training/mapping/stored_map.py",
    "model_training/mapping/update.py",
)
#: Builds and updates of tiled maps.
_TILED_BUILDS = (
    "model_training/mapping/build_tile.py",
    "model_training/mapping/build_tiled.py",
    "model_training/mapping/engines.py",
    "model_training/mapping/tile_tasks.py",
    "model_training/mapping/update_tile.py",
    "model_training/mapping/update_tiled.py",
)
#: Training cities as files for other machines.
CITY_ARCHIVES = (
    "model_training/training/archive_places.py",
    "model_training/training/archive_reader.py",
    "model_training/training/city_archive.py",
    "model_training/training/city_engines.py",
    "model_training/training/city_task.py",
    "model_training/training/unpacked_cities.py",
)
#: Files in the folders above that no row of a report runs: tiled maps, object storage, Qdrant, commands for finished maps, the
#: comparison of stages, and training cities as files. A test checks that the benchmark loads none of them.
NOT_RUN: dict[str, tuple[str, ...]] = {
    "accuracy": (
        *TILED_AND_STORED,
        "model_training/datasets/stored_survey.py",
        "model_training/datasets/survey_part.py",
        *_TILED_BUILDS,
        "model_training/mapping/diff.py",
        "model_training/mapping/merge.py",
        "model_training/mapping/tiled_care.py",
        "model_training/mapping/verify.py",
        STAGES,
        *CITY_ARCHIVES,
    ),
    **dict.fromkeys(("choices", "kitti", "paper"), (STAGES, *_TILED_BUILDS, *CITY_ARCHIVES)),
}
NOT_RUN["real_data"] = (
    *_UPDATE,
    *(file for file in NOT_RUN["accuracy"] if file.startswith("model_training/") and file != STAGES),
)
#: Import of ROS bags. Other imports load none of these files.
BAG_IMPORT = tuple(
    f"model_training/importing/ros_{part}.py"
    for part in ("bag", "cloud", "content", "frames", "pairs", "picture", "reader", "stereo", "topics")
)
#: Options of the import that no row gives.
OPTIONS_OF_IMPORTS = ("model_training/importing/turn_times.py",)
#: Rows that import a bag.
_OF_BAGS = ("import.", "roundtrip.bag.", "roundtrip.mcap.")
#: Files that only some rows of a report run, by the beginning of their ids.
ONLY_RUN_BY: dict[str, dict[str, tuple[str, ...]]] = {
    "accuracy": {
        "service/localization/tracker.py": ("filter.",),
        "service/localization/track_bytes.py": ("filter.carried.",),
        "service/maps/inverted_file.py": (),
        **dict.fromkeys(_UPDATE, ("survey.two_passes_",)),
        **dict.fromkeys((*BAG_IMPORT, *OPTIONS_OF_IMPORTS), ()),
    },
    "kitti": dict.fromkeys((*BAG_IMPORT, *OPTIONS_OF_IMPORTS), ()),
    "real_data": {
        STAGES: tuple(f"real.kitti_{drive}.{row}" for drive in ("0005", "0013") for row in ("inliers", "retrieval_at")),
        "service/localization/tracker.py": ("real.track.", "ros2."),
        "service/maps/inverted_file.py": (),
        **dict.fromkeys(TILED_AND_STORED, ("resume.", "ros2.")),  # these rows start commands in processes of their own
        **dict.fromkeys(BAG_IMPORT, _OF_BAGS),
        **dict.fromkeys(OPTIONS_OF_IMPORTS, ()),
    },
    # The maps of this report are folders. Only a map in object storage is fetched.
    "serving": {"service/maps/store": ("fuzz.",), "service/runtime/fetch_log.py": ("fuzz.",)},
}
#: Rows that measure text, by the beginning of their ids. For all other rows, comments and docstrings do not count.
TEXT: dict[str, tuple[str, ...]] = {"house": ("",)}
#: No map of these reports has as many views as ``inverted_file.SMALLEST``, which a test keeps. The largest has about 160,000.
MOST_VIEWS = 1_000_000

#: Passed checks that a change left answers equal (``benchmarks.same_answers``).
CHECKS = ROOT / "reports" / "checks" / "same_answers.json"


def measured_paths(report: str, row_id: str) -> tuple[str, ...]:
    """Return the files and folders that a row measures; all code for an unknown report.

    Args:
        report: name of the report.
        row_id: id of the row.
    """
    by_beginning = MEASURED.get(report, {"": _ALL})
    fitting = [beginning for beginning in by_beginning if row_id.startswith(beginning)]
    return by_beginning[max(fitting, key=len)]


def mark_stale(report: str, rows: Iterable[dict[str, Any]], runs: Mapping[str, Mapping[str, Any]], head: str) -> None:
    """Mark each row whose measured code differs between its commit and ``head``.

    ``stale`` is true, or "unknown" if Git cannot tell: there is no repository, or it lacks the commit. It is "same answers" if the code
    changed, but a check compared the answers of both versions (``benchmarks.same_answers``). Current rows have no such field.

    Args:
        report: name of the report.
        rows: rows of the report; changed in place.
        runs: runs by name.
        head: commit to compare with.
    """
    for row in rows:
        commit = runs[row["run"]]["commit"]
        changed = _changes_row(report, row["id"], commit, head)
        row.pop("stale", None)
        if changed is None:
            row["stale"] = "unknown"
        elif changed:
            row["stale"] = "same answers" if _is_checked(report, row["id"], commit, head) else True


def _changes_row(report: str, row_id: str, commit: str, head: str) -> bool | None:
    """Return whether code that a row measures differs between two commits; None if Git cannot tell."""
    changed = _changed_files(commit, head)
    if changed is None:
        return None
    others = (file for file, rows in ONLY_RUN_BY.get(report, {}).items() if not row_id.startswith(rows))
    not_run, paths = (*NOT_RUN.get(report, ()), *others), measured_paths(report, row_id)
    text_counts = row_id.startswith(TEXT.get(report, ()))
    return any(
        _is_in(file, paths) and not _is_in(file, not_run) and (text_counts or not _same_program(file, *objects))
        for file, objects in changed.items()
    )


def _is_checked(report: str, row_id: str, commit: str, head: str) -> bool:
    """Return whether checks connect the code of a row with that of ``head``. Each check connects two commits."""
    checks = [
        each
        for each in _checks()
        if row_id.startswith(tuple(each["covered"].get(report, ())))
        and not row_id.startswith(tuple(each["not_covered"].get(report, ())))
    ]
    reached = [commit]
    for origin in reached:
        if _changes_row(report, row_id, origin, head) is False:
            return True
        for check in checks:
            if check["after"] not in reached and _changes_row(report, row_id, origin, check["before"]) is False:
                reached.append(check["after"])
    return False


def _checks() -> list[dict[str, Any]]:
    kept: list[dict[str, Any]] = json.loads(CHECKS.read_text()) if CHECKS.exists() else []
    return kept


def _is_in(file: str, paths: tuple[str, ...]) -> bool:
    return any(file == path or file.startswith(f"{path}/") for path in paths)


@cache
def _changed_files(commit: str, head: str) -> dict[str, tuple[str, str]] | None:
    """Return the files that differ between two commits; None if Git cannot tell. A change that was undone does not count.

    Args:
        commit: one commit.
        head: the other commit.

    Returns:
        The Git objects of both versions by file. A missing version has zeros.
    """
    told = git("diff", "--raw", "--no-abbrev", "--no-renames", "-z", commit, head) if commit and head else None
    if told is None:
        return None
    fields = told.split("\0")
    return {
        name: (about.split()[2], about.split()[3])
        for about, name in zip(fields[::2], fields[1::2], strict=False)  # an empty field follows the last file
    }


def changed_programs(commit: str, head: str = "HEAD") -> list[str] | None:
    """Return the files that differ in more than comments, docstrings and layout; None if Git cannot tell.

    Args:
        commit: one commit.
        head: the other commit.
    """
    changed = _changed_files(commit, head)
    return None if changed is None else [file for file, objects in changed.items() if not _same_program(file, *objects)]


@cache
def _same_program(name: str, before: str, after: str) -> bool:
    """Return whether two versions of a file, named by their Git objects, are the same program."""
    if not name.endswith(PROGRAMS):
        return False
    one, other = git("cat-file", "blob", before), git("cat-file", "blob", after)
    return one is not None and other is not None and same_program(name, one, other)


def commit_with_code(code: str, head: str = "HEAD") -> str | None:
    """Return the newest commit up to ``head`` whose files have a hash of ``answer_code.hash_of``; None if Git finds none.

    Args:
        code: the hash.
        head: commit at which the search begins.
    """
    commits = (git("rev-list", "--max-count=500", head, "--", *CODE) or "").split()
    for commit in (git("rev-parse", head) or "", *commits):
        listed = (git("ls-tree", "-r", "-z", commit, "--", *CODE) if commit else None) or ""
        files = [entry.split("\t", 1) for entry in listed.split("\0") if entry]
        if hash_of((path, about.split()[2]) for about, path in files) == code:
            return commit
    return None


def git(*arguments: str) -> str | None:
    """Return Git's output in this repository; None without Git or after an error.

    Args:
        *arguments: arguments of Git.
    """
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def head_commit() -> str:
    """Return the checked-out commit; empty without Git."""
    return git("rev-parse", "HEAD") or ""


@cache
def loaded_commit() -> str:
    """Return the commit at the first call in this process, which is that of the running code if called early."""
    return head_commit()


def is_dirty() -> bool | None:
    """Return whether the code differs from the checked-out commit; None without Git."""
    told = git(
        "status", "--porcelain", "--", "streetfix", "service", "model_training", "research", "benchmarks", "native"
    )
    return None if told is None else bool(told)


def machine() -> str:
    """Return processor, cores and Python version, which a reader needs to interpret a time."""
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
    """Return the run of this process at its first call; the code is the loaded one if called early.

    Args:
        command: command that makes the rows.
    """
    return Run(
        commit=loaded_commit(),
        dirty=is_dirty(),
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        machine=machine(),
        command=command,
    )
