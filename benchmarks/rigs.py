"""Rig families: each one by a calibration that was fitted without it, and the coverage of its covariances."""

from pathlib import Path

import numpy as np

from benchmarks.full import COVERAGE_BAR, consistent, sigma_gaps
from benchmarks.report import Report
from model_training.calibration.cross_check import cross_check
from model_training.calibration.families import NOT_FITTED
from model_training.calibration.fit import Asked
from model_training.calibration.make import collected
from model_training.cli.progress import bars
from service.maps.calibration import RIGHT_M

#: Queries on the street with repeating blocks. It is a kind of street, not of rig, and half of its places cannot be told apart.
_REPEATING = "repeating"
#: A phone's LiDAR of 5 m, and depth that covers some rows only. They have rows, but do not count in ``rigs.worst_within_1_m``.
APART = ("iphone", "rings")
#: Bars of each family, and of the worst one.
_ECE, _WORST_ECE, _REFUSED, _WRONG, _WITHIN, _WORST_WITHIN, _SIGMA_GAP = 0.05, 0.08, 0.05, 0.01, 0.97, 0.94, 0.05


def rig_rows(report: Report, encoder: Path, work: Path) -> None:
    """Add the rows of all rig families.

    The data are those of the calibration. Each family's figures come from a fit without this family. Families that the calibration is not
    fitted to count as well. The repeating blocks have rows but do not count as the worst.

    Args:
        report: collects the rows.
        encoder: the encoder.
        work: folder of the calibration's cities, maps and answers.
    """
    with bars() as progress:
        asked = collected(work, encoder, report=progress)
    figures = cross_check(asked, not_fitted=NOT_FITTED)
    for each in figures:
        row, inside, every = f"rigs.{each.family}", each.inside, each.inside + each.outside
        report.row(f"{row}.ece", each.ece, "share", bar=_ECE, better="lower", n=every)
        report.row(f"{row}.within_1_m", each.within_1_m, "share", bar=_WITHIN, n=inside)
        report.row(f"{row}.localized", each.localized, "share", n=inside)
        report.row(f"{row}.right_but_refused", each.right_but_refused, "share", bar=_REFUSED, better="lower", n=inside)
        accepted = round(each.localized * inside + each.outside_accepted * each.outside)
        report.row(
            f"{row}.wrong_of_localized", each.wrong_of_localized, "share", bar=_WRONG, better="lower", n=accepted
        )
        if each.outside:
            report.row(f"{row}.outside_accepted", each.outside_accepted, "share", better="lower", n=each.outside)
        coverage_rows(report, row, asked.where(asked.family == each.family))
    rigs = [each for each in figures if each.family != _REPEATING]
    fitted = [each for each in rigs if each.family not in NOT_FITTED]
    worst = max(rigs, key=lambda each: each.ece)
    report.row("rigs.worst_ece", worst.ece, "share", bar=_WORST_ECE, better="lower", why=worst.family)
    worst_fitted = max(fitted, key=lambda each: each.ece)
    report.row("rigs.worst_fitted_ece", worst_fitted.ece, "share", better="lower", why=worst_fitted.family)
    least = min((each for each in rigs if each.family not in APART), key=lambda each: each.within_1_m)
    report.row("rigs.worst_within_1_m", least.within_1_m, "share", bar=_WORST_WITHIN, why=least.family)


def coverage_rows(report: Report, row: str, asked: Asked) -> None:
    """Add the coverage of the covariances of right answers.

    Args:
        report: collects the rows.
        row: name that the rows begin with.
        asked: calibration data of one family.
    """
    off_m = np.linalg.norm(asked.error[:, :3], axis=1)
    near = np.isfinite(asked.covariance).all(axis=(1, 2)) & (np.nan_to_num(off_m, nan=np.inf) < RIGHT_M)
    if not near.any():
        return
    errors, covariances = asked.error[near], asked.covariance[near]
    report.row(
        f"{row}.covariance_95_coverage", consistent(errors, covariances), "share", bar=COVERAGE_BAR, n=int(near.sum())
    )
    gaps = sigma_gaps(asked.heading_rad[near], errors, covariances)
    axis = max(gaps, key=lambda name: gaps[name])
    report.row(
        f"{row}.sigma_coverage_gap", gaps[axis], "share", bar=_SIGMA_GAP, better="lower", n=int(near.sum()), why=axis
    )
