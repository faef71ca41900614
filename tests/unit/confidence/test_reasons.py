import numpy as np
import pytest

from service.confidence.features import FEATURES, UNWEIGHED
from service.confidence.reasons import FAR, GROUPS, reasons_of, support_of
from service.scoring.support import SupportWeights


@pytest.fixture
def calibration(calibration_of):
    """Return a calibration with means 2 and standard deviations 0.5 for all features."""
    return calibration_of(features=[{"name": name, "mean": 2.0, "std": 0.5} for name in FEATURES])


def evidence_of(**deviations):
    """Return a row of features at the given numbers of standard deviations from the means."""
    row = np.full(len(FEATURES), 2.0)
    for name, size in deviations.items():
        row[FEATURES.index(name)] += 0.5 * size
    return row


def told(reasons):
    return [(each.check, each.evidence) for each in reasons]


@pytest.mark.parametrize("size", [4.0, -4.0])
def test_evidence_four_deviations_off_gives_its_reason_and_no_other(calibration, size):
    (reason,) = reasons_of(calibration, evidence_of(log_noise=size))
    assert (reason.check, reason.evidence) == ("baseline", (("log_noise", size),))
    assert "depth.baseline_m" in reason.remedy


@pytest.mark.parametrize("size", [0.0, 2.5, FAR, -FAR])
def test_evidence_in_the_range_that_calibration_saw_gives_none(calibration, size):
    assert reasons_of(calibration, evidence_of(**dict.fromkeys(FEATURES, size))) == ()


def test_what_alone_prevents_a_pose_is_a_reason_at_any_distance(calibration_of):
    """The range of the noise ends 2 standard deviations above the mean, and a tenth of its width further. 2.5 is beyond it, 2.3 is not."""
    calibration = calibration_of(
        features=[{"name": name, "mean": 2.0, "std": 0.5} for name in FEATURES],
        right={"terms": [{"feature": "log_noise", "knots": [1.0, 3.0], "log_odds": [0.0, 0.0]}], "bias": 5.0},
    )
    assert reasons_of(calibration, evidence_of(log_noise=2.3)) == ()
    assert told(reasons_of(calibration, evidence_of(log_noise=2.5))) == [("baseline", (("log_noise", 2.5),))]


def test_the_likeliest_reason_comes_first_and_each_remedy_appears_once(calibration):
    evidence = evidence_of(
        margin=-5, front=4, through=8, points=-3.5, measured=-4, scale=6, facings=-10, similarity=-9, inliers=-2
    )
    assert told(reasons_of(calibration, evidence)) == [
        ("intrinsics", (("facings", -10.0),)),
        ("depth unit", (("scale", 6.0),)),
        ("field of view or depth range", (("measured", -4.0),)),
        ("baseline", (("points", -3.5),)),
        ("traffic in the map", (("through", 8.0), ("front", 4.0))),
        ("calibration", (("margin", -5.0),)),
    ]


def test_every_feature_of_the_confidence_has_one_remedy():
    names = [name for _, features, _ in GROUPS for name in features]
    assert sorted(names) == sorted(set(FEATURES) - {"similarity", "frames", "log_share"})
    assert set(FEATURES) - set(UNWEIGHED) - {"frames"} <= set(names)


def test_no_remedy_is_what_build_map_does_anyway():
    """The vote against traffic is the default. A remedy once advised it."""
    (traffic,) = (remedy for check, _, remedy in GROUPS if check == "traffic in the map")
    assert "--no-traffic-vote" in traffic
    assert "with the traffic vote" not in traffic


def test_pictures_that_hold_too_little_to_register_speak_of_depth(calibration):
    (reason,) = reasons_of(calibration, None)
    assert (reason.check, reason.evidence) == ("depth", ())
    assert "depth.scale_m" in reason.remedy


def test_support_is_the_weighted_sum_of_inliers_and_similarity():
    weights = SupportWeights()
    assert support_of(0.5, 0.75) == 0.5 * weights.inliers + 0.75 * weights.similarity == 61.0


def test_a_depth_in_another_unit_is_the_first_reason_and_is_reported_once(calibration):
    evidence = evidence_of(facings=-10, scale=6)
    depth_m = np.full((4, 4), 5000, np.float32)
    unit, intrinsics = reasons_of(calibration, evidence, depth_m)
    assert (unit.check, unit.evidence, intrinsics.check) == ("depth unit", (), "intrinsics")
    assert "looks like millimetres; send depth.scale_m = 0.001" in unit.remedy
    assert told(reasons_of(calibration, None, depth_m)) == [("depth unit", ()), ("depth", ())]
    assert reasons_of(calibration, evidence, depth_m / np.float32(1000)) == reasons_of(calibration, evidence)
