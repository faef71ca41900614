"""``make bench-serving``: measure the service against the bare pipeline, under overload, swaps, signals and hostile clients.

The default map is the paper's city, its survey thinned to one metre, with the stock encoder. The server has one core,
the load generator another. The command keeps everything that it simulates or builds under ``--work``, as ``make
evaluate`` does. Use an idle machine.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from benchmarks.plans import paper_plan
from benchmarks.report import ROOT, Report
from benchmarks.runs import Runs
from benchmarks.serving.decoding import decoding_rows
from benchmarks.serving.fire import overload_rows, sigterm_rows, swap_rows
from benchmarks.serving.hostile import hostile_rows
from benchmarks.serving.machines import LOADING_CORE, SERVED_CORE, pin
from benchmarks.serving.memory import memory_rows
from benchmarks.serving.native import native_rows, sanitizer_rows
from benchmarks.serving.peers.measure import PEERS, peer_rows
from benchmarks.serving.ratios import Site, ratio_rows, tail_rows
from benchmarks.serving.sizes import size_rows
from benchmarks.serving.soak import JUDGED_MINUTES, soak_rows
from model_training.stock import ENCODER
from service.maps.reader import MapBundle

QUERIES, PAIRS = "drive1_precise", 50
#: Parts that need no map of the paper's city.
WITHOUT_A_MAP = {"native", "sanitizers"}


def site_from(arguments: argparse.Namespace) -> Site:
    """Return the map and the queries of the arguments, or else of the paper's city.

    Args:
        arguments: parsed command line.
    """
    if arguments.map is not None:
        return Site(arguments.map.resolve(), arguments.dataset.resolve(), arguments.queries, PAIRS)
    runs = Runs(arguments.work, ENCODER)
    dataset = runs.dataset(paper_plan())
    return Site(runs.bundle(dataset).path, dataset.folder, arguments.queries, PAIRS)


def main() -> None:
    """Parse the arguments, measure and write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=ROOT / "data" / "evaluate", help="folder of datasets and maps")
    parser.add_argument("--map", type=Path, help="map bundle instead of the paper's city; needs --dataset")
    parser.add_argument("--dataset", type=Path, help="dataset with the queries for --map")
    parser.add_argument("--queries", default=QUERIES, help="query set")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of each round, seconds")
    parser.add_argument("--rounds", type=int, default=3, help="rounds of each measurement")
    parser.add_argument("--soak-minutes", type=float, default=JUDGED_MINUTES, help="length of the soak, minutes")
    parser.add_argument(
        "--soak-rate",
        type=float,
        help=(
            "image pairs per second in the soak, if other work shares the machine; default: 60 %% of what one core "
            "answers"
        ),
    )
    parser.add_argument(
        "--only",
        nargs="+",
        help="parts: ratios decoding tail overload swap sigterm sizes hostile memory both_cores peers soak native sanitizers",
    )
    parser.add_argument(
        "--peers", nargs="+", default=PEERS, choices=PEERS, help="other servers of the pipeline to measure"
    )
    arguments = parser.parse_args()
    told = " ".join(sys.argv[1:])
    report = Report("serving", "make bench-serving" + (f' ARGS="{told}"' if told else ""))
    if arguments.only:
        report.keep_others()
    core, seconds = SERVED_CORE, arguments.seconds
    parts: dict[str, Callable[[], object]] = {
        "ratios": lambda: ratio_rows(report, site, seconds=seconds, rounds=arguments.rounds, core=core),
        "decoding": lambda: decoding_rows(report, site, rounds=5 * arguments.rounds),
        "tail": lambda: tail_rows(report, site, seconds=seconds, rounds=arguments.rounds, core=core),
        "overload": lambda: overload_rows(report, site, seconds=6 * seconds, rounds=arguments.rounds, core=core),
        "swap": lambda: swap_rows(report, site, core=core),
        "sigterm": lambda: sigterm_rows(report, site, core=core),
        "sizes": lambda: size_rows(report, site, core=core),
        "hostile": lambda: hostile_rows(report, site, core=core),
        "memory": lambda: memory_rows(report, site),
        "both_cores": lambda: ratio_rows(report, site, seconds=seconds, rounds=1, core=None, suffix=".both_cores"),
        "peers": lambda: peer_rows(
            report, site, seconds=seconds, rounds=arguments.rounds, core=core, names=arguments.peers
        ),
        "soak": lambda: soak_rows(report, site, minutes=arguments.soak_minutes, rate=arguments.soak_rate, core=core),
        "native": lambda: native_rows(report, arguments.work),
        "sanitizers": lambda: sanitizer_rows(report),
    }
    if unknown := set(arguments.only or ()) - set(parts):
        parser.error(f"--only: {', '.join(sorted(unknown))}: choose from {', '.join(parts)}")
    if set(arguments.only or parts) - WITHOUT_A_MAP:
        site = site_from(arguments)
        counts = MapBundle.open(site.bundle, verify=False).manifest.counts
        report.notes["map"] = (
            f"Map {site.bundle.name}: {counts.places} places, {counts.views} views, {counts.cloud_points} points."
        )
        report.notes["requests"] = (
            f"{PAIRS} pairs of {site.queries}, 640x480 JPEG and 16-bit PNG; server on core {SERVED_CORE}, load on {LOADING_CORE}."
        )
    for name, part in parts.items():
        if arguments.only and name not in arguments.only:
            continue
        pin(0, None if name in {"both_cores", "memory", *WITHOUT_A_MAP} else LOADING_CORE)
        part()
        print(f"written: {report.write()}", flush=True)


if __name__ == "__main__":
    main()
