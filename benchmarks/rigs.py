"""Rig families: each one by a calibration that was fitted without it, and the coverage of its covariances."""

from pathlib import Path

from benchmarks.coverage import Coverage, coverage_rows, worst_coverage_rows
from benchmarks.report import Report
from model_training.calibration.cross_check import FamilyFigures, cross_check, cross_check_groups
from model_training.calibration.families import NOT_FITTED, related
from model_training.calibration.fit import CalibrationData
from model_training.calibration.make import collected
from model_training.calibration.own_rig import WRONG_RATE
from model_training.cli.progress import bars

#: Queries on the street with repeating blocks. It is a kind of street, not of rig, and half of its places cannot be told apart.
_REPEATING = "repeating"
#: A phone's LiDAR of 5 m, and depth that covers some rows only. They have rows, but do not count in ``rigs.worst_within_1_m``.
APART = ("iphone", "rings")
#: Bars of each family, and of the worst one.
_ECE, _WORST_ECE, _REFUSED, _WITHIN, _WORST_WITHIN = 0.05, 0.08, 0.05, 0.97, 0.94


def rig_rows(report: Report, encoder: Path, work: Path) -> None:
    """Add the rows of all rig families.

    The data are those of the calibration. Each family's figures come from a fit without this family. Families that the calibration is not
    fitted to count as well. The repeating blocks have rows but do not count as the worst. The rows ``rigs.without.*`` leave out all
    families that share a LiDAR, a camera, a depth type or a survey spacing.

    Args:
        report: collects the rows.
        encoder: the encoder.
        work: folder of the calibration's cities, maps and answers.
    """
    with bars() as progress:
        data = collected(work, encoder, report=progress)
    figures, coverage = cross_check(data, not_fitted=NOT_FITTED), dict[str, Coverage]()
    for each in figures:
        row = f"rigs.{each.family}"
        _figure_rows(report, row, each)
        own = data.where(data.family == each.family)
        found = coverage_rows(report, row, own.error, own.covariance, own.heading_rad)
        if found is not None and each.family != _REPEATING:
            coverage[each.family] = found
    worst_coverage_rows(report, "rigs", coverage)
    rigs = [each for each in figures if each.family != _REPEATING]
    fitted = [each for each in rigs if each.family not in NOT_FITTED]
    worst = max(rigs, key=lambda each: each.ece)
    report.row("rigs.worst_ece", worst.ece, "share", bar=_WORST_ECE, better="lower", why=worst.family)
    worst_fitted = max(fitted, key=lambda each: each.ece)
    report.row("rigs.worst_fitted_ece", worst_fitted.ece, "share", better="lower", why=worst_fitted.family)
    least = min((each for each in rigs if each.family not in APART), key=lambda each: each.within_1_m)
    report.row("rigs.worst_within_1_m", least.within_1_m, "share", bar=_WORST_WITHIN, why=least.family)
    _group_rows(report, data)


def _group_rows(report: Report, data: CalibrationData) -> None:
    """Add the rows of families that are left out together."""
    groups = related()
    found = cross_check_groups(data, groups, not_fitted=NOT_FITTED)
    for each in found:
        row, why = f"rigs.without.{each.family}", ", ".join(n for n in groups[each.family] if n not in NOT_FITTED)
        report.row(f"{row}.ece", each.ece, "share", better="lower", n=each.inside + each.outside, why=why)
        refused = each.right_but_refused
        report.row(f"{row}.right_but_refused", refused, "share", better="lower", n=each.inside, why=why)
        wrong = each.wrong_of_localized if each.accepted else None
        report.row(f"{row}.wrong_of_localized", wrong, "share", better="lower", n=each.accepted, why=why)
    if found:
        worst = max(found, key=lambda each: each.ece)
        report.row("rigs.without.worst_ece", worst.ece, "share", better="lower", why=worst.family)


def _figure_rows(report: Report, row: str, each: FamilyFigures) -> None:
    """Add the shares of a family. A share of nothing has no value, so its bar does not hold."""
    inside, every = each.inside, each.inside + each.outside
    report.row(f"{row}.ece", each.ece, "share", bar=_ECE, better="lower", n=every)
    none = None if inside else "no query in the map"
    report.row(f"{row}.within_1_m", each.within_1_m if inside else None, "share", bar=_WITHIN, n=inside, why=none)
    report.row(f"{row}.localized", each.localized if inside else None, "share", n=inside, why=none)
    report.row(
        f"{row}.right_but_refused",
        each.right_but_refused if inside else None,
        "share",
        bar=_REFUSED,
        better="lower",
        n=inside,
        why=none,
    )
    report.row(
        f"{row}.wrong_of_localized",
        each.wrong_of_localized if each.accepted else None,
        "share",
        bar=WRONG_RATE,
        better="lower",
        n=each.accepted,
        why=None if each.accepted else "no LOCALIZED answer",
    )
    if each.outside:
        report.row(f"{row}.outside_accepted", each.outside_accepted, "share", better="lower", n=each.outside)
