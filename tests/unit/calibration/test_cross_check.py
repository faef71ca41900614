import numpy as np
import pytest

from model_training.calibration.cross_check import (
    FamilyFigures,
    accepted,
    cross_check,
    cross_check_groups,
    figures_of,
    table,
)
from model_training.calibration.fit import CalibrationData, confidences, fit, pooled
from service.confidence.features import FEATURES

COUNT, MARGIN, SHARE = len(FEATURES), FEATURES.index("margin"), FEATURES.index("log_share")


def family(name, seed, *, upside_down=False, count=2000):
    """Half of the queries are in the map. Nine of ten of these are right, and their margin is large."""
    rng = np.random.default_rng(seed)
    known = np.arange(count) % 2 == 0
    right = known & (rng.random(count) < 0.9)
    evidence = rng.normal(size=(count, COUNT))
    evidence[:, MARGIN] += np.where(right, 3.0, -3.0) * (-1 if upside_down else 1)
    evidence[:, SHARE] = 0.0
    return CalibrationData(
        evidence=evidence,
        right=right,
        known=known,
        kind=np.where(known, "clear", "other_city"),
        family=np.full(count, name),
        error=np.full((count, 6), np.nan),
        covariance=np.full((count, 6, 6), np.nan),
        heading_rad=np.full(count, np.nan),
    )


@pytest.fixture(scope="module")
def figures():
    found = cross_check(pooled([family("one", 1), family("two", 2), family("odd", 3, upside_down=True)]))
    return {each.family: each for each in found}


def test_a_family_like_the_others_is_predicted_well(figures):
    one = figures["one"]
    assert (one.inside, one.outside) == (1000, 1000)
    assert one.within_1_m == pytest.approx(0.9, abs=0.03)


def test_a_family_is_not_predicted_from_itself(figures):
    """Two families that agree predict each other. The third contradicts them, however well it fits itself."""
    found = {each.family: each for each in cross_check(pooled([family("one", 1), family("two", 2)]))}
    assert found["one"].ece < 0.05
    assert found["one"].wrong_of_localized < 0.02
    assert found["one"].localized > 0.5
    assert figures["odd"].ece > 0.3


def test_the_status_needs_the_threshold_the_majority_and_a_query_in_range():
    data = family("one", 1)
    calibration = fit(data, measured_on={})
    four = data.where(np.arange(len(data)) < 4)
    four.evidence[:] = 0.0
    four.evidence[:, SHARE] = np.log([0.9, 0.4, 0.9, 0.9])
    four.evidence[3, FEATURES.index("points")] = 1e6
    confident = calibration.model_copy(
        update={"right": calibration.right.model_copy(update={"bias": 50.0}), "thresholds": calibration.thresholds}
    )
    confidence = confidences(confident, four)
    np.testing.assert_array_equal(accepted(four, confident, confidence, 0.01), [True, False, True, False])
    confidence[2] = 0.5
    np.testing.assert_array_equal(accepted(four, confident, confidence, 0.01), [True, False, False, False])


def test_a_family_that_is_not_fitted_changes_no_other_family():
    others = [family("one", 1), family("two", 2)]
    alone = {each.family: each for each in cross_check(pooled(others))}
    odd = family("odd", 3, upside_down=True)
    found = {each.family: each for each in cross_check(pooled([*others, odd]), not_fitted=("odd",))}
    assert found["one"] == alone["one"]
    assert found["odd"].ece > 0.3


def test_relatives_are_left_out_together():
    """Two odd families predict each other, unless both are left out. A group of one family has no row."""
    odd = [family(name, seed, upside_down=True) for name, seed in (("odd", 3), ("odder", 4))]
    data = pooled([family("one", 1), family("two", 2), *odd])
    groups = {"lidar.odd": ("odd", "odder"), "lidar.alone": ("one",), "lidar.absent": ("one", "nobody")}
    (together,) = cross_check_groups(data, groups)
    assert (together.family, together.inside, together.outside) == ("lidar.odd", 2000, 2000)
    assert together.ece > 0.3
    assert cross_check_groups(data, groups, not_fitted=("odder",)) == []


def test_the_table_has_the_worst_family_first():
    rows = [
        FamilyFigures(name, 10, 20, 9, ece, 0.9, 0.8, 0.1, 0.0, 0.05) for name, ece in (("good", 0.01), ("bad", 0.2))
    ]
    lines = table(rows)
    assert len(lines) == 4
    assert lines[2].split() == ["bad", "10+20", "20.0", "90.0", "80.0", "10.0", "0.0", "5.0"]
    assert lines[3].split()[0] == "good"


def test_a_share_of_nothing_is_no_share():
    """No answer reaches a confidence of 2, so none is LOCALIZED. The family has no out-of-map query either."""
    data = family("one", 1)
    calibration = fit(data, measured_on={})
    thresholds = tuple(each.model_copy(update={"confidence": 2.0}) for each in calibration.thresholds)
    found = figures_of("one", data.where(data.known), calibration.model_copy(update={"thresholds": thresholds}), 0.01)
    assert (found.accepted, found.localized) == (0, 0.0)
    assert np.isnan([found.wrong_of_localized, found.outside_accepted]).all()
    assert table([found])[2].split()[-2:] == ["-", "-"]
