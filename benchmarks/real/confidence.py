"""Whether the confidence holds on real recordings, before and after a calibration for their rig.

Each query of a drive is asked twice: in the map, and in the map without the places around it. The pooled rows add the queries that are
asked on the other drive's map, and single stereo frames of the same car. Half of the weight lies on out-of-map queries. No real recording
took part in the calibration, but drive 0005 helped to choose its features. The calibration for the rig is cross-validated over blocks of
consecutive frames. The correction of one drive is also applied to queries that took no part in it.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Report
from model_training.calibration.own_drive import frames_of_drive
from model_training.calibration.own_rig import calibration_error, learn_correction, log_odds_of, validated, weights_of
from model_training.datasets.dataset import Dataset
from model_training.evaluation.failures import position_errors
from model_training.evaluation.predict import Predictions
from service.errors import BundleError
from service.localization.localizer import Localizer
from service.maps.calibration import RIGHT_M, RigCorrection, corrected_log_odds, probability

#: Bars of issue 38 (docs/decisions): calibration error without and with a calibration for the rig. With the correction of another drive:
#: wrong answers of the accepted ones, and right answers that are refused, of all queries.
_ECE, _AFTER, _WRONG, _REFUSED = 0.10, 0.05, 0.02, 0.05


#: Said beside the pooled rows.
_JUDGED_ON = "No real query was fitted, but drive 0005 helped to choose the features (decisions 0137 and 0165)"


@dataclass(frozen=True, slots=True, eq=False)
class JudgedQueries:
    """Confidence and correctness of some real queries.

    Attributes:
        name: what the queries are.
        outside: whether each is an out-of-map query (n,).
        right: whether each answer is right (n,). Out-of-map queries have no right answer.
        before: confidence by the map's calibration (n,); 0 without registration.
        after: the same with a correction for the rig in whose fit the query took no part (n,).
    """

    name: str
    outside: NDArray[np.bool_]
    right: NDArray[np.bool_]
    before: NDArray[np.float64]
    after: NDArray[np.float64]

    def error(self, confidence: NDArray[np.float64]) -> float:
        """Return the expected calibration error; half of the weight lies on the out-of-map queries.

        Args:
            confidence: ``before`` or ``after``.
        """
        return calibration_error(confidence, self.right, weights_of(self.outside))


@dataclass(frozen=True, slots=True, eq=False)
class DriveConfidence:
    """Confidence of the queries of a drive.

    Attributes:
        judged: the queries, in the map and outside it.
        correction: the correction for the rig that all of them together give.
    """

    judged: JudgedQueries
    correction: RigCorrection


def confidence_rows(report: Report, name: str, dataset: Dataset, localizer: Localizer, queries: str) -> DriveConfidence:
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
    each = validated(calibration, found.frames, source="drive")
    judged = JudgedQueries(name, found.frames.outside, found.frames.right, each.before, each.after)
    for row, value in (("ece", learned.error_before), ("ece_after_rig_calibration", learned.error_after)):
        report.row(f"real.{name}.{row}", value, "share", better="lower", n=len(found.frames))
    return DriveConfidence(judged, learned)


def judged_answers(name: str, found: Predictions, correction: RigCorrection, *, outside: bool) -> JudgedQueries:
    """Return the confidence of answers, also with the correction of queries that these are not.

    Args:
        name: what the queries are.
        found: answers of a map without a correction.
        correction: correction for the same rig, from other queries.
        outside: whether all of them are out-of-map queries. Else their answers are right within ``RIGHT_M``.
    """
    before = np.nan_to_num(found.confidence)
    after, known = before.copy(), (before > 0) & (before < 1)
    odds = corrected_log_odds(
        log_odds_of(before[known]), correction.scale, correction.offset, lower_only=correction.lower_only
    )
    after[known] = probability(odds)
    right = (position_errors(found) <= RIGHT_M) & (not outside)
    return JudgedQueries(name, np.full(len(before), outside), right, before, after)


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


def pooled_confidence_rows(report: Report, parts: list[JudgedQueries]) -> None:
    """Add the calibration errors over all real queries, in maps and outside them, without and with a correction for the rig.

    Args:
        report: receives the rows.
        parts: the queries of each recording.
    """
    if not parts:
        return
    outside, right, before, after = (
        np.concatenate([getattr(each, name) for each in parts]) for name in ("outside", "right", "before", "after")
    )
    every = JudgedQueries("all", outside, right, before, after)
    counts = ". ".join(f"{each.name}: {(~each.outside).sum()} and {each.outside.sum()}" for each in parts)
    told = f"{(~outside).sum()} queries in the map and {outside.sum()} outside it. Of these, {counts}. {_JUDGED_ON}"
    for row, confidence, bar in (("ece", before, _ECE), ("ece_after_rig_calibration", after, _AFTER)):
        value = every.error(confidence)
        report.row(f"real.{row}", value, "share", bar=bar, better="lower", n=len(right), why=told)
