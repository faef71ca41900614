"""Measure drives along real streets with default settings of import, map and localization.

``real.DRIVE.answered_*`` and ``median_m`` count accepted answers only. Forced figures count the best hypothesis of every query, with any
status. The report has both.
"""

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.coverage import coverage_rows
from benchmarks.real.confidence import (
    calibrated_elsewhere_rows,
    confidence_rows,
    judged_answers,
    pooled_confidence_rows,
    with_correction,
)
from benchmarks.real.paper_network import paper_network
from benchmarks.real.peers import peer_rows, pooled_rows
from benchmarks.real.stereo_frames import NAME as STEREO
from benchmarks.real.stereo_frames import QUERIES as STEREO_QUERIES
from benchmarks.real.stereo_frames import stereo_frames
from benchmarks.report import Report
from model_training.datasets.dataset import Dataset
from model_training.evaluation.failures import position_errors
from model_training.evaluation.measures import recall_at
from model_training.evaluation.odometry import as_query
from model_training.evaluation.pose_errors import pose_errors
from model_training.evaluation.predict import RANKED, Predictions, headings_of, predict
from model_training.evaluation.priors import prior_with_std
from model_training.evaluation.stages import QueryStages, stages_of
from model_training.evaluation.tracks import followed, steps_of
from model_training.importing.kinds import OpenSettings, open_recording
from model_training.importing.take import TakeSettings, take
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.odometry.align_poses import usual_poses
from model_training.stock import ENCODER
from service.errors import NoDepthError
from service.localization.localizer import Localizer
from service.maps.calibration import RIGHT_M
from service.maps.reader import MapBundle

DRIVES = ("kitti_0005", "kitti_0013")
QUERIES = "recorded"
SEQUENCE = 5
#: Standard deviation of a prior's error, metres.
PRIOR_M = 3.0
#: Bars of issue 36 (docs/decisions).
_ANSWERED, _WRONG, _MEDIAN_M, _RECALL_5M, _RECALL_10M, _INLIERS = 0.95, 0.02, 0.12, 0.95, 0.98, 0.5


@dataclass(frozen=True)
class Street:
    """A drive with its dataset and the localizer of its map.

    Attributes:
        name: name of the drive.
        dataset: imported dataset.
        localizer: localizer of its map.
    """

    name: str
    dataset: Dataset
    localizer: Localizer


def street_rows(report: Report, data: Path, work: Path, drives: tuple[str, ...] = DRIVES) -> None:
    """Add the rows of each drive on its own map, and those of its queries on the other map (out-of-map queries).

    The rows ``real.ece*`` pool all real queries, with the seven frames of ``kitti_stereo``.

    Args:
        report: receives the rows.
        data: folder of the recordings.
        work: folder of datasets and maps.
        drives: names of the drives.
    """
    streets = [street for name in drives if (street := _street(report, data, work, name)) is not None]
    if not streets:
        return
    others, calibrated = [], []
    network = paper_network(work / "paper_network")
    for street in streets:
        found = predict(street.localizer, street.dataset, QUERIES)
        answer_rows(report, f"real.{street.name}", found)
        _stage_rows(report, street)
        others.append(peer_rows(report, street.name, street.dataset, street.localizer, QUERIES, network))
        track_rows(report, street.name, street.dataset, street.localizer)
        calibrated.append(confidence_rows(report, street.name, street.dataset, street.localizer, QUERIES))
        if street.name == "kitti_0013":  # kitti_0005 has these rows among its variants
            prior_rows(report, street.name, street.dataset, street.localizer)
            sequence_rows(report, street.name, street.dataset, street.localizer)
    pooled_rows(report, others)
    if [street.name for street in streets] == list(DRIVES):
        correction, other = calibrated[0].correction, streets[1]
        answers = predict(with_correction(other.localizer, correction), other.dataset, QUERIES)
        calibrated_elsewhere_rows(report, streets[0].name.removeprefix("kitti_"), correction, answers)
    judged = [each.judged for each in calibrated]
    strangers = [
        (own, other, predict(own.localizer, other.dataset, QUERIES), each.correction)
        for own, each in zip(streets, calibrated, strict=True)
        for other in streets
        if own is not other
    ]
    for own, other, answers, correction in strangers:
        judged.append(judged_answers(f"{other.name} on the map of {own.name}", answers, correction, outside=True))
    if strangers:
        accepted = np.concatenate([answers.localized for _, _, answers, _ in strangers])
        report.share("real.strangers.accepted", accepted, bar=_WRONG, better="lower")
    frames = stereo_frames(data, work)
    if frames is not None:
        dataset, bundle = frames
        answers = predict(Localizer.open(MapBundle.open(bundle)), dataset, STEREO_QUERIES)
        judged.append(judged_answers(STEREO, answers, calibrated[0].correction, outside=False))
    pooled_confidence_rows(report, judged)


def answer_rows(report: Report, row: str, found: Predictions, *, bars: bool = True) -> None:
    """Add the rows of a query set: recall, figures by status, forced figures, and the coverage of the covariances.

    Args:
        report: receives the rows.
        row: prefix of the row ids.
        found: answers.
        bars: whether the bars of the drives apply.
    """
    true_xy, errors = found.T_true[:, :2, 3], position_errors(found)
    near, far = (_RECALL_5M, _RECALL_10M) if bars else (None, None)
    report.share(f"{row}.recall_at_1_5m", recall_at(found.ranked_xy, true_xy, 1), bar=near)
    report.share(f"{row}.recall_at_5_5m", recall_at(found.ranked_xy, true_xy, 5))
    report.share(f"{row}.recall_at_1_10m", recall_at(found.ranked_xy, true_xy, 1, within_m=10.0), bar=far)
    limits = (_ANSWERED, _WRONG, _MEDIAN_M) if bars else (None, None, None)
    status_rows(report, row, errors, found.localized, bars=limits)
    T_answer, T_true = found.T_answer, found.T_true
    coverage_rows(report, row, pose_errors(T_answer, T_true), found.covariance, headings_of(T_true), bars=bars)


def status_rows(
    report: Report,
    row: str,
    errors_m: NDArray[np.float64],
    localized: NDArray[np.bool_],
    *,
    bars: tuple[float | None, float | None, float | None],
) -> None:
    """Add shares of all queries by status, and forced.

    Args:
        report: receives the rows.
        row: prefix of the row ids.
        errors_m: position error of the best hypothesis of each query (n,), metres; infinite without a hypothesis.
        localized: whether the answer is accepted (n,).
        bars: limits of three figures: accepted and within 1 m, accepted and wrong, median error of accepted answers.
    """
    answered_bar, wrong_bar, median_bar = bars
    report.share(f"{row}.answered", localized)
    report.share(f"{row}.answered_within_1_m", localized & (errors_m <= RIGHT_M), bar=answered_bar)
    report.share(f"{row}.answered_wrong", localized & (errors_m > RIGHT_M), bar=wrong_bar, better="lower")
    accepted = errors_m[localized]
    report.row(
        f"{row}.median_m",
        float(np.median(accepted)) if len(accepted) else None,
        "m",
        bar=median_bar,
        better="lower",
        n=len(accepted),
        why=None if len(accepted) else "no answer was accepted",
    )
    report.share(f"{row}.forced_within_1_m", errors_m <= RIGHT_M)
    finite = errors_m[np.isfinite(errors_m)]
    report.row(f"{row}.forced_median_m", float(np.median(finite)) if len(finite) else None, "m", n=len(finite))


def unpacked(data: Path, work: Path, name: str) -> Path | None:
    """Unpack the recording of a drive; return its folder, or None if the recording is absent.

    Args:
        data: folder of the recordings.
        work: folder of datasets.
        name: name of the drive.
    """
    if not (data / name).exists():
        return None
    raw = work / f"{name}_raw"
    shutil.rmtree(raw, ignore_errors=True)
    subprocess.run([sys.executable, str(data / "unpack.py"), str(data / name), str(raw)], check=True)
    (drive,) = raw.glob("*/*_sync")
    return drive


def taken(drive: Path, folder: Path) -> Dataset:
    """Import a drive with default settings.

    Args:
        drive: folder of the drive.
        folder: folder of the dataset. An earlier one is deleted.

    Raises:
        FileNotFoundError: the recording has no poses.
    """
    shutil.rmtree(folder, ignore_errors=True)
    recording = open_recording("kitti-raw", drive, OpenSettings(depth="sgbm"))
    trajectory = recording.trajectory()
    if trajectory is None:
        raise FileNotFoundError(f"{drive} has no poses (oxts)")
    poses, _ = usual_poses(recording, trajectory)
    take(recording, poses, folder, TakeSettings())
    return Dataset(folder)


def imported(data: Path, work: Path, name: str) -> Dataset | None:
    """Unpack and import a drive with default settings; return None if the recording is absent.

    Args:
        data: folder of the recordings.
        work: folder of datasets.
        name: name of the drive.

    Raises:
        FileNotFoundError: the recording has no poses.
    """
    drive = unpacked(data, work, name)
    return None if drive is None else taken(drive, work / f"{name}_data")


def _street(report: Report, data: Path, work: Path, name: str) -> Street | None:
    """Import a drive and build its map; return None and add a row without a value if the recording is absent."""
    dataset = imported(data, work, name)
    if dataset is None:
        report.row(
            f"real.{name}.answered_within_1_m", None, "share", bar=_ANSWERED, why=f"no recordings at {data.name}"
        )
        return None
    folder = work / f"{name}_map"
    shutil.rmtree(folder, ignore_errors=True)
    build_map(dataset, ENCODER, folder, BuildSettings(name=name))
    return Street(name, dataset, Localizer.open(MapBundle.open(folder)))


def _stage_rows(report: Report, street: Street) -> None:
    """Add the recall of retrieval without registration, and shares of inliers at the true pose: measured, and by the noise model."""
    inlier_rows(report, street.name, stages_of(street.localizer, street.dataset, QUERIES))


def inlier_rows(report: Report, name: str, found: list[QueryStages]) -> None:
    """Add the recall of retrieval alone, and medians of shares of inliers.

    The medians are at the true pose (measured, and predicted by the noise model), and where registration from the true pose ends.

    Args:
        report: receives the rows.
        name: name of the drive, part of the row ids.
        found: comparison of each query with its ground truth.
    """
    report.share(f"real.{name}.retrieval_at_1_5m", np.array([each.rank == 1 for each in found], bool))
    shares = {
        "inliers_at_truth": [each.inliers_at_truth for each in found],
        "inliers_predicted": [each.inliers_predicted for each in found],
        "inliers_from_truth": [each.inliers_from_truth for each in found],
    }
    for row, every in shares.items():
        known = [share for share in every if np.isfinite(share)]
        report.row(
            f"real.{name}.{row}",
            float(np.median(known)) if known else None,
            "share",
            bar=_INLIERS if (name, row) == ("kitti_0013", "inliers_at_truth") else None,
            n=len(known),
            why=None if known else "no query has enough points to register",
        )


def prior_rows(report: Report, name: str, dataset: Dataset, localizer: Localizer) -> None:
    """Add the rows ``real.NAME.prior_3_m.*``: each query has a prior near its true position.

    Args:
        report: receives the rows.
        name: name of the drive.
        dataset: its dataset.
        localizer: localizer of its map.
    """
    found = predict(localizer, dataset, QUERIES, prior_of=prior_with_std(PRIOR_M))
    status_rows(report, f"real.{name}.prior_3_m", position_errors(found), found.localized, bars=(None, None, None))


def sequence_rows(report: Report, name: str, dataset: Dataset, localizer: Localizer, *, bars: bool = True) -> None:
    """Add the rows of sequences of five consecutive pairs. Each sequence is one query with the relative poses of the recording.

    Args:
        report: receives the rows.
        name: name of the drive, part of the row ids.
        dataset: the dataset of the drive.
        localizer: localizer of its map.
        bars: whether the bar of the drives applies.
    """
    frames, errors, localized = list(dataset.queries(QUERIES)), list[float](), list[bool]()
    for last in range(SEQUENCE - 1, len(frames)):
        group = frames[last - SEQUENCE + 1 : last + 1]
        queries, poses = as_query(
            group, np.random.default_rng(0), grid=localizer.bundle.grid, ranked=RANKED, exact=True
        )
        truth = frames[last].T_map_camera
        try:
            answer = localizer.localize_frames(queries, poses)
        except NoDepthError:
            errors.append(np.inf)
            localized.append(False)
            continue
        if truth is None:
            raise ValueError(f"query {last} of {name} has no ground truth")
        errors.append(float(np.hypot(*(answer.T_map_camera_guess[:2, 3] - truth[:2, 3]))))
        localized.append(answer.status == "LOCALIZED")
    limits = (1.0 if bars else None, None, None)
    status_rows(report, f"real.sequence{SEQUENCE}.{name}", np.array(errors), np.array(localized, bool), bars=limits)


def track_rows(report: Report, name: str, dataset: Dataset, localizer: Localizer) -> None:
    """Add the rows of a robot that is followed over the whole drive, at default settings.

    The odometry has the errors of ``model_training.evaluation.tracks``.

    Args:
        report: receives the rows.
        name: name of the drive, part of the row ids.
        dataset: the dataset of the drive.
        localizer: localizer of its map.
    """
    found = followed(localizer, [steps_of(list(dataset.queries(QUERIES)), np.random.default_rng(0))])
    errors, localized = found.error_m[0], found.accepted[0]
    status_rows(report, f"real.track.{name}", errors, localized, bars=(None, None, None))
