"""``make choices``: measure each design choice in a validation city -> reports/choices.json.

No training and no bar uses this city. The command trains encoders for a few hundred steps, each with one change.
Compare their figures with each other, not with the stock encoder's. The command keeps runs under ``--work`` and
continues after a stop.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.choices.registration import registration_rows
from benchmarks.choices.trainings import VARIATIONS, trained
from benchmarks.choices.validation_city import Seen, ValidationCity, validation_plan
from benchmarks.report import ROOT, Report
from benchmarks.runs import Runs
from model_training.cli.progress import bars
from model_training.stock import ENCODER
from service.imaging.view_grid import ViewGrid
from service.retrieval.encoder import Encoder
from service.retrieval.hypotheses import ClusterSettings
from service.retrieval.knn import similarity_weights

STEPS = 1000
KS = (1, 3, 5, 9, 15, 21)
#: Views per place, of the 24 that a map has.
FANS = (24, 12, 8, 4, 2)


def encoder_rows(report: Report, city: ValidationCity, seen: dict[str, Seen]) -> None:
    """Add R@1 and R@10 of every variation.

    Args:
        report: collects the rows.
        city: places and queries of the validation city.
        seen: descriptors by variation.
    """
    for name, each in seen.items():
        for queries in city.sets:
            preset, similarity = queries.rpartition("_")[2], each.similarity(queries)
            report.share(f"choices.{name}.{preset}.recall_at_1_5m", city.right(queries, similarity))
            report.share(f"choices.{name}.{preset}.recall_at_10_5m", city.right(queries, similarity, first=10))


def fan_rows(report: Report, city: ValidationCity, stock: Seen) -> None:
    """Add rows for fewer views per place, counted from the principal heading (PCA) or from the map's x axis.

    Args:
        report: collects the rows.
        city: places and queries of the validation city.
        stock: descriptors of the stock encoder.
    """
    places, headings, size = stock.views.shape
    turns = np.arange(headings)
    for count in FANS:
        from_pca = np.broadcast_to(turns % (headings // count) == 0, (places, headings))
        fans = {"pca": from_pca}
        if count < headings:
            fans["fixed"] = _nearest_to_fixed(city.headings_rad, count)
        for kind, allowed in fans.items():
            row = f"choices.headings.{count}_{kind}"
            report.row(f"{row}.index_mib", places * count * size * 4 / 2**20, "MiB", better="lower", n=places * count)
            for queries in city.sets:
                right = city.right(queries, stock.similarity(queries, allowed))
                report.share(f"{row}.{queries.rpartition('_')[2]}.recall_at_1_5m", right)


def _nearest_to_fixed(headings_rad: NDArray[np.float64], count: int) -> NDArray[np.bool_]:
    """Select, for each place, the view nearest to each of ``count`` headings of the map frame: a mask (P, headings)."""
    wanted = 2 * np.pi * np.arange(count) / count
    away = np.abs(np.angle(np.exp(1j * (headings_rad[:, :, None] - wanted))))
    allowed = np.zeros(headings_rad.shape, bool)
    np.put_along_axis(allowed, away.argmin(axis=1), values=True, axis=1)
    return allowed


def neighbour_rows(report: Report, city: ValidationCity, stock: Seen) -> None:
    """Add street accuracy by the vote of the k most similar places, weighted by similarity as in the service.

    Args:
        report: collects the rows.
        city: places and queries of the validation city.
        stock: descriptors of the stock encoder.
    """
    place_street, true_street = city.streets()
    for queries in city.sets:
        similarity = stock.similarity(queries)
        ranked = np.argsort(-similarity, axis=1, kind="stable")
        known = true_street[queries] >= 0
        for k in KS:
            voted = np.array(
                [_vote(place_street[places[:k]], of[places[:k]]) for places, of in zip(ranked, similarity, strict=True)]
            )
            right = (voted == true_street[queries])[known]
            report.share(f"choices.k.{k}.{queries.rpartition('_')[2]}.street_accuracy", right)


def _vote(streets: NDArray[np.int64], similarity: NDArray[np.float32]) -> int:
    weights = similarity_weights(similarity.astype(np.float64), ClusterSettings().temperature)
    return int(np.argmax(np.bincount(streets + 1, weights))) - 1


def main() -> None:
    """Parse the arguments, train, measure and write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=ROOT / "data" / "choices", help="folder of cities and runs")
    parser.add_argument("--steps", type=int, default=STEPS, help="steps of each training")
    parser.add_argument("--only", nargs="+", metavar="NAME", help=f"variations of: {' '.join(VARIATIONS)}")
    parser.add_argument(
        "--train",
        action="store_true",
        help="train and stop; two calls with different --only can so run at the same time",
    )
    arguments = parser.parse_args()
    if unknown := set(arguments.only or ()) - set(VARIATIONS):
        parser.error(f"--only: {', '.join(sorted(unknown))}: choose from {', '.join(VARIATIONS)}")
    told = " ".join(sys.argv[1:])
    report = Report("choices", "make choices" + (f' ARGS="{told}"' if told else ""))
    if arguments.only:
        report.keep_others()
    runs, names = Runs(arguments.work, ENCODER), arguments.only or list(VARIATIONS)
    with bars() as show:
        files = {name: trained(name, arguments.work, arguments.steps, show) for name in names}
    if arguments.train:
        return
    dataset = runs.dataset(validation_plan())
    city = ValidationCity(dataset, ViewGrid())
    encoders = {name: (Encoder.open(file), VARIATIONS[name].blind) for name, file in files.items()}
    with bars() as show:
        seen = city.seen_by(encoders | {"stock": (Encoder.open(ENCODER), ())}, show)
    encoder_rows(report, city, seen)
    fan_rows(report, city, seen["stock"])
    neighbour_rows(report, city, seen["stock"])
    registration_rows(report, runs, dataset)
    report.notes["trainings"] = (
        f"{arguments.steps} steps of 128 pairs each, in half precision where the processor has it, one round; the validation city's "
        f"{len(city.kept)} places with {city.settings.headings} views; `stock` is the shipped encoder."
    )
    print(f"written: {report.write()}")


if __name__ == "__main__":
    main()
