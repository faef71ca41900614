"""The compiled code as shipped: its instructions, equal answers of two compilers' builds, and sanitizer reports."""

import platform
import tempfile
from pathlib import Path

from benchmarks.native.instructions import beyond_baseline
from benchmarks.native.sanitizers import sanitize
from benchmarks.native.wheels import build_wheel, libraries, python_in
from benchmarks.report import Report
from benchmarks.runs import Runs
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.stock import ENCODER
from model_training.training.recipe import EVALUATION_SEEDS

QUERIES = 200


def native_plan() -> SimulationPlan:
    """Plan a small city: the work of the compiled code per query does not depend on the size of the map."""
    queries = (QueryPlan(name="drive1", traversal=1, count=QUERIES, depths=("stereo",)),)
    return SimulationPlan(name="native", seed=EVALUATION_SEEDS[1], size_m=(160.0, 160.0), queries=queries)


def native_rows(report: Report, work: Path) -> None:
    """Add rows of a wheel built without a system compiler: its instructions, and its answers against a gcc build.

    Args:
        report: collects the rows.
        work: folder of datasets and maps.

    Raises:
        RuntimeError: the answers of a build failed or are incomplete.
    """
    with tempfile.TemporaryDirectory() as folder:
        by_zig = build_wheel(Path(folder) / "zig", "zig")
        found = {library.name: beyond_baseline(library) for library in libraries(by_zig)}
        for name, instructions in found.items():
            if instructions:
                print(f"{name}: {dict(instructions.most_common(10))}")
        report.row(
            "native.instructions_beyond_baseline",
            sum(each.total() for each in found.values()),
            "instructions",
            bar=0,
            better="lower",
            n=len(found),
        )
        report.notes["native"] = (
            f"A wheel built by zig on {platform.machine()}, PATH empty; {len(found)} libraries disassembled. Answers to {QUERIES} "
            "stereo queries of a small city, by that wheel and by one built with gcc, compared bit by bit."
        )
        runs = Runs(work, ENCODER)
        dataset = runs.dataset(native_plan())
        bundle = runs.bundle(dataset)
        asked = [
            *("-m", "benchmarks.native.answers"),
            *("--map", str(bundle.path.resolve()), "--dataset", str(dataset.folder.resolve())),
            *("--queries", "drive1_stereo", "--count", str(QUERIES)),
        ]
        by_gcc = build_wheel(Path(folder) / "gcc", "gcc")
        answers = []
        for unpacked in (by_zig, by_gcc):
            done = python_in(unpacked, asked)
            if done.returncode != 0:
                raise RuntimeError(done.stderr[-4000:])
            answers.append(done.stdout.splitlines())
        if [len(each) for each in answers] != [QUERIES, QUERIES]:
            raise RuntimeError(f"{QUERIES} queries were sent, {[len(each) for each in answers]} answered")
        differ = sum(one != other for one, other in zip(*answers, strict=True))
        report.row("native.answers_differ_gcc_zig", differ, "answers", bar=0, better="lower", n=QUERIES)


def sanitizer_rows(report: Report) -> None:
    """Add the number of reports of AddressSanitizer and UndefinedBehaviorSanitizer (``make sanitize``).

    Args:
        report: collects the rows.
    """
    found = sanitize()
    for each in found:
        print(each, end="\n\n")
    report.row("sanitizers.reports", len(found), "reports", bar=0, better="lower")
