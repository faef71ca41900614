"""Hard conditions: each with the clear day's drive through the same city beside it."""

from typing import Any

from benchmarks.plans import SEQUENCE, hard_plan, lidar_16_plan, unseen_plan
from benchmarks.report import Report
from benchmarks.runs import Runs, accepted_within, share
from model_training.mapping.build import BuildSettings
from model_training.simulation.hard import HARD, WEATHER_AND_LIGHT

BARS = {"blocked_50": 0.75, "depth_15m": 0.88} | dict.fromkeys(WEATHER_AND_LIGHT, 0.97)
BAR = 0.95


def condition_rows(report: Report, runs: Runs) -> None:
    """Every condition of the drive, of the survey, and depth that ends at 15 m with five frames."""
    dataset = runs.dataset(hard_plan())
    bundle = runs.bundle(runs.dataset(unseen_plan(0)))  # of the same city: hard_plan has its seed
    for name in ("clear", *HARD):
        bar = None if name == "clear" else BARS.get(name, BAR)
        _rows(report, name, runs.figures(bundle, dataset, [f"{name}_precise"], refine=True), bar)
    sparse = runs.bundle(dataset, BuildSettings(name="hard-survey-5m", spacing_m=5.0))
    beams = runs.dataset(lidar_16_plan())
    for name, other, asked in (("survey_5m", sparse, dataset), ("lidar_16", runs.bundle(beams), beams)):
        _rows(report, name, runs.figures(other, asked, ["clear_precise"], refine=True), BAR)
    found = runs.predictions(bundle, dataset, "depth_15m_sequence5_precise", frames_each=SEQUENCE)
    report.share("full.condition.depth_15m_sequence5.within_1_m", accepted_within(found, 1.0), bar=0.99)


def _rows(report: Report, name: str, figures: dict[str, Any], bar: float | None) -> None:
    """What was right and accepted, and where the rest was lost: by retrieval, by what follows it, or by doubt."""
    (answers,) = figures["predictions"].values()
    row = f"full.condition.{name}"
    share(report, f"{row}.within_1_m", figures, "within_1_m", bar)
    share(report, f"{row}.recall_at_10_5m", figures, "recall_at_10_5m")
    report.row(f"{row}.forced_within_1_m", Runs.forced_within(answers, 1.0), "share", n=figures["queries"])
