"""How far the covariances of right answers describe their errors."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.report import Report
from service.maps.calibration import RIGHT_M

#: Bar of the share of consistent errors.
COVERAGE_BAR = (0.90, 0.98)
#: Bar of ``sigma_gaps``.
SIGMA_GAP_BAR = 0.05


class Coverage(NamedTuple):
    """Coverage of the covariances of some queries.

    Attributes:
        consistent: share of consistent errors.
        gap: largest of the ``sigma_gaps``.
    """

    consistent: float
    gap: float


def worst_coverage_rows(report: Report, row: str, found: dict[str, Coverage]) -> None:
    """Add the worst coverage of several groups of queries, with the name of the group.

    Args:
        report: collects the rows.
        row: name that the rows begin with.
        found: coverage of each group; at least one.
    """
    name = max(found, key=lambda each: _outside(found[each].consistent))
    report.row(f"{row}.worst_covariance_95_coverage", found[name].consistent, "share", bar=COVERAGE_BAR, why=name)
    name = max(found, key=lambda each: found[each].gap)
    report.row(f"{row}.worst_sigma_coverage_gap", found[name].gap, "share", bar=SIGMA_GAP_BAR, better="lower", why=name)


def _outside(share: float) -> float:
    """Return how far a share is outside of the bar; negative inside."""
    return max(COVERAGE_BAR[0] - share, share - COVERAGE_BAR[1])


def coverage_rows(
    report: Report,
    row: str,
    errors: NDArray[np.float64],
    covariances: NDArray[np.float64],
    heading_rad: NDArray[np.float64],
    *,
    bars: bool = True,
    why: str | None = None,
) -> Coverage | None:
    """Add the coverage of the covariances of right answers, accepted or not, and return it; no row without a right answer.

    Args:
        report: collects the rows.
        row: name that the rows begin with.
        errors: errors (n, 6) of ``pose_errors``; NaN without ground truth.
        covariances: covariances (n, 6, 6); NaN without an answer.
        heading_rad: true heading of each camera, radians (n,).
        bars: whether the bars apply.
        why: remark on all rows.
    """
    off_m = np.linalg.norm(errors[:, :3], axis=1)
    near = np.isfinite(covariances).all(axis=(1, 2)) & (np.nan_to_num(off_m, nan=np.inf) < RIGHT_M)
    count = int(near.sum())
    if not count:
        return None
    coverage_bar, gap_bar = (COVERAGE_BAR, SIGMA_GAP_BAR) if bars else (None, None)
    share = consistent(errors[near], covariances[near])
    report.row(f"{row}.covariance_95_coverage", share, "share", bar=coverage_bar, n=count, why=why)
    report.row(f"{row}.inside_95_ellipsoid", inside_95(errors[near], covariances[near]), "share", n=count, why=why)
    gaps = sigma_gaps(heading_rad[near], errors[near], covariances[near])
    axis = max(gaps, key=lambda name: gaps[name])
    told = axis if why is None else f"{axis}; {why}"
    report.row(f"{row}.sigma_coverage_gap", gaps[axis], "share", bar=gap_bar, better="lower", n=count, why=told)
    return Coverage(share, gaps[axis])


def _squared(errors: NDArray[np.float64], covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the normalised squared error of each answer (n,)."""
    squared: NDArray[np.float64] = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    return squared


def inside_95(errors: NDArray[np.float64], covariances: NDArray[np.float64]) -> float:
    """Return the share of errors inside the 95 % ellipsoid of their covariance.

    Args:
        errors: errors (n, d).
        covariances: covariances (n, d, d) of the errors.
    """
    return float((_squared(errors, covariances) <= chi2.ppf(0.95, errors.shape[1])).mean())


def consistent(errors: NDArray[np.float64], covariances: NDArray[np.float64]) -> float:
    """Return the share of normalised squared errors between the 2.5 % and 97.5 % quantiles of chi-square.

    Args:
        errors: errors (n, d).
        covariances: covariances (n, d, d) of the errors.
    """
    squared = _squared(errors, covariances)
    low, high = (float(chi2.ppf(quantile, errors.shape[1])) for quantile in (0.025, 0.975))
    return float(((squared >= low) & (squared <= high)).mean())


def sigma_gaps(
    heading: NDArray[np.float64], errors: NDArray[np.float64], covariances: NDArray[np.float64]
) -> dict[str, float]:
    """Return, per axis, the largest difference of 1, 2 and 3 sigma coverage from the normal distribution.

    Queries look along their street within 15 degrees, so the camera's heading stands for the street's.

    Args:
        heading: true heading of each camera, radians (n,).
        errors: errors (n, 6) of ``pose_errors``.
        covariances: covariances (n, 6, 6).
    """
    axes = np.zeros((4, len(heading), 6))
    axes[0, :, 0], axes[0, :, 1] = np.cos(heading), np.sin(heading)
    axes[1, :, 0], axes[1, :, 1] = -np.sin(heading), np.cos(heading)
    axes[2, :, 2], axes[3, :, 5] = 1.0, 1.0
    found = {}
    for name, axis in zip(("along", "across", "up", "heading"), axes, strict=True):
        sigmas = np.abs((axis * errors).sum(axis=1)) / np.sqrt(np.einsum("ni,nij,nj->n", axis, covariances, axis))
        found[name] = max(abs(float((sigmas <= k).mean()) - p) for k, p in ((1, 0.683), (2, 0.954), (3, 0.997)))
    return found
