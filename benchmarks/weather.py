"""Effect of the PCA-based weather filter on a survey in snow: flakes removed, structure lost, and recall of the map."""

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.report import Report
from benchmarks.runs import Runs, share
from model_training.datasets.dataset import Dataset
from model_training.mapping.settings import BuildSettings
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.training.recipe import EVALUATION_SEEDS
from service.imaging.weather import remove_weather_noise

#: A return of the snowy scan counts as a flake if the clear scan from the same pose has no point within the first
#: distance. The second distance limits the test to ranges with dense beams.
FLAKE_APART_M, JUDGED_M = 0.5, 20.0
SCANS = 100


def snow_plan(survey_condition: str) -> SimulationPlan:
    """Plan a small unseen city with a survey in snow or on a clear day; the queries are of a clear day.

    Args:
        survey_condition: ``snow`` or ``clear``.
    """
    queries = (QueryPlan(name="drive1", traversal=1, count=250, depths=("precise",)),)
    return SimulationPlan(
        name=f"survey-in-{survey_condition}",
        seed=EVALUATION_SEEDS[10],
        size_m=(200.0, 260.0),
        survey_condition=survey_condition,
        queries=queries,
    )


def removed_and_lost(snow: Dataset, clear: Dataset) -> tuple[float, float, int]:
    """Return the share of flakes that the filter removes, the share of structure that it loses, and the number of flakes.

    Args:
        snow: dataset surveyed in snow.
        clear: the same dataset surveyed on a clear day.
    """
    flakes = removed = structure = lost = 0
    for number in np.linspace(0, len(snow.survey_poses()) - 1, SCANS).astype(int):
        points = snow.scan(int(number))[:, :3]
        keep = remove_weather_noise(points)
        judged = np.linalg.norm(points, axis=1) < JUDGED_M
        apart, _ = cKDTree(clear.scan(int(number))[:, :3]).query(points, distance_upper_bound=FLAKE_APART_M)
        flake = judged & np.isinf(apart)
        flakes, removed = flakes + int(flake.sum()), removed + int((flake & ~keep).sum())
        structure, lost = structure + int((judged & ~flake).sum()), lost + int((judged & ~flake & ~keep).sum())
    return removed / flakes, lost / structure, flakes


def weather_rows(report: Report, runs: Runs) -> None:
    """Add the effect of ``build-map --remove-weather`` on a snowy survey, beside the clear day's figures.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    clear, snow = (runs.dataset(snow_plan(condition)) for condition in ("clear", "snow"))
    removed, lost, flakes = removed_and_lost(snow, clear)
    report.row("weather.snow.flakes_removed", removed, "share", n=flakes)
    report.row("weather.snow.structure_lost", lost, "share", better="lower")
    for row, dataset, remove in (("clear", clear, False), ("snow", snow, False), ("snow_filtered", snow, True)):
        settings = BuildSettings(name=f"{dataset.name}{'-filtered' if remove else ''}", remove_weather=remove)
        figures = runs.figures(runs.bundle(dataset, settings), dataset, ["drive1_precise"])
        share(report, f"weather.survey_{row}.recall_at_1_5m", figures, "recall_at_1_5m")
