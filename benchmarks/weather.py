"""What PCA-based removal of weather noise does to a survey driven in snow: flakes taken out, structure lost, recall of the map."""

import numpy as np

from benchmarks.report import Report
from benchmarks.runs import Runs, share
from model_training.datasets.dataset import Dataset
from model_training.mapping.build import BuildSettings
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.training.recipe import EVALUATION_SEEDS
from service.imaging.weather import remove_weather_noise

FLAKE_INTENSITY = 0.05  # what the simulator gives every return from a flake; structure hits it by chance only
SCANS = 100


def snow_plan(survey_condition: str) -> SimulationPlan:
    """A small unseen city, surveyed in snow or on a clear day; queries are of a clear day."""
    queries = (QueryPlan(name="drive1", traversal=1, count=250, depths=("precise",)),)
    return SimulationPlan(
        name=f"survey-in-{survey_condition}", seed=EVALUATION_SEEDS[10], size_m=(200.0, 260.0), survey_condition=survey_condition,
        queries=queries,
    )  # fmt: skip


def removed_and_lost(dataset: Dataset) -> tuple[float, float, int]:
    """Share of flakes that the filter takes out, share of structure that it takes with them, and number of flakes."""
    flakes = removed = structure = lost = 0
    for number in np.linspace(0, len(dataset.survey_poses()) - 1, SCANS).astype(int):
        points = dataset.scan(int(number))
        flake = np.isclose(points[:, 3], FLAKE_INTENSITY, atol=1e-6)
        keep = remove_weather_noise(points[:, :3])
        flakes, removed = flakes + int(flake.sum()), removed + int((flake & ~keep).sum())
        structure, lost = structure + int((~flake).sum()), lost + int((~flake & ~keep).sum())
    return removed / flakes, lost / structure, flakes


def weather_rows(report: Report, runs: Runs) -> None:
    """The effect of ``build-map --remove-weather`` on a snowy survey, beside the clear day's."""
    clear, snow = (runs.dataset(snow_plan(condition)) for condition in ("clear", "snow"))
    removed, lost, flakes = removed_and_lost(snow)
    report.row("weather.snow.flakes_removed", removed, "share", n=flakes)
    report.row("weather.snow.structure_lost", lost, "share", better="lower")
    for row, dataset, remove in (("clear", clear, False), ("snow", snow, False), ("snow_filtered", snow, True)):
        settings = BuildSettings(name=f"{dataset.name}{'-filtered' if remove else ''}", remove_weather=remove)
        figures = runs.figures(runs.bundle(dataset, settings), dataset, ["drive1_precise"])
        share(report, f"weather.survey_{row}.recall_at_1_5m", figures, "recall_at_1_5m")
