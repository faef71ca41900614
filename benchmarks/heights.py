"""Cameras at unusual heights above the ground, told and not told to the service."""

from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from benchmarks.plans import HEIGHTS_M, height_plan
from benchmarks.report import Report
from benchmarks.runs import Runs, accepted_within, within
from model_training.datasets.dataset import Dataset
from model_training.evaluation.predict import joined
from service.errors import DatasetError
from service.imaging.level import GivenHeight, level_query
from service.retrieval.query import Query

#: Standard deviation of a told height, metres: the simulated height of each query deviates from the mean by this.
STD_M = 0.1
#: Height of the survey's LiDAR above the ground, metres (``SimulationPlan.lidar_height_m``).
LIDAR_M = 1.8
_LEVEL = ("level_precise", "level_stereo")
#: Errors of camera heights, metres.
Errors = Float64[NDArray[np.float64], " n"]


def told(query: Query, *, height_m: float) -> Query:
    """Tell a query the mean height of its camera.

    Args:
        query: the query.
        height_m: mean height of the camera, metres.
    """
    return replace(query, camera_height=GivenHeight(height_m, STD_M))


def height_errors(dataset: Dataset, names: tuple[str, ...], *, told_m: float | None = None) -> Errors:
    """Return the error of the camera height that the service uses for each query, unsigned, metres.

    The true height is that above the ground at the nearest scan, along its vertical axis.

    Args:
        dataset: queries with ground truth.
        names: names of the query sets.
        told_m: mean height that the queries give, metres; None if the service must estimate it.

    Raises:
        DatasetError: a query has no true pose.
    """
    scans, errors = dataset.survey_poses(), []
    given = None if told_m is None else GivenHeight(told_m, STD_M)
    for frame in (frame for name in names for frame in dataset.queries(name)):
        T = frame.T_map_camera
        if T is None:
            raise DatasetError(f"{dataset.folder}: a query has no true pose", field="queries")
        nearest = scans[int(np.argmin(np.hypot(*(scans[:, :2, 3] - T[:2, 3]).T)))]
        true_m = float((T[:3, 3] - nearest[:3, 3]) @ nearest[:3, 2]) + LIDAR_M
        level, _ = level_query(frame.depth_m(), frame.camera.pinhole(), given=given)
        errors.append(abs(level.height_m - true_m))
    return np.array(errors)


def height_error_rows(report: Report, seen: dict[float, Errors], told: dict[float, Errors]) -> None:
    """Add the median errors of estimated and of given heights: of each height, of all, and the larger one of both.

    Args:
        report: collects the rows.
        seen: errors of estimated heights (n,) by mean height, metres.
        told: errors of given heights (n,) by mean height, metres.
    """
    medians = dict[str, float]()
    for case, label, errors in (("seen", "", seen), ("told", ".given", told)):
        for height_m, each in errors.items():
            row = f"height.{height_m:g}{label}.error_m"
            report.row(row, float(np.median(each)), "m", better="lower", n=len(each))
        every = np.concatenate(list(errors.values()))
        medians[case] = float(np.median(every))
        report.row(f"height.{case}_error_m", medians[case], "m", better="lower", n=len(every))
    worse = max(medians, key=lambda case: medians[case])
    report.row(
        "height.told_or_seen_error_m",
        medians[worse],
        "m",
        bar=0.05,
        better="lower",
        n=sum(len(each) for errors in (seen, told) for each in errors.values()),
        why=f"the larger one of height.seen_error_m and height.told_error_m: {worse}",
    )


def height_rows(report: Report, runs: Runs) -> None:
    """Add the rows of cameras at unusual heights: accuracy without and with a given height, and errors of the height in both cases.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    bundle, seen, told_errors = (
        runs.bundle(runs.dataset(height_plan(1.5))),
        dict[float, Errors](),
        dict[float, Errors](),
    )
    for height_m in HEIGHTS_M:
        dataset, row = runs.dataset(height_plan(height_m)), f"height.{height_m:g}"
        found = joined([runs.predictions(bundle, dataset, name) for name in _LEVEL])
        rig = ("told", partial(told, height_m=height_m))
        given = joined([runs.predictions(bundle, dataset, name, rig=rig) for name in _LEVEL])
        pitched = runs.predictions(bundle, dataset, "pitched_precise")
        report.share(f"{row}.within_1_m", accepted_within(found, 1.0), bar=0.95)
        report.share(f"{row}.given.within_1_m", accepted_within(given, 1.0), bar=0.97)
        report.share(f"{row}.forced_within_1_m", within(found, 1.0))
        report.share(f"{row}.wrong_and_accepted", found.localized & ~within(found, 1.0), better="lower")
        report.share(f"{row}.pitched_5_deg.within_1_m", accepted_within(pitched, 1.0))
        seen[height_m] = height_errors(dataset, _LEVEL)
        told_errors[height_m] = height_errors(dataset, _LEVEL, told_m=height_m)
    height_error_rows(report, seen, told_errors)
