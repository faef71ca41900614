"""Surveys of different density: a scan every 1, 2, 5 and 10 m in one pass, every 5 and 10 m in two, and a map of a single scan."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.plans import BOTH, unseen_plan
from benchmarks.report import Report
from benchmarks.runs import SIMULATION, Runs, accepted_within, code_hash, within
from benchmarks.second_pass import second_pass, updated
from model_training.datasets.dataset import Dataset, QueryFrame, Transforms
from model_training.evaluation.predict import Predictions, joined
from model_training.mapping.settings import BuildSettings
from service.maps.reader import MapBundle

#: Spacings of ``build-map``. It takes a scan from nine tenths of the spacing on, so 10 m takes every ninth of these scans, 1 m apart.
SPACINGS_M = (1.0, 2.0, 5.0, 10.0)
#: Those of them that are also measured with a second pass on another day. Its scans are as far apart as the first of these says.
TWO_PASSES_M = (5.0, 10.0)
#: Number of maps of a single scan. Their scans are spread over the survey. Queries within NEAR_M of the scan are asked.
SINGLE_SCANS, NEAR_M = 25, 5.0


class OneScan(Dataset):
    """A dataset whose survey is a single scan, with the queries near it.

    Args:
        folder: folder of the dataset.
        number: number of the scan.
    """

    def __init__(self, folder: Path, number: int) -> None:
        super().__init__(folder)
        self._number = number

    def survey_poses(self) -> Transforms:
        """Return T_map_lidar of the scan (1, 4, 4), metres."""
        return super().survey_poses()[[self._number]]

    def scan(self, number: int) -> NDArray[np.float32]:
        """Return the scan (n, 4): x, y, z in the LiDAR frame (m) and intensity.

        Args:
            number: 0.
        """
        return super().scan(self._number + number)

    def queries(self, name: str) -> Iterator[QueryFrame]:
        """Yield the frames of a query set that are within ``NEAR_M`` of the scan.

        Args:
            name: name of the query set.
        """
        (T_map_lidar,) = self.survey_poses()
        for frame in super().queries(name):
            T = frame.T_map_camera
            if T is not None and np.hypot(*(T[:2, 3] - T_map_lidar[:2, 3])) <= NEAR_M:
                yield frame


def survey_rows(report: Report, runs: Runs) -> None:
    """Add the rows of each survey and depth camera: accepted and right, right when forced, accepted and wrong.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    survey, one_pass = runs.dataset(unseen_plan(0)), dict[float, MapBundle]()
    for spacing_m in SPACINGS_M:
        one_pass[spacing_m] = runs.bundle(survey, BuildSettings(name=f"survey-{spacing_m:g}-m", spacing_m=spacing_m))
        for preset in BOTH:
            found = runs.predictions(one_pass[spacing_m], survey, _queries(preset))
            _rows(report, f"survey.every_{spacing_m:g}_m.{preset}", found)
    again = _second_pass(runs, survey)
    for spacing_m in TWO_PASSES_M:
        bundle = updated(runs, one_pass[spacing_m], again, f"survey-two-passes-{spacing_m:g}-m")
        for preset in BOTH:
            _rows(
                report,
                f"survey.two_passes_{spacing_m:g}_m.{preset}",
                runs.predictions(bundle, survey, _queries(preset)),
            )
    near: dict[str, list[Predictions]] = {preset: [] for preset in BOTH}
    for number in np.linspace(0, len(survey.survey_poses()) - 1, SINGLE_SCANS).round().astype(int):
        single = OneScan(survey.folder, int(number))
        if any(True for _ in single.queries(_queries(BOTH[0]))):
            bundle = runs.bundle(single, BuildSettings(name=f"single-scan-{number}"))
            for preset in BOTH:
                near[preset].append(runs.predictions(bundle, single, _queries(preset)))
    for preset in BOTH:
        _rows(report, f"survey.single_scan.{preset}", joined(near[preset]))


def _second_pass(runs: Runs, survey: Dataset) -> Dataset:
    plan = unseen_plan(0).model_copy(update={"spacing_m": TWO_PASSES_M[0]})
    code = code_hash(*SIMULATION, "benchmarks/second_pass.py")
    return second_pass(survey, plan, runs.work / f"{plan.name}-second-pass-{code}")


def _queries(preset: str) -> str:
    return f"drive1_{preset}"


def _rows(report: Report, row: str, found: Predictions) -> None:
    right = within(found, 1.0)
    report.share(f"{row}.within_1_m", accepted_within(found, 1.0))
    report.share(f"{row}.forced_within_1_m", right)
    report.share(f"{row}.wrong_and_accepted", found.localized & ~right, better="lower")
