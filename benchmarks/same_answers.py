"""Check that a change of code leaves all answers equal -> reports/checks/same_answers.json.

Most changes of the answering code only rename or move things. Then measuring all rows again takes hours and shows nothing. This command
runs both versions of the code on the same small cities, and on KITTI drive 0005 if it is there: ``simulate`` or ``import``, ``build-map``
and ``evaluate``. Another small city has queries of several frames or cameras, priors, given heights and tracks
(``benchmarks.several_frames``). It compares the files of the maps and every number of the answers, except durations. If all are equal to
the bit, rows of these answers stay valid over the change (``benchmarks.provenance``).

Example: python -m benchmarks.same_answers --before HEAD~3
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import several_frames
from benchmarks.provenance import CHECKS, ROOT, changed_programs, git, head_commit, is_dirty, machine
from benchmarks.real.streets import unpacked

#: Beginnings of the ids of rows that a check covers, by report: answers on maps of one bundle.
COVERED = {
    "accuracy": (
        *("full.", "retrieval.", "doubt.", "rigs.", "ground.", "height.", "survey."),
        *("prior.", "sequence.", "filter."),
    ),
    "real_data": ("real.kitti_", "real.strangers.", "real.sequence5.", "real.track.", "real.ece"),
}
#: Beginnings of the ids of rows among them that it does not cover, because a map is updated or a calibration is made for them.
NOT_COVERED = {
    "accuracy": ("survey.two_passes_",),
    "real_data": (
        "real.ece_after_rig_calibration",
        *(f"real.kitti_{drive}.ece_after_rig_calibration" for drive in ("0005", "0013")),
    ),
}
#: Answers that a change may alter on purpose: their files, and the beginnings of the rows that the check then does not cover.
_PRIOR_FILES = ("right_prior.npz", "wrong_prior.npz")
CHANGED = {
    "priors": (
        _PRIOR_FILES,
        {"accuracy": ("prior.",), "real_data": tuple(f"real.kitti_{drive}.prior_" for drive in ("0005", "0013"))},
    )
}
#: Fields of the answers that differ between two runs of the same code.
DURATIONS = ("ms",)
DRIVE = "kitti_0005"


@dataclass(frozen=True, slots=True)
class Recording:
    """A dataset of the check.

    Attributes:
        name: name of its folders.
        options: arguments of ``streetfix simulate`` or ``streetfix import``, without ``--out``.
    """

    name: str
    options: tuple[str, ...]


_SIZE = ("--size", "120x150", "--queries", "40", "--drives", "2")
#: Modelled depth errors; a car with matched stereo pairs and a sparse survey; a small camera with a narrow view and a
#: short range that looks down.
SIMULATED = (
    Recording("city", ("simulate", "--seed", "7101", *_SIZE, "--depth", "precise", "--depth", "stereo")),
    Recording(
        "car",
        ("simulate", "--seed", "7102", "--city", "mixed", *_SIZE, "--lidar", "hdl_64", "--spacing", "2.5", "--camera", "1242x376",
         "--hfov", "81.4", "--depth", "sgbm", "--set", "stereo.focal_baseline_px_m=384"),
    ),
    Recording(
        "robot",
        ("simulate", "--seed", "7103", "--city", "mixed", *_SIZE, "--lidar", "vlp_16", "--camera", "640x360", "--hfov", "69",
         "--pitch", "20", "--depth", "precise", "--set", "depth.max_range_m=12"),
    ),
)  # fmt: skip


#: Python runs this before anything else. An editable installation imports its own folder first, whatever ``PYTHONPATH`` says.
_NOT_INSTALLED = """import sys

sys.meta_path[:] = [each for each in sys.meta_path if not type(each).__module__.startswith("_editable_")]
"""


class DifferentAnswersError(Exception):
    """The two versions of the code differ in a file of a map, or in a number of an answer."""


class Version:
    """A checked-out version of the code that can run ``streetfix``.

    Args:
        folder: root of the repository or of a work tree.
        work: folder of its datasets, maps and answers.
    """

    def __init__(self, folder: Path, work: Path) -> None:
        self._folder, self.work = folder, work

    def run(self, *arguments: str) -> None:
        """Run a command of ``streetfix`` with the code of this version.

        Args:
            *arguments: arguments of the command.

        Raises:
            subprocess.CalledProcessError: the command failed, or the code of another folder would have run.
        """
        self._python("from service.cli.start import main\nmain()\n", arguments)

    def _python(self, program: str, arguments: Sequence[str]) -> None:
        """Run a program with the code of this version."""
        code = (
            "import pathlib, sys, service, model_training\n"
            f"root = pathlib.Path({str(self._folder)!r})\n"
            "for module in (service, model_training):\n"
            "    if not pathlib.Path(module.__file__).is_relative_to(root):\n"
            "        sys.exit(f'{module.__file__} is not in {root}')\n"
            f"{program}"
        )
        first = self.work / "first"
        first.mkdir(parents=True, exist_ok=True)
        (first / "sitecustomize.py").write_text(_NOT_INSTALLED)
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (self._folder, first)))}
        subprocess.run([sys.executable, "-c", code, *arguments], cwd=self._folder, env=environment, check=True)

    def answers(self, recording: Recording, other: Path | None = None) -> Path:
        """Make a dataset, build its map and answer its queries; return the folder of the map and the answers.

        The queries are answered with and without registration, and on the map of another dataset.

        Args:
            recording: the dataset.
            other: folder of another dataset, as this method returns it.
        """
        folder = self.work / recording.name
        data, bundle = str(folder / "data"), str(folder / "map")
        self.run(*recording.options, "--out", data)
        self.run("build-map", data, "--out", bundle)
        asked = {"answers": (bundle, "--refine"), "retrieved": (bundle, "--no-refine")}
        if other is not None:
            asked["outside"] = (str(other / "map"), "--refine")
        for name, (path, refine) in asked.items():
            self.run("evaluate", path, data, refine, "--predictions", str(folder / name), "--list", "0")
        return folder

    def answers_of_frames(self) -> Path:
        """Answer the queries of ``several_frames``; return the folder of the map and the answers.

        Both versions run the same program, which is that of this file's version.

        Raises:
            subprocess.CalledProcessError: the program failed. Its names may be new, so that the older version lacks them.
        """
        folder = self.work / "frames"
        folder.mkdir(parents=True)
        self._python(Path(several_frames.__file__).read_text(), (str(folder),))
        return folder


def compare(before: Path, after: Path, leave_out: Sequence[str] = ()) -> int:
    """Compare the maps and the answers of two versions; return the number of answers.

    Args:
        before: folder of ``Version.answers``.
        after: the same of the other version.
        leave_out: names of files of answers that may differ.

    Raises:
        DifferentAnswersError: they differ. The message names the first difference.
    """
    files = [json.loads((folder / "map" / "manifest.json").read_text())["files"] for folder in (before, after)]
    for name in sorted(files[0].keys() | files[1].keys()):
        if files[0].get(name) != files[1].get(name):
            raise DifferentAnswersError(f"{after.name}: the map's file {name} differs")
    names = [
        sorted(str(path.relative_to(folder)) for path in folder.glob("*/*.npz") if path.name not in leave_out)
        for folder in (before, after)
    ]
    if names[0] != names[1] or not names[0]:
        raise DifferentAnswersError(f"{after.name}: query sets {names[0]} and {names[1]}")
    count = 0
    for name in names[0]:
        with np.load(before / name) as one, np.load(after / name) as other:
            if set(one.files) != set(other.files):
                raise DifferentAnswersError(f"{after.name}/{name}: fields {sorted(set(one.files) ^ set(other.files))}")
            for field in sorted(set(one.files) - set(DURATIONS)):
                if one[field].dtype != other[field].dtype or one[field].tobytes() != other[field].tobytes():
                    raise DifferentAnswersError(f"{after.name}/{name}: {field} differs")
            count += len(one["T_true"])
    return count


def work_tree(commit: str, folder: Path) -> None:
    """Check out a commit beside this one, with compiled C code: that of this commit if the sources are the same.

    Args:
        commit: the commit.
        folder: a folder that does not exist yet.

    Raises:
        ValueError: the commit is unknown.
        subprocess.CalledProcessError: its C code cannot be compiled.
    """
    if git("cat-file", "-e", f"{commit}^{{commit}}") is None:
        raise ValueError(f"--before: {commit} is not a commit of this repository")
    changed = changed_programs(commit) or []
    if git("worktree", "add", "--detach", str(folder), commit) is None:
        raise ValueError(f"--before: cannot check out {commit} in {folder}")
    if any(name.endswith((".c", ".h")) or name.startswith("native/") for name in changed):
        compile_code(folder)
        return
    for package in ("service", "model_training"):
        for library in (ROOT / package).rglob("*.so"):
            shutil.copy(library, folder / library.relative_to(ROOT))


def compile_code(folder: Path) -> None:
    """Compile the C code of a checked-out commit into its folders, as an editable installation does.

    Args:
        folder: root of the work tree.

    Raises:
        subprocess.CalledProcessError: CMake or the compiler failed.
    """
    tools, build = Path(sys.executable).parent, folder / "build" / "same_answers"
    options = (f"-DCMAKE_MAKE_PROGRAM={tools / 'ninja'}", "-DCMAKE_BUILD_TYPE=Release", "-DSKBUILD_STATE=editable")
    cmake = str(tools / "cmake")
    subprocess.run([cmake, "-S", str(folder / "native"), "-B", str(build), "-G", "Ninja", *options], check=True)
    subprocess.run([cmake, "--build", str(build)], check=True)


def record(before: str, after: str, queries: dict[str, int], changed: str | None = None) -> dict[str, Any]:
    """Return the record of a passed check.

    Args:
        before: commit of the older version.
        after: commit of the newer version.
        queries: number of compared answers of each dataset.
        changed: key of ``CHANGED``; None if all answers were compared.
    """
    more: Mapping[str, tuple[str, ...]] = {} if changed is None else CHANGED[changed][1]
    reports = sorted({*NOT_COVERED, *more})
    return {
        "before": before,
        "after": after,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine(),
        "queries": queries,
        "covered": {report: list(beginnings) for report, beginnings in COVERED.items()},
        "not_covered": {report: [*NOT_COVERED.get(report, ()), *more.get(report, ())] for report in reports},
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the arguments, compare both versions and write the record; return 1 if they differ.

    Args:
        arguments: arguments of the command; None takes those of the process.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", required=True, help="commit of the older version")
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the real recordings"
    )
    parser.add_argument(
        "--changed", choices=sorted(CHANGED), help="answers that the change alters on purpose; their rows stay stale"
    )
    given = parser.parse_args(arguments)
    leave_out = () if given.changed is None else CHANGED[given.changed][0]
    if is_dirty():
        parser.error("the code differs from HEAD; commit first, so that the record can name what it compared")
    before, after = git("rev-parse", f"{given.before}^{{commit}}") or given.before, head_commit()
    with tempfile.TemporaryDirectory(prefix="same_answers_") as name:
        work, tree = Path(name), Path(name, "before")
        try:
            work_tree(before, tree)
            recordings = [*SIMULATED, *_real(given.data.resolve(), work)]
            older, newer = Version(tree, work / "answers_before"), Version(ROOT, work / "answers_after")
            queries: dict[str, int] = {}
            last: tuple[Path | None, Path | None] = (None, None)
            for number, recording in enumerate(recordings):
                print(f"--- {recording.name} ({number + 1} of {len(recordings)})", flush=True)
                last = older.answers(recording, last[0]), newer.answers(recording, last[1])
                queries[recording.name] = compare(*last)
                print(f"{recording.name}: {queries[recording.name]} equal answers", flush=True)
            print("--- frames", flush=True)
            queries["frames"] = compare(older.answers_of_frames(), newer.answers_of_frames(), leave_out)
            print(f"frames: {queries['frames']} equal answers", flush=True)
        except ValueError as error:
            parser.error(str(error))
        except DifferentAnswersError as difference:
            print(f"different: {difference}")
            return 1
        finally:
            git("worktree", "remove", "--force", str(tree))
            git("worktree", "prune")
    if head_commit() != after or is_dirty():
        print("the code changed during the check; start it again")
        return 1
    CHECKS.parent.mkdir(parents=True, exist_ok=True)
    kept = json.loads(CHECKS.read_text()) if CHECKS.exists() else []
    CHECKS.write_text(json.dumps([*kept, record(before, after, queries, given.changed)], indent=1) + "\n")
    print(f"written: {CHECKS.relative_to(ROOT)}")
    return 0


def _real(data: Path, work: Path) -> list[Recording]:
    """Return the real drive, unpacked; nothing without the recordings."""
    drive = unpacked(data, work, DRIVE)
    return [] if drive is None else [Recording(DRIVE, ("import", "kitti-raw", str(drive), "--depth", "sgbm"))]


if __name__ == "__main__":
    sys.exit(main())
