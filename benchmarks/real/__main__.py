"""``make evaluate-real``: measure recordings of other groups, and round trips through formats -> reports/real_data.json."""

import argparse
from collections.abc import Callable
from pathlib import Path

from benchmarks.real.kitti import drive_rows, stereo_rows
from benchmarks.real.loops import loop_rows
from benchmarks.real.matcher import matcher_rows
from benchmarks.real.resume import identical_bundles
from benchmarks.real.ros2 import answers_over_dds
from benchmarks.real.round_trips import QUERIES, import_rows, round_trip_rows, simulated
from benchmarks.real.streets import DRIVES, street_rows
from benchmarks.real.variants import variant_rows
from benchmarks.report import ROOT, Report
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.stock import ENCODER

BUILDS, FRAMES = 20, 100


def resume_rows(report: Report, work: Path) -> None:
    """Measure builds that are killed and started again.

    Args:
        report: receives the rows.
        work: folder of datasets and maps.
    """
    same = identical_bundles(simulated(work, street="8").folder, work / "resume", builds=BUILDS)
    report.row("resume.identical_bundles", float(sum(same)), "bundles", bar=BUILDS, n=BUILDS)


def ros2_rows(report: Report, work: Path) -> None:
    """Send frames over DDS to a bridge in another process. The bridge answers from the map bundle.

    Args:
        report: receives the rows.
        work: folder of datasets and maps.
    """
    dataset, bundle = simulated(work), work / "ros2_map"
    build_map(dataset, ENCODER, bundle, BuildSettings(name="ros2"), overwrite=True)
    frames = [(f.rgb(), f.depth_m(), f.camera.pinhole()) for f in dataset.queries(QUERIES)]
    answered = answers_over_dds(str(bundle), frames, FRAMES)
    report.row("ros2.answers_over_dds", float(answered), "answers", bar=FRAMES, n=FRAMES)


def main() -> None:
    """Parse the arguments, measure the parts and write the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the recordings")
    parser.add_argument("--work", type=Path, default=ROOT / "data" / "real", help="folder of datasets and maps")
    parts: dict[str, Callable[[Report, argparse.Namespace], None]] = {
        "drive": lambda report, a: drive_rows(report, a.data, a.work),
        "stereo": lambda report, a: stereo_rows(report, a.data, a.work),
        "matcher": lambda report, a: matcher_rows(report, a.data, a.work),
        "streets": lambda report, a: street_rows(report, a.data, a.work, tuple(a.drives)),
        "variants": lambda report, a: variant_rows(report, a.data, a.work),
        "round-trips": lambda report, a: round_trip_rows(report, a.work),
        "import": lambda report, a: import_rows(report, a.work),
        "loops": lambda report, _: loop_rows(report),
        "resume": lambda report, a: resume_rows(report, a.work),
        "ros2": lambda report, a: ros2_rows(report, a.work),
    }
    parser.add_argument(
        "--only", nargs="+", choices=list(parts), help="parts to measure; the rows of the other parts stay"
    )
    parser.add_argument(
        "--drives", nargs="+", choices=DRIVES, default=list(DRIVES), help="drives of the part `streets`"
    )
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    only = f" --only {' '.join(arguments.only)}" if arguments.only else ""
    only += "" if tuple(arguments.drives) == DRIVES else f" --drives {' '.join(arguments.drives)}"
    report = Report("real_data", f"python -m benchmarks.real{only}")
    if arguments.only:
        report.keep_others()
    for name, measure in parts.items():
        if not arguments.only or name in arguments.only:
            print(f"--- {name}", flush=True)
            measure(report, arguments)
            if arguments.only:  # an interrupted run keeps the parts that it has finished, and the rows of all others
                report.write()
    print(report.write())


if __name__ == "__main__":
    main()
