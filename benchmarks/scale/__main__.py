"""``make bench-scale``: search in maps of up to a hundred towns, tiled maps, tiled builds, and object storage -> reports/scale.json.

The first run simulates two small cities and builds their maps, whose descriptors it keeps. A hundred towns need 7 GB of memory and
2 GB of disk. The part ``built`` kills builds and compares both engines. For the second row, install the extra ``ray``.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import ROOT, Report
from benchmarks.runs import SIMULATION, Runs, code_hash
from benchmarks.scale.built import built_rows, four_towns_row, timed_plan
from benchmarks.scale.drawn import DrawnViews
from benchmarks.scale.growth import growth_rows
from benchmarks.scale.search import SIZES, search_rows
from benchmarks.scale.served import served_rows
from benchmarks.scale.sources import RealDescriptors, real_descriptors, small_city
from benchmarks.scale.store import store_rows
from benchmarks.scale.town import open_rows, town_folder, town_plan, town_rows
from model_training.datasets.dataset import Dataset
from model_training.stock import ENCODER
from service.maps.index import vectors_of
from service.retrieval.encoder import Encoder

#: Parts of the report.
PARTS = ("search", "served", "built", "memory", "store", "town", "ready", "growth")
#: Code that determines the real descriptors.
_DESCRIBING = (*SIMULATION, "service/imaging", "benchmarks/scale/sources.py", "model_training/mapping/places.py")


def kept_descriptors(work: Path) -> RealDescriptors:
    """Return the real descriptors of the stock encoder, kept ones if there are any.

    Args:
        work: folder of datasets, maps and kept descriptors.
    """
    path = work / f"real-{code_hash(*_DESCRIBING)}-{Encoder.open(ENCODER).sha256[:12]}.npz"
    if not path.exists():
        real_descriptors(Runs(work, ENCODER)).save(path)
    return RealDescriptors.load(path)


def _similarity(queries: NDArray[np.float32], views: NDArray[np.float32]) -> float:
    """Return the median similarity of queries (Q, T, D) and views (Q, D), each at its best turn."""
    return float(np.median(np.einsum("qtd,qd->qt", queries, views).max(axis=1)))


def main() -> None:
    """Parse the arguments, measure and write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--work", type=Path, default=ROOT / "data" / "scale", help="folder of datasets, maps and index files"
    )
    parser.add_argument(
        "--sizes",
        nargs="+",
        type=int,
        default=SIZES,
        help="numbers of views, 10,000 or more; the rows of other sizes stay",
    )
    parser.add_argument(
        "--only",
        nargs="+",
        choices=PARTS,
        default=list(PARTS),
        help="what to measure: search in drawn maps, requests with a prior on a tiled map (served), tiled builds that are killed, and both "
        "engines (built), the memory that a build of four small towns takes (memory), a map in object storage (store), a town of 20 km, "
        "which takes an hour (town), the service that opens this town (ready; also part of town), retrieval in parts of this town (growth)",
    )
    parser.add_argument(
        "--stored",
        nargs=2,
        type=Path,
        metavar=("MAP", "DATASET"),
        help="map for the part store, and its dataset with queries; by default a small city",
    )
    arguments = parser.parse_args()
    if min(arguments.sizes) < 10_000:
        parser.error(f"--sizes: {min(arguments.sizes)} is too small; give 10000 or more")
    arguments.work.mkdir(parents=True, exist_ok=True)
    told = " ".join(_shown(argument) for argument in sys.argv[1:])
    report = Report("scale", "make bench-scale" + (f' ARGS="{told}"' if told else ""))
    if tuple(arguments.sizes) != SIZES or set(arguments.only) != set(PARTS):
        report.keep_others()
    if "search" in arguments.only:
        _search(report, arguments.work, tuple(sorted(arguments.sizes)))
    if "served" in arguments.only:
        served_rows(report, Runs(arguments.work, ENCODER), arguments.work)
        report.write()
    if "built" in arguments.only:
        built_rows(report, Runs(arguments.work, ENCODER))
        report.write()
    if "memory" in arguments.only:
        runs = Runs(arguments.work, ENCODER)
        four_towns_row(report, runs.dataset(timed_plan()), arguments.work / "tiles")
        report.write()
    if "store" in arguments.only:
        path, dataset = arguments.stored or small_city(Runs(arguments.work, ENCODER))
        store_rows(report, path, Dataset(dataset), arguments.work)
        report.write()
    if "town" in arguments.only:
        town_rows(report, Runs(arguments.work, ENCODER))
        report.write()
    after_town = [part for part in ("ready", "growth") if part in arguments.only]
    if after_town:
        runs = Runs(arguments.work, ENCODER)
        if not (folder := town_folder(runs)).exists():
            parser.error(f"--only {' '.join(after_town)}: needs the map of the town; add the part town")
        dataset = runs.dataset(town_plan())
        if "ready" in after_town and "town" not in arguments.only:
            open_rows(report, folder, dataset)
            report.write()
        if "growth" in after_town:
            growth_rows(report, folder, dataset)
            report.write()


def _shown(argument: str) -> str:
    """Return an argument for the report, which names no folder of this machine outside of the repository."""
    path = Path(argument)
    if not path.is_absolute():
        return argument
    return str(path.relative_to(ROOT)) if path.is_relative_to(ROOT) else f".../{path.name}"


def _search(report: Report, work: Path, sizes: tuple[int, ...]) -> None:
    real = kept_descriptors(work)
    whole = DrawnViews(real, len(real.views))
    asked = whole.queries(1_000)
    own = _similarity(real.queries, real.views[real.true_view])
    drawn = _similarity(asked.descriptors, vectors_of(whole[asked.true_view]))
    report.notes["maps"] = (
        f"Maps are drawn from {len(real.views)} real views and {len(real.queries)} real queries of simulated cities "
        "(`benchmarks/scale/drawn.py`). The similarity of a query to its own view is "
        f"{own:.3f} in these cities and {drawn:.3f} in drawn maps (median, best of three turns). Times are processor times of one thread."
    )
    search_rows(report, real, work, sizes)


if __name__ == "__main__":
    main()
