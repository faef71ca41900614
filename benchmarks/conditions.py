"""Hard conditions, each next to the clear day's traversal of the same city."""

from collections.abc import Iterator
from typing import Any

from benchmarks.plans import (
    SEQUENCE,
    SPARSE_M,
    hard_plan,
    lidar_16_plan,
    lidar_os0_plan,
    unseen_plan,
    vehicle_ahead_plan,
)
from benchmarks.report import Report
from benchmarks.runs import Runs, accepted_within, share, within
from model_training.datasets.dataset import Dataset
from model_training.mapping.settings import BuildSettings
from model_training.simulation.hard import HARD, WEATHER_AND_LIGHT
from service.maps.reader import MapBundle

BARS = {"blocked_50": 0.75, "depth_15m": 0.88} | dict.fromkeys(WEATHER_AND_LIGHT, 0.97)
BAR = 0.95


#: A condition with its map, dataset and query set.
Asked = tuple[str, MapBundle, Dataset, str]


def asked_of(runs: Runs) -> Iterator[Asked]:
    """Yield the clear day, every condition of the queries, and every condition of the survey.

    Args:
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    dataset = runs.dataset(hard_plan())
    city = runs.bundle(runs.dataset(unseen_plan(0)))  # hard_plan has the seed of this city
    for name in ("clear", *HARD):
        yield name, city, dataset, f"{name}_precise"
    behind = runs.dataset(vehicle_ahead_plan())
    for map_of, bundle in (("", city), ("_also_of_survey", runs.bundle(behind))):
        yield f"vehicle_ahead{map_of}", bundle, behind, "vehicle_ahead_precise"
        yield f"vehicle_ahead{map_of}_stereo", bundle, behind, "vehicle_ahead_stereo"
    yield (
        "survey_5m",
        runs.bundle(dataset, BuildSettings(name="hard-survey-5m", spacing_m=SPARSE_M)),
        dataset,
        "clear_precise",
    )
    beams = runs.dataset(lidar_16_plan())
    yield "lidar_16", runs.bundle(beams), beams, "clear_precise"
    tall = runs.dataset(lidar_os0_plan())
    bundle = runs.bundle(tall, BuildSettings(name=tall.name, spacing_m=SPARSE_M))
    yield "lidar_os0_5m", bundle, dataset, "clear_precise"


def condition_rows(report: Report, runs: Runs) -> None:
    """Add rows for each condition, and for depth that ends at 15 m with five frames.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    for name, bundle, dataset, queries in asked_of(runs):
        bar = None if name == "clear" else BARS.get(name, BAR)
        _rows(report, name, runs.figures(bundle, dataset, [queries], refine=True), bar)
    city, dataset = runs.bundle(runs.dataset(unseen_plan(0))), runs.dataset(hard_plan())
    found = runs.predictions(city, dataset, "depth_15m_sequence5_precise", frames_each=SEQUENCE)
    report.share("full.condition.depth_15m_sequence5.within_1_m", accepted_within(found, 1.0), bar=0.99)
    report.share("full.condition.depth_15m_sequence5.forced_within_1_m", within(found, 1.0))


def _rows(report: Report, name: str, figures: dict[str, Any], bar: float | None) -> None:
    """Add the share of correct accepted answers, and the losses by retrieval, by later steps and by confidence."""
    (answers,) = figures["predictions"].values()
    row = f"full.condition.{name}"
    share(report, f"{row}.within_1_m", figures, "within_1_m", bar)
    for key in ("recall_at_1_5m", "recall_at_10_5m"):
        share(report, f"{row}.{key}", figures, key)
    report.row(f"{row}.forced_within_1_m", Runs.forced_within(answers, 1.0), "share", n=figures["queries"])
