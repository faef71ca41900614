"""Whether the confidence holds on real drives, before and after a calibration for their rig.

Each query is asked twice: in the map, and in the map without the places around it. So half of the weight lies on out-of-map
queries. No real recording took part in the calibration. The calibration for the rig is cross-validated over blocks of
consecutive frames. The correction of one drive is also applied to the other drive, which took no part in it.
"""

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.report import Report
from model_training.calibration.own_drive import frames_of_drive
from model_training.calibration.own_rig import learn_correction
from model_training.datasets.dataset import Dataset
from model_training.evaluation.failures import position_errors
from model_training.evaluation.predict import Predictions
from service.errors import BundleError
from service.localization.localizer import Localizer
from service.maps.calibration import RIGHT_M, RigCorrection

#: Bars of issue 38 (docs/decisions): calibration error without and with a calibration for the rig. With the correction of another drive:
#: wrong answers of the accepted ones, and right answers that are refused, of all queries.
_ECE, _AFTER, _WRONG, _REFUSED = 0.10, 0.05, 0.02, 0.05


@dataclass(frozen=True)
class CalibrationErrors:
    """Calibration errors of a drive.

    Attributes:
        frames: number of queries, in the map and outside it.
        before: expected calibration error of the map's calibration.
        after: the same with the correction for the rig, cross-validated.
        correction: the correction that all queries together give.
    """

    frames: int
    before: float
    after: float
    correction: RigCorrection


def confidence_rows(
    report: Report, name: str, dataset: Dataset, localizer: Localizer, queries: str
) -> CalibrationErrors:
    """Add the calibration errors of a drive.

    Args:
        report: receives the rows.
        name: name of the drive, part of the row ids.
        dataset: the dataset of the drive.
        localizer: localizer of its map.
        queries: name of the query set.

    Raises:
        BundleError: the map has no calibration.
    """
    calibration = localizer.bundle.calibration
    if calibration is None:
        raise BundleError(f"{localizer.bundle.path}: the map has no calibration, so there is no confidence to measure")
    found = frames_of_drive(localizer, dataset, [queries], odometry_noise=0.0)
    learned = learn_correction(calibration, found.frames, source="drive", measured_on=found.described)
    errors = CalibrationErrors(len(found.frames), learned.error_before, learned.error_after, learned)
    report.row(f"real.{name}.ece", errors.before, "share", better="lower", n=errors.frames)
    report.row(f"real.{name}.ece_after_rig_calibration", errors.after, "share", better="lower", n=errors.frames)
    return errors


def with_correction(localizer: Localizer, correction: RigCorrection) -> Localizer:
    """Return a localizer with the correction of a rig in its calibration.

    Args:
        localizer: localizer of a map with a calibration.
        correction: the correction.

    Raises:
        BundleError: the map has no calibration.
    """
    calibration = localizer.bundle.calibration
    if calibration is None:
        raise BundleError(f"{localizer.bundle.path}: the map has no calibration that a correction could apply to")
    bundle = replace(localizer.bundle, calibration=calibration.model_copy(update={"rig": correction}))
    return Localizer(bundle, localizer.encoder, clusters=localizer.clusters, refining=localizer.refining)


def calibrated_elsewhere_rows(report: Report, learned_on: str, correction: RigCorrection, found: Predictions) -> None:
    """Add the rows of a drive whose map has the correction of another drive.

    Args:
        report: receives the rows.
        learned_on: name of the drive that the correction comes from, part of the row ids.
        correction: the correction.
        found: answers with the correction; one at least.
    """
    row, right = f"real.calibrated_on_{learned_on}", position_errors(found) <= RIGHT_M
    accepted = int(found.localized.sum())
    wrong = float((found.localized & ~right).sum() / accepted) if accepted else None
    told = f"scale {correction.scale:.2f}, offset {correction.offset:+.2f}"
    told += "" if accepted else "; no LOCALIZED answer"
    report.row(f"{row}.wrong_of_localized", wrong, "share", bar=_WRONG, better="lower", n=accepted, why=told)
    report.share(f"{row}.right_but_refused", right & ~found.localized, bar=_REFUSED, better="lower")


def pooled_confidence_rows(report: Report, drives: list[CalibrationErrors]) -> None:
    """Add the calibration errors over all drives, weighted by their numbers of queries.

    Args:
        report: receives the rows.
        drives: calibration errors of each drive.
    """
    if not drives:
        return
    weights, count = [each.frames for each in drives], sum(each.frames for each in drives)
    before, after = (
        np.average([getattr(each, name) for each in drives], weights=weights) for name in ("before", "after")
    )
    report.row("real.ece", float(before), "share", bar=_ECE, better="lower", n=count)
    report.row("real.ece_after_rig_calibration", float(after), "share", bar=_AFTER, better="lower", n=count)
