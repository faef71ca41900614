"""``make chaos``: disturb a running service at random and check its answers -> reports/serving.json.

Each step does one thing to a service with several workers. It sends a signal, kills a worker, opens slow connections,
aborts connections, fills the disk or changes the API keys. It also adds, removes, damages or half copies map versions,
or chooses one. After the step, REST and gRPC must answer a known query correctly, from the version that should serve.
Otherwise they must refuse with a clear error. All workers must agree. Other threads send requests meanwhile. The same
seed repeats the same steps.

Example: python -m benchmarks.chaos --seed 7 --steps 120
"""

import argparse
import signal
import sys
import time
from pathlib import Path

from benchmarks.chaos.asking import Pair
from benchmarks.chaos.disk import small_disk
from benchmarks.chaos.run import Chaos, Findings
from benchmarks.report import ROOT, Report
from benchmarks.serving.__main__ import QUERIES, site_from
from benchmarks.serving.ratios import Site

STEPS = 1000


def main() -> None:
    """Parse the arguments, do the steps and write the report; exit with 1 if anything was wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1, help="seed of the steps")
    parser.add_argument("--steps", type=int, default=STEPS, help="number of steps")
    parser.add_argument("--workers", type=int, default=3, help="worker processes of the service")
    parser.add_argument("--stop", action="store_true", help="stop at the first wrong, lost or differing answer")
    parser.add_argument("--no-report", action="store_true", help="do not change reports/serving.json")
    parser.add_argument(
        "--log", type=Path, default=ROOT / "out" / "chaos.log", help="file for the actions and the log of the service"
    )
    parser.add_argument("--work", type=Path, default=ROOT / "data" / "evaluate", help="folder of datasets and maps")
    parser.add_argument("--map", type=Path, help="map bundle instead of the paper's city; needs --dataset")
    parser.add_argument("--dataset", type=Path, help="dataset with the queries for --map")
    parser.add_argument("--queries", default=QUERIES, help="query set")
    arguments = parser.parse_args()
    site = site_from(arguments)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    print(f"seed {arguments.seed}, {arguments.steps} steps, {arguments.workers} workers, map {site.bundle}", flush=True)
    told = " ".join(sys.argv[1:])
    report = Report("serving", "make chaos" + (f' ARGS="{told}"' if told else ""))
    report.keep_others()
    began = time.monotonic()
    size = sum(path.stat().st_size for path in site.bundle.rglob("*") if path.is_file())
    arguments.log.parent.mkdir(parents=True, exist_ok=True)
    with small_disk(int(8 * size / 2**20) + 64) as disk, arguments.log.open("w", buffering=1) as log:
        chaos = Chaos(
            disk,
            site.bundle,
            pair_of(site),
            seed=arguments.seed,
            workers=arguments.workers,
            tell=lambda line: print(line, flush=True),
            log=lambda line: print(f"{time.strftime('%H:%M:%S')} {line}", file=log),
        )
        found = chaos.run(arguments.steps, stop_at_first=arguments.stop)
    print(f"{found.steps} steps in {(time.monotonic() - began) / 60:.1f} minutes, seed {found.seed}", flush=True)
    rows(report, found)
    if not arguments.no_report:
        print(f"written: {report.write()}", flush=True)
    sys.exit(1 if found.wrong or found.disagreements else 0)


def pair_of(site: Site) -> Pair:
    """Return the first query of the site.

    Args:
        site: map and queries.
    """
    return Pair(site.payloads(refine=True)[0], site.payloads(refine=False)[0])


def rows(report: Report, found: Findings) -> None:
    """Add the rows of a run.

    Args:
        report: collects the rows.
        found: findings of the run.
    """
    report.row("chaos.steps", found.steps, "count", bar=STEPS, n=found.answers)
    for name, told in (
        ("chaos.wrong_or_lost_answers", found.wrong),
        ("chaos.disagreements", found.disagreements),
    ):
        report.row(
            name, len(told), "count", bar=0, better="lower", n=found.answers, why=f"first: {told[0]}" if told else None
        )
    report.row("chaos.refusals", sum(found.refusals.values()), "count", n=found.answers)
    report.row("chaos.tracebacks", found.tracebacks, "count")
    report.notes["chaos"] = {
        "seed": found.seed,
        "disk": found.disk,
        "actions": dict(sorted(found.actions.items())),
        "refusals": dict(found.refusals),
        "wrong": found.wrong[:20],
        "disagreements": found.disagreements[:20],
    }


if __name__ == "__main__":
    main()
