"""Rig families: each one by a calibration that was fitted without it, and the coverage of its covariances.

The coverage is in-sample for most families: the factors of the covariance (``OF_RAYS`` in ``service/registration/covariance.py``) were
fitted to their answers. Decision 0179 has figures with factors that were fitted to the other families. Families in
``NOT_IN_COVARIANCE`` took no part in that fit.
"""

from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.coverage import Coverage, coverage_rows, worst_coverage_rows
from benchmarks.provenance import Run, commit_with_code, git, machine
from benchmarks.report import Report
from model_training.calibration.answer_code import code_of_answers
from model_training.calibration.bounds import WRONG_RATE
from model_training.calibration.cross_check import FamilyFigures, cross_check, cross_check_groups
from model_training.calibration.families import NOT_FITTED, related
from model_training.calibration.fit import CalibrationData
from model_training.calibration.make import codes_of_answers, collected
from model_training.cli.progress import bars

#: Queries on the street with repeating blocks. It is a kind of street, not of rig, and half of its places cannot be told apart.
_REPEATING = "repeating"
#: A phone's LiDAR of 5 m, and depth that covers some rows only. They have rows, but do not count in ``rigs.worst_within_1_m``.
APART = ("iphone", "rings")
#: Families to whose answers the factors of the covariance were not fitted (decision 0179).
NOT_IN_COVARIANCE = ("quadruped", "courier", "bus", "monocular", "repeating", "oak_d", "kinect", "iphone", "rings")
_IN_SAMPLE = "in-sample: the factors of the covariance were fitted to these answers; decision 0179 has held-out figures"
#: Bars of each family, and of the worst one.
_ECE, _WORST_ECE, _REFUSED, _WITHIN, _WORST_WITHIN = 0.05, 0.08, 0.05, 0.97, 0.94


def rig_rows(report: Report, encoder: Path, work: Path) -> None:
    """Add the rows of all rig families.

    The data are those of the calibration. Each family's figures come from a fit without this family. Families that the calibration is not
    fitted to count as well. The repeating blocks have rows but do not count as the worst. The rows ``rigs.without.*`` leave out all
    families that share a LiDAR, a camera, a depth type or a survey spacing. A note says which version of the code gave the answers, if
    not the present one.

    Args:
        report: collects the rows.
        encoder: the encoder.
        work: folder of the calibration's cities, maps and answers.
    """
    with bars() as progress:
        data = collected(work, encoder, report=progress)
    codes = codes_of_answers(work, encoder)
    run, report.notes["rigs"] = run_of_answers(codes, report.command)
    with report.made_by(run) if run is not None else nullcontext():
        _all_rows(report, data)


def run_of_answers(codes: dict[str, str | None], command: str) -> tuple[Run | None, str | None]:
    """Return the run that the rows belong to, and a note for the page. Answers are stored, so the present code need not have given them.

    A row depends on the answers of all families, so the oldest version of the code counts.

    Args:
        codes: version of the code of each file of answers.
        command: command of the report.

    Returns:
        None and None if the present code gave all answers. No run if the version of a file was not kept, or if no commit has it.
    """
    others = {name: code for name, code in codes.items() if code != code_of_answers()}
    if not others:
        return None, None
    found = {code: commit_with_code(code) for code in set(others.values()) if code is not None}
    lost = [name for name, code in others.items() if code is None or found[code] is None]
    if lost:
        return None, (
            f"Rows `rigs.*`: the commit that gave the answers is unknown for {len(lost)} of {len(codes)} files, for example {lost[0]}. The "
            "run below only fitted and counted."
        )
    commits = {commit for commit in found.values() if commit is not None}
    oldest = min(commits, key=lambda commit: int(git("rev-list", "--count", commit) or 0))
    return (
        Run(
            commit=oldest,
            dirty=False,
            before=datetime.now(UTC).isoformat(timespec="seconds"),
            machine=machine(),
            command=command,
        ),
        f"Rows `rigs.*`: the answers of {len(others)} of {len(codes)} files are of commits {', '.join(sorted(c[:10] for c in commits))}.",
    )


def _all_rows(report: Report, data: CalibrationData) -> None:
    figures, coverage = cross_check(data, not_fitted=NOT_FITTED), dict[str, Coverage]()
    for each in figures:
        row = f"rigs.{each.family}"
        _figure_rows(report, row, each)
        own = data.where(data.family == each.family)
        why = None if each.family in NOT_IN_COVARIANCE else _IN_SAMPLE
        found = coverage_rows(report, row, own.error, own.covariance, own.heading_rad, why=why)
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
