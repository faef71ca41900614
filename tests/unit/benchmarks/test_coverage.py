import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.coverage import Coverage, consistent, coverage_rows, inside_95, sigma_gaps, worst_coverage_rows
from benchmarks.report import Report
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from


def looking(*headings_deg):
    """Return T_map_camera of cameras at the origin."""
    return [transform_from(rotation_z(np.deg2rad(degrees)) @ R_BODY_OPTICAL, np.zeros(3)) for degrees in headings_deg]


def drawn(size, *, count=20_000, seed=1, cautious=1.0):
    """Return errors with random covariances, and stated covariances that are larger by a factor."""
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(count, size, size)) + 2 * np.eye(size)
    errors = np.einsum("nij,nj->ni", factors, rng.normal(size=(count, size)))
    return errors, cautious**2 * factors @ factors.transpose(0, 2, 1)


@pytest.mark.parametrize("size", [1, 3, 6])
def test_of_gaussian_errors_ninety_five_in_a_hundred_are_consistent(size):
    assert consistent(*drawn(size)) == pytest.approx(0.95, abs=0.006)


@pytest.mark.parametrize(
    ("size", "cautious", "share"), [(3, 0.5, 0.495), (3, 2.0, 0.834), (6, 0.5, 0.264), (6, 2.0, 0.550)]
)
def test_too_small_and_too_large_covariances_are_inconsistent(size, cautious, share):
    """Shares of chi-square between its own quantiles times 1/4 or times 4."""
    low, high = chi2.cdf(chi2.ppf([0.025, 0.975], size) * cautious**2, size)
    assert high - low == pytest.approx(share, abs=0.01)
    assert consistent(*drawn(size, cautious=cautious)) == pytest.approx(high - low, abs=0.01)


def test_consistency_by_hand():
    """One dimension, sigma 2: squared errors between 0.00098 and 5.02 times 4 are consistent. An error of 0 is not."""
    errors = np.array([[0.0], [0.05], [0.07], [2.0], [4.4], [4.6], [-4.4], [-9.0]])
    assert consistent(errors, np.full((8, 1, 1), 4.0)) == 4 / 8


def test_correlated_errors_are_judged_by_their_covariance():
    """Along the diagonal one sigma is 3, across it 0.1: (2, 2) is consistent, (2, -2) is not."""
    R = np.array([[1, -1], [1, 1]]) / np.sqrt(2)
    covariance = np.tile(R @ np.diag([9.0, 0.01]) @ R.T, (2, 1, 1))
    assert consistent(np.array([[2.0, 2.0], [2.0, -2.0]]), covariance) == 0.5


@pytest.fixture(scope="module")
def gaps():
    def found(errors, headings_deg, covariances=None):
        errors = np.array(errors, np.float64)
        covariances = np.tile(np.eye(6), (len(errors), 1, 1)) if covariances is None else covariances
        return sigma_gaps(np.deg2rad(headings_deg), errors, covariances)

    return found


def test_errors_lie_along_and_across_the_street_that_the_camera_looks_along(gaps):
    """The error is ten sigma along y. A camera that looks north has it along its view, one that looks east across."""
    far = [[0, 10, 0, 0, 0, 0]] * 4
    north, east = gaps(far, [90] * 4), gaps(far, [0] * 4)
    assert north == pytest.approx({"along": 0.997, "across": 0.317, "up": 0.317, "heading": 0.317})
    assert east == pytest.approx({"along": 0.317, "across": 0.997, "up": 0.317, "heading": 0.317})


def test_the_gap_is_the_largest_of_one_two_and_three_sigma(gaps):
    """Three of four within one sigma and all within two: gaps 0.067, 0.046, 0.003. One of ten beyond three: 0.097."""
    found = gaps(
        [[0, 0, z, 0, 0, heading] for z, heading in zip([0.5, -0.9, 0.1, 1.5], [9, 9, 9, 9], strict=True)], [30] * 4
    )
    assert found["up"] == pytest.approx(0.067)
    assert found["heading"] == pytest.approx(0.997)
    z = [0.5] * 7 + [1.5] * 2 + [3.5]
    assert gaps([[0, 0, each, 0, 0, 0] for each in z], [0] * 10)["up"] == pytest.approx(0.097)


def test_deviations_are_those_along_the_axis(gaps):
    """The error is 3 m along a street at 45 degrees. The stated sigma is 3 m along it and 0.1 m across."""
    R = rotation_z(np.pi / 4)
    covariance = np.eye(6)
    covariance[:3, :3] = R @ np.diag([9.0, 0.01, 1.0]) @ R.T
    error = [*(R @ [2.9, 0.0, 0.0]), 0, 0, 0]
    found = gaps([error] * 5, [45] * 5, np.tile(covariance, (5, 1, 1)))
    assert found["along"] == found["across"] == pytest.approx(0.317)


def test_gaussian_errors_have_hardly_a_gap(gaps):
    rng = np.random.default_rng(4)
    errors, covariances = drawn(6, count=6000)
    found = gaps(errors, rng.uniform(-180, 180, 6000), covariances)
    assert set(found) == {"along", "across", "up", "heading"}
    assert max(found.values()) < 0.02


@pytest.mark.parametrize("size", [1, 3, 6])
def test_of_gaussian_errors_ninety_five_in_a_hundred_lie_in_the_ellipsoid(size):
    assert inside_95(*drawn(size)) == pytest.approx(0.95, abs=0.006)
    assert inside_95(*drawn(size, cautious=9.0)) == 1.0


def test_only_right_answers_have_a_coverage():
    """Of five queries two are right, with errors of 2.5 and 0 sigma on each axis; one is wrong, one has no truth, one no answer."""
    errors, covariances = np.zeros((5, 6)), np.tile(0.01 * np.eye(6), (5, 1, 1))
    errors[0], errors[2, 0], errors[3] = 0.25, 5.0, np.nan
    covariances[4] = np.nan
    report = Report("x", "x")
    coverage_rows(report, "of", errors, covariances, np.zeros(5))
    rows = {row["id"]: row for row in report.rows}
    assert rows["of.covariance_95_coverage"]["value"] == 0.0
    assert rows["of.covariance_95_coverage"]["n"] == rows["of.sigma_coverage_gap"]["n"] == 2
    assert rows["of.inside_95_ellipsoid"]["value"] == 0.5  # 6 x 2.5^2 is above the quantile of 12.6, and 0 below it
    assert rows["of.sigma_coverage_gap"]["value"] == pytest.approx(0.454)  # one of two is within two sigma, not 0.954


def test_no_right_answer_gives_no_row():
    report = Report("x", "x")
    coverage_rows(report, "of", np.full((3, 6), np.nan), np.tile(np.eye(6), (3, 1, 1)), np.zeros(3))
    assert not report.rows


def test_the_worst_group_is_furthest_from_the_bar(tmp_path):
    """0.99 is 0.01 above the bar, 0.88 is 0.02 below it."""
    report = Report("x", "x", folder=tmp_path)
    worst_coverage_rows(report, "r", {"a": Coverage(0.99, 0.04), "b": Coverage(0.88, 0.02), "c": Coverage(0.94, 0.03)})
    coverage, gap = report.rows
    assert (coverage["id"], coverage["value"], coverage["why"]) == ("r.worst_covariance_95_coverage", 0.88, "b")
    assert (gap["id"], gap["value"], gap["why"]) == ("r.worst_sigma_coverage_gap", 0.04, "a")
    assert (coverage["holds"], gap["holds"]) == (False, True)
