"""Run every method of the comparison on the shared data; each keeps its answers, so a stop costs one method at most."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.paper.data import PaperData, test_set
from benchmarks.paper.kept import SPLITS, MethodResult
from benchmarks.paper.ours import bundle_of, streetfix, streetfix_stock
from model_training.cli.progress import bars
from model_training.evaluation.error_measures import distance_errors
from model_training.evaluation.raw_range import raw_best_views
from model_training.stock import ENCODER
from research.baselines import dual
from research.baselines.answers import PlaceAnswers
from research.baselines.dual.learn import Kind
from research.baselines.learning import read_curve
from research.baselines.paper.knn import KS, PAPER_K
from research.baselines.paper.variants import PLANS, Variant, VariantAnswers, run_variant, street_accuracy
from research.baselines.regression.locate import STAGES
from research.baselines.regression.run import run as run_regression
from research.baselines.scan_context import locate


@dataclass(frozen=True)
class Bench:
    """Shared settings of all methods.

    Attributes:
        data: shared data.
        budget_s: training budget of each learned method, processor seconds.
        kept: folder of the results.
    """

    data: PaperData
    budget_s: float
    kept: Path


def paper_variant(bench: Bench, name: str) -> list[MethodResult]:
    """Run one variant of the paper's method; return the results of K-NN and of softmax.

    Args:
        bench: shared settings.
        name: name of the variant.
    """
    data = bench.data
    with bars() as report:
        variant = run_variant(
            name,
            data.frames,
            data.pairs,
            data.tests,
            data.other_lidar,
            data.work / "runs" / "cnn",
            budget_s=bench.budget_s,
            report=report,
        )
    extra = {"asked": {key: metrics_of(each) for key, each in variant.answers_by_set.items()}}
    shown = data.size.frames + (data.size.pairs if PLANS[name].pairs_too else 0)

    def result(method: str, answers: Mapping[str, PlaceAnswers], extra: dict[str, Any]) -> MethodResult:
        return MethodResult(
            f"{method}_{name}", answers, variant.processor_s, variant.images, shown, variant.ended, variant.curve, extra
        )

    return [
        result("cnn_knn", {split: variant.answers_by_set[split].knn[PAPER_K] for split in SPLITS}, extra),
        result(
            "cnn_softmax",
            {split: variant.answers_by_set[split].softmax for split in SPLITS},
            {"aside": _aside(variant)},
        ),
    ]


def _aside(variant: Variant) -> float:
    answered = variant.answers_by_set["aside"]
    return street_accuracy(answered.softmax, answered)


def metrics_of(answered: VariantAnswers) -> dict[str, Any]:
    """Return street accuracy and mean distance (m) of softmax, and of K-NN by k.

    Args:
        answered: answers of a variant with ground truth.
    """

    def both(answers: PlaceAnswers) -> list[float]:
        return [street_accuracy(answers, answered), float(distance_errors(answers.xy, answered.truth_xy).mean())]

    return {
        "kind": answered.kind,
        "n": len(answered.truth_street),
        "softmax": both(answered.softmax),
        "knn": {str(k): both(answered.knn[k]) for k in KS},
    }


def raw_range(bench: Bench) -> list[MethodResult]:
    """Run the raw range image at its best setting, chosen on pairs of the training traversal.

    Args:
        bench: shared settings.
    """
    data = bench.data
    bundle, answers = bundle_of(data, ENCODER), {}
    street = np.asarray(bundle.place_street, np.int64)
    xy = bundle.T_map_place[:, :2, 3]
    names = [test_set(split) for split in SPLITS]
    with bars() as report:
        chosen_on = raw_best_views(bundle, data.dataset, ["second_drive_precise"], every=12, report=report)
        places = {name: raw_best_views(bundle, data.dataset, [name], report=report) for name in names}
    frames = list(data.dataset.queries("second_drive_precise"))[::12]
    truth = np.array([f.T_map_camera[:2, 3] for f in frames if f.T_map_camera is not None])
    errors = {s: float(np.linalg.norm(xy[place] - truth, axis=1).mean()) for s, place in chosen_on.items()}
    best = min(errors, key=lambda s: errors[s])
    for split, name in zip(SPLITS, names, strict=True):
        place = places[name][best]
        seen = place >= 0
        answers[split] = PlaceAnswers(np.where(seen[:, None], xy[place], np.nan), np.where(seen, street[place], -1))
    return [MethodResult("raw_range", answers, extra={"setting": best, "training_drive_mean_m": errors})]


def scan_context(bench: Bench) -> list[MethodResult]:
    """Run Scan Context; its settings come from another city.

    Args:
        bench: shared settings.
    """
    answers = {}
    for split, test in bench.data.tests.items():
        with bars() as report:
            answers[split] = locate(bench.data.frames, test, report=report)
    return [MethodResult("scan_context", answers)]


def dual_encoder(bench: Bench, kind: Kind) -> list[MethodResult]:
    """Run a dual encoder, without view alignment (``dual``) or with the camera's field of view (``fov``).

    Args:
        bench: shared settings.
        kind: kind of the encoder.
    """
    data, folder = bench.data, bench.data.work / "runs" / kind
    with bars() as report:
        found = dual.run(data.frames, data.pairs, data.tests, folder, kind=kind, budget_s=bench.budget_s, report=report)
    shown = data.size.frames + data.size.pairs
    curve = read_curve(found.curve)
    return [MethodResult(f"{kind}_encoder", found.answers, found.processor_s, found.images, shown, "budget", curve)]


def regression(bench: Bench) -> list[MethodResult]:
    """Run the paper's baseline; return results after each of its three stages. Both networks count as training.

    Args:
        bench: shared settings.
    """
    data, folder = bench.data, bench.data.work / "runs" / "regression"
    with bars() as report:
        found = run_regression(
            data.pairs, data.dataset.folder, data.tests, folder, budget_s=bench.budget_s, report=report
        )
    pose, lk = found.trainings["googlenet"], found.trainings["pointnet_lk"]
    later = {"pointnet_lk": [asdict(p) for p in read_curve(lk.curve)], "pointnet_lk_ended": lk.ended}
    results = []
    for stage in STAGES:
        costs = [pose] if stage == "googlenet" else [pose, lk]
        answers = {split: each[stage].places for split, each in found.answers.items()}
        results.append(
            MethodResult(
                stage,
                answers,
                sum(c.processor_s for c in costs),
                sum(c.images for c in costs),
                data.size.pairs,
                pose.ended,
                read_curve(pose.curve),
                later,
            )
        )
    return results


Method = Callable[[Bench], list[MethodResult]]
#: Methods by name, in the order of running: the quickest first.
RUNS: dict[str, Method] = {
    "streetfix": lambda bench: [streetfix(bench.data, bench.budget_s)],
    "streetfix_as_paper": lambda bench: [streetfix(bench.data, None)],
    "streetfix_stock": lambda bench: [streetfix_stock(bench.data)],
    "raw_range": raw_range,
    "scan_context": scan_context,
    "regression": regression,
    "dual": partial(dual_encoder, kind="dual"),
    "fov": partial(dual_encoder, kind="fov"),
}
RUNS |= {f"cnn_{name}": partial(paper_variant, name=name) for name in PLANS}
