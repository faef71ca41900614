"""``make paper``: compare the paper's method, its baseline, others and ours on the same data -> reports/paper.json, paper.md, figures.

The full size takes some hours on two cores. The command keeps finished work under ``--work``: data by blocks, trainings
by checkpoints. It continues after a stop. It also keeps the answers of each method beside the report. So ``--only``
runs some methods, ``--tables`` runs none, and the report covers all methods that ever ran.
"""

import argparse
import sys
from pathlib import Path

from benchmarks.paper.data import PaperData, Size
from benchmarks.paper.figures import draw_figures
from benchmarks.paper.kept import COMMAND, MethodResult
from benchmarks.paper.methods import RUNS, Bench
from benchmarks.paper.pace import Pace, measure_pace
from benchmarks.paper.page import write_page
from benchmarks.paper.rows import METHODS, all_rows
from benchmarks.provenance import this_process
from benchmarks.report import REPORTS, ROOT, Report
from model_training.cli.progress import bars

#: Part beside the methods: the training time of each method for the same number of images.
PACE = "pace"
REDUCED, REDUCED_MINUTES = Size(frames=640, pairs=320, test_images=24), 0.1


def kept_results(bench: Bench) -> dict[str, MethodResult]:
    """Load the results of all methods; each of the paper's two names gets its best variant on the held-out pairs.

    Args:
        bench: data and folder of the results.
    """
    names = [path.stem for path in sorted(bench.kept.glob("*.json"))]
    found = {name: result for name in names if (result := MethodResult.load(bench.kept, name)) is not None}
    for method in ("cnn_knn", "cnn_softmax"):
        variants = [name for name in found if name.startswith(f"{method}_")]
        if variants:
            found[method] = found[max(variants, key=lambda name: found[name].aside)]
    return found


def main() -> None:
    """Parse the arguments, run the methods and write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, help="folder of data and runs; default: data/paper")
    parser.add_argument("--out", type=Path, help="folder of the report; default: reports")
    parser.add_argument("--frames", type=int, default=Size.frames, help="number of LiDAR frames")
    parser.add_argument("--pairs", type=int, default=Size.pairs, help="number of RGB-D pairs for training")
    parser.add_argument("--test-images", type=int, help="test images of each split; default: the 626 of Table I")
    parser.add_argument(
        "--budget-minutes", type=float, default=60.0, help="processor time for each learned method, minutes"
    )
    parser.add_argument(
        "--reduced",
        action="store_true",
        help="a small run of everything within minutes, into out/paper; it only shows that everything runs",
    )
    parser.add_argument("--only", nargs="+", metavar="METHOD", help=f"methods to run: {' '.join((*RUNS, PACE))}")
    parser.add_argument("--tables", action="store_true", help="run nothing; write the report from the stored answers")
    parser.add_argument(
        "--anew", action="store_true", help="also run methods whose answers are stored; trainings resume"
    )
    arguments = parser.parse_args()
    if unknown := set(arguments.only or ()) - {*RUNS, PACE}:
        parser.error(f"--only: {', '.join(sorted(unknown))}: choose from {', '.join((*RUNS, PACE))}")
    size = Size(arguments.frames, arguments.pairs, arguments.test_images)
    work, out, minutes = ROOT / "data" / "paper", REPORTS, arguments.budget_minutes
    if arguments.reduced:
        size, minutes = REDUCED, REDUCED_MINUTES
        work, out = ROOT / "data" / "paper-reduced", ROOT / "out" / "paper"
    work, out = arguments.work or work, arguments.out or out
    bench = Bench(PaperData(work, size), 60 * minutes, out / "paper" / "answers")
    pace_file = out / "paper" / "pace.json"
    done = work / "done"
    done.mkdir(parents=True, exist_ok=True)
    this_process(COMMAND)
    report = Report(
        "paper", "make paper" + (' ARGS="' + " ".join(sys.argv[1:]) + '"' if sys.argv[1:] else ""), folder=out
    )
    wanted = [] if arguments.tables else arguments.only or [*RUNS, PACE]
    for name in wanted:
        if not arguments.anew and (pace_file if name == PACE else done / name).exists():
            continue
        print(f"--- {name}", flush=True)
        if name == PACE:
            with bars() as show:
                measure_pace(bench.data, show).save(pace_file)
            continue
        for result in RUNS[name](bench):
            result.save(bench.kept)
        (done / name).touch()
    results, pace = kept_results(bench), Pace.read(pace_file)
    missing = dict.fromkeys(METHODS, "not run yet")
    figures = all_rows(report, results, bench.data.tests, missing, pace)
    report.notes["size"] = (
        f"{size.frames} LiDAR frames, {size.pairs} RGB-D pairs, {len(bench.data.tests['other_drive'])} test images a split; "
        f"learned methods have up to {minutes:g} minutes of processor time each."
    )
    print(f"written: {report.write()}")
    pictures = draw_figures(out / "paper", bench.data, results, figures, pace)
    print(
        f"written: {write_page(out / 'paper.md', bench.data, results, figures, pictures, report.rows, minutes, pace)}"
    )


if __name__ == "__main__":
    main()
