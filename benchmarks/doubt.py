"""Quality of the confidence: queries of another city, of streets that the map lacks, and images without a street."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.full import unseen_answers
from benchmarks.plans import BOTH, hard_plan, more_plan, unseen_plan
from benchmarks.report import Report
from benchmarks.runs import Runs
from model_training.calibration.fit import expected_calibration_error
from model_training.datasets.without_streets import WithoutStreets
from model_training.evaluation.predict import Predictions, joined
from model_training.mapping.settings import BuildSettings
from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.depth_noise import DEPTHS, measured_depth
from model_training.simulation.hard import HARD
from service.errors import NoDepthError
from service.geometry.camera import PinholeCamera
from service.localization.localizer import Localizer
from service.maps.calibration import RIGHT_M
from service.retrieval.query import Query

#: Cities whose maps are built again without every second street.
PARTIAL = (0, 1, 2)
#: Shares of accepted out-of-map queries at which the curves are given.
ACCEPTED = (0.0, 0.001, 0.002, 0.003, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.5, 1.0)
#: Draws one image: depth (z, metres, 0 for none) and grey level.
Picture = Callable[[np.random.Generator], tuple[NDArray[np.float64], NDArray[np.float64]]]
FALSE_BARS = {
    ("other_city", "precise"): 0.003,
    ("removed_streets", "precise"): 0.005,
    ("other_city", "stereo"): 0.02,
    ("removed_streets", "stereo"): 0.03,
}


@dataclass(frozen=True)
class Strangers:
    """Out-of-map queries: confidence of each, and whether the default accepts it.

    Attributes:
        confidence: confidence (N,).
        accepted: accepted by default (N,).
    """

    confidence: NDArray[np.float64]
    accepted: NDArray[np.bool_]

    @staticmethod
    def of(answers: Predictions) -> "Strangers":
        """Take confidence and status of answers; no answer counts as confidence 0.

        Args:
            answers: answers to out-of-map queries.
        """
        return Strangers(np.nan_to_num(answers.confidence), answers.localized)


def confidence_and_right(answers: Predictions) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return confidence (N,) and correctness (N,) of every query; no answer counts as confidence 0.

    Args:
        answers: answers with ground truth.
    """
    distance = np.linalg.norm(answers.T_answer[:, :2, 3] - answers.T_true[:, :2, 3], axis=1)
    return np.nan_to_num(answers.confidence), np.nan_to_num(distance, nan=np.inf) <= RIGHT_M


def doubt_rows(report: Report, runs: Runs) -> None:
    """Add false accepts by kind, calibration error and Brier score.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    inside: list[tuple[NDArray[np.float64], NDArray[np.bool_]]] = []
    outside: list[NDArray[np.float64]] = []
    own_of: dict[str, tuple[NDArray[np.float64], NDArray[np.bool_]]] = {}
    strangers: dict[str, Strangers] = {}
    for preset in BOTH:
        own = unseen_answers(runs, preset)
        confidence, right = confidence_and_right(joined(own))
        own_of[preset] = confidence, right
        other = Strangers.of(_of_another_city(runs, preset))
        _false_rows(report, f"doubt.other_city.{preset}", other, confidence, right, FALSE_BARS["other_city", preset])
        away, near, near_right = _where_streets_are_missing(runs, preset)
        _false_rows(
            report, f"doubt.removed_streets.{preset}", away, near, near_right, FALSE_BARS["removed_streets", preset]
        )
        strangers |= {f"other_city.{preset}": other, f"removed_streets.{preset}": away}
        take = np.random.default_rng(5).permutation(len(confidence))[: 1000 if preset == "stereo" else 500]
        inside.append((confidence[take], right[take]))
        outside += [other.confidence[:500], away.confidence[:500]]
    inside.append(_hard(runs, 500))
    confidence = np.concatenate([*(c for c, _ in inside), *outside])
    right = np.concatenate([*(r for _, r in inside), *(np.zeros(len(c), bool) for c in outside)])
    error = expected_calibration_error(confidence, right)
    report.row("doubt.expected_calibration_error", error, "share", bar=0.02, better="lower", n=len(right))
    report.row("doubt.brier_score", float(np.mean((confidence - right) ** 2)), "share", better="lower", n=len(right))
    localizer = Localizer.open(runs.bundle(runs.dataset(unseen_plan(0))))
    for preset in BOTH:
        for kind, queries in nonsense(np.random.default_rng(6), preset).items():
            found = Strangers(*map(np.array, zip(*(_told(localizer, query) for query in queries), strict=True)))
            _false_rows(report, f"doubt.{kind}.{preset}", found, *own_of[preset])
            strangers[f"{kind}.{preset}"] = found
    _reliability(report, confidence, right)
    report.notes["accepts"] = {
        name: curve(*own_of[name.rpartition(".")[2]], found.confidence) for name, found in strangers.items()
    }


def _of_another_city(runs: Runs, preset: str) -> Predictions:
    """Answer the second city's queries by the first city's map."""
    bundle = runs.bundle(runs.dataset(unseen_plan(0)))
    first = runs.figures(bundle, runs.dataset(unseen_plan(1)), [f"drive1_{preset}"], refine=True)["predictions"]
    second = runs.figures(bundle, runs.dataset(more_plan(1)), [f"drive3_{preset}"], refine=True)["predictions"]
    return joined([*first.values(), *second.values()])


def _where_streets_are_missing(runs: Runs, preset: str) -> tuple[Strangers, NDArray[np.float64], NDArray[np.bool_]]:
    """Answer by maps without every second street: the queries outside, then confidence and correctness of those inside."""
    away, near, right = [], [], []
    for index in PARTIAL:
        dataset, more = runs.dataset(unseen_plan(index)), runs.dataset(more_plan(index))
        partial = WithoutStreets(dataset.folder, each=2)
        bundle = runs.bundle(partial, BuildSettings(name=f"{dataset.name}-without-streets"))
        for asked, name in ((dataset, f"drive1_{preset}"), (more, f"drive3_{preset}")):
            answers = runs.figures(bundle, asked, [name], refine=True)["predictions"][name]
            outside = partial.is_outside(answers.T_true[:, :2, 3])
            confidence, is_right = confidence_and_right(answers)
            away.append(answers.of(outside))
            near.append(confidence[~outside])
            right.append(is_right[~outside])
    return Strangers.of(joined(away)), np.concatenate(near), np.concatenate(right)


def _hard(runs: Runs, count: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    dataset = runs.dataset(hard_plan())
    bundle = runs.bundle(runs.dataset(unseen_plan(0)))
    names = [f"{name}_precise" for name in HARD]
    answers = runs.figures(bundle, dataset, names, refine=True)["predictions"]
    confidence, right = confidence_and_right(joined([answers[name] for name in names]))
    take = np.linspace(0, len(right) - 1, count).astype(int)
    return confidence[take], right[take]


def _false_rows(
    report: Report,
    row: str,
    negative: Strangers,
    confidence: NDArray[np.float64],
    right: NDArray[np.bool_],
    bar: float | None = None,
) -> None:
    level = float(np.quantile(confidence[right], 0.05))
    count = len(negative.confidence)
    report.share(f"{row}.false_accepts_at_95", negative.confidence >= level, bar=bar, better="lower")
    report.share(f"{row}.accepted_by_default", negative.accepted, better="lower")
    report.row(f"{row}.average_precision", average_precision(confidence, right, negative.confidence), "share", n=count)


def curve(
    confidence: NDArray[np.float64], right: NDArray[np.bool_], negative: NDArray[np.float64]
) -> list[tuple[float, float]]:
    """Return, for each share of ``ACCEPTED``, the share of queries that are accepted and correct.

    The share is the largest share of out-of-map queries that a threshold may accept.

    Args:
        confidence: confidence of the queries (N,).
        right: their correctness (N,).
        negative: confidence of the out-of-map queries (M,).
    """
    falling = np.sort(negative)[::-1]
    refused = [falling[int(share * len(falling) + 1e-9)] if share < 1 else -np.inf for share in ACCEPTED]
    return [
        (share, round(float((right & (confidence > level)).mean()), 4))
        for share, level in zip(ACCEPTED, refused, strict=True)
    ]


def average_precision(
    confidence: NDArray[np.float64], right: NDArray[np.bool_], negative: NDArray[np.float64]
) -> float:
    """Return the average precision of accepts: correct answers against answers to out-of-map queries.

    Args:
        confidence: confidence of the queries (N,).
        right: their correctness (N,).
        negative: confidence of the out-of-map queries (M,).
    """
    score = np.concatenate([confidence[right], negative])
    true = np.r_[np.ones(int(right.sum()), bool), np.zeros(len(negative), bool)]
    true = true[np.lexsort((true, -score))]  # among equal confidences the false ones come first
    precision = np.cumsum(true) / np.arange(1, len(true) + 1)
    return float(precision[true].mean())


def _told(localizer: Localizer, query: Query) -> tuple[float, bool]:
    """Return the confidence, and whether the answer is accepted."""
    try:
        answer = localizer.localize(query)
    except NoDepthError:
        return 0.0, False
    return answer.confidence or 0.0, answer.status == "LOCALIZED"


def nonsense(rng: np.random.Generator, preset: str, count: int = 100) -> dict[str, list[Query]]:
    """Make queries that no street shows, as a depth camera of the preset measures them.

    Args:
        rng: source of randomness.
        preset: depth preset, a key of ``DEPTHS``.
        count: queries per kind.
    """
    drawn: dict[str, Picture] = {
        "indoor": _room,
        "blank_wall": _wall,
        "covered_lens": _covered,
        "sky": _sky,
        "noise": _noise,
    }
    return {kind: [_measured(rng, kind, one, preset) for _ in range(count)] for kind, one in drawn.items()}


_CAMERA = PinholeCamera(640, 480, 320.0, 320.0, 319.5, 239.5)
#: Kinds that draw stray measurements directly. The other kinds draw surfaces, which the simulated camera measures.
_STRAY = ("covered_lens", "sky")


def _measured(rng: np.random.Generator, kind: str, one: Picture, preset: str) -> Query:
    z, grey = one(rng)
    surfaces = np.zeros_like(z) if kind in _STRAY else z
    plain = np.full(z.shape, kind == "blank_wall")
    depth_m = measured_depth(surfaces.astype(np.float32), plain, DEPTHS[preset], CONDITIONS["clear"], rng)
    if kind in _STRAY:
        depth_m = np.where(z > 0, z, depth_m).astype(np.float32)
    rgb = np.repeat(np.clip(grey + rng.normal(0, 4, z.shape), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    return Query(rgb=rgb, depth_m=depth_m, camera=_CAMERA)


def _rays() -> NDArray[np.float64]:
    return _CAMERA.rays_of_pixels()


def _box_depth(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the depth of the inside of a box around the camera (optical frame)."""
    rays = _rays()
    with np.errstate(divide="ignore"):
        reach = np.where(rays > 0, high / rays, low / rays)
    depth: NDArray[np.float64] = np.where(np.isfinite(reach), reach, np.inf).min(axis=2)
    return depth


def _room(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw a room or a corridor with some furniture."""
    half, height = rng.uniform(1.2, 6.0), rng.uniform(2.4, 3.5)
    low = np.array([-half * rng.uniform(0.4, 1), -(height - 1.5), -1.0])
    high = np.array([half * rng.uniform(0.4, 1), 1.5, rng.uniform(3.0, 18.0)])
    z = _box_depth(low, high)
    for _ in range(int(rng.integers(2, 7))):
        rays, x, depth = _rays(), rng.uniform(low[0], high[0]), rng.uniform(1.5, high[2])
        width, top = rng.uniform(0.3, 1.5), rng.uniform(-0.5, 1.2)
        hit = (
            (np.abs(rays[..., 0] * depth - x) < width / 2) & (rays[..., 1] * depth > top) & (rays[..., 1] * depth < 1.5)
        )
        z = np.where(hit & (depth < z), depth, z)
    return z, 60 + 20 * z


def _wall(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw a wall in front of the camera, slightly rotated."""
    normal = np.array([np.sin(turn := rng.uniform(-0.6, 0.6)), 0.0, np.cos(turn)])
    z = rng.uniform(1.0, 6.0) / np.maximum((_rays() @ normal), 0.05)
    ground = np.where(_rays()[..., 1] > 1e-3, 1.5 / np.maximum(_rays()[..., 1], 1e-3), np.inf)
    return np.minimum(z, ground).clip(max=40.0), np.full(z.shape, rng.uniform(60, 200))


def _covered(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw a covered lens: no depth but some noise at short range."""
    z = np.where(rng.random((480, 640)) < 0.1, rng.uniform(0.2, 0.6, (480, 640)), 0.0)
    return z, np.full(z.shape, rng.uniform(0, 30))


def _sky(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw the sky: stray depth here and there."""
    z = np.where(rng.random((480, 640)) < 0.02, rng.uniform(5.0, 60.0, (480, 640)), 0.0)
    return z, np.full(z.shape, rng.uniform(150, 250))


def _noise(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw depth without any surface."""
    coarse = rng.uniform(1.0, 40.0, (30, 40))
    return coarse.repeat(16, axis=0).repeat(16, axis=1), rng.uniform(0, 255, (480, 640))


def _reliability(report: Report, confidence: NDArray[np.float64], right: NDArray[np.bool_]) -> None:
    """Add the points of the reliability diagram for the page of reports."""
    order = np.argsort(confidence, kind="stable")
    report.notes["reliability"] = [
        {
            "confidence": round(float(confidence[part].mean()), 4),
            "right": round(float(right[part].mean()), 4),
            "n": len(part),
        }
        for part in np.array_split(order, 15)
    ]
