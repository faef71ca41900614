from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.confidence.decision import calibration_for, decide, require_promise
from service.confidence.features import FEATURES
from service.errors import RequestError
from service.geometry.camera import PinholeCamera
from service.retrieval.query import Query


def odds(p):
    return float(np.log(p / (1 - p)))


@pytest.fixture(scope="module")
def decided(calibration_json, calibration_of):
    """Decide with one feature, whose value is the log odds of a right answer, and with log odds of a known place."""

    def made(right, known=0.5, rate=0.01, *, share=1.0, prior_nats=0.0, **changed):
        first = {"feature": FEATURES[0], "knots": [-20.0, 20.0], "log_odds": [-20.0, 20.0]}
        good = calibration_json()
        calibration = calibration_of(
            right=good["right"] | {"terms": [first]}, known=good["known"] | {"bias": odds(known)}, **changed
        )
        evidence = np.zeros(len(FEATURES))
        evidence[0], evidence[FEATURES.index("log_share")] = odds(right), np.log(share)
        return decide(calibration, evidence, rate, prior_nats=prior_nats)

    return made


@pytest.mark.parametrize(
    ("right", "known", "rate", "status"),
    [
        (0.51, 0.9, 0.01, "LOCALIZED"),  # the threshold for one false accept in a hundred is 0.5
        (0.49, 0.9, 0.01, "AMBIGUOUS"),
        (0.49, 0.1, 0.01, "OUT_OF_MAP"),
        (0.51, 0.1, 0.01, "LOCALIZED"),  # who is sure of the pose need not ask whether it is in the map
        (0.89, 0.9, 0.001, "AMBIGUOUS"),  # and for one in a thousand 0.9
        (0.91, 0.9, 0.001, "LOCALIZED"),
        (0.49, 0.51, 0.01, "AMBIGUOUS"),
        (0.49, 0.49, 0.01, "OUT_OF_MAP"),
    ],
)
def test_the_status_follows_from_the_confidence_and_whether_the_place_is_in_the_map(
    decided, right, known, rate, status
):
    found = decided(right, known, rate)
    assert found.status == status
    assert found.confidence == pytest.approx(right)
    assert isinstance(found.confidence, float)


def test_confidence_at_the_threshold_is_accepted_and_equal_odds_of_the_place_are_ambiguous(decided):
    accepted = decided(0.5, thresholds=[{"false_accept_rate": 0.01, "confidence": 0.5}])
    refused = decided(0.5, 0.5, thresholds=[{"false_accept_rate": 0.01, "confidence": 0.51}])
    assert (accepted.status, refused.status) == ("LOCALIZED", "AMBIGUOUS")


@pytest.mark.parametrize("rate", [0.001, 0.5])
def test_without_evidence_nothing_speaks_for_any_place(calibration_of, rate):
    found = decide(calibration_of(), None, rate)
    assert (found.status, found.confidence) == ("OUT_OF_MAP", 0.0)


def test_the_maps_own_correction_counts_in_the_confidence_that_is_decided_on(decided):
    """0.95 is above the threshold of 0.9; 0.05 less of log odds than leads from there to 0.9 is still, 0.05 more is not."""
    enough = odds(0.95) - odds(0.9)
    for less, status in ((0.0, "LOCALIZED"), (enough - 0.05, "LOCALIZED"), (enough + 0.05, "AMBIGUOUS")):
        site = {"offset": -less, "queries": 10, "right": 5, "expected_calibration_error": 0.0}
        assert decided(0.95, rate=0.001, site=site).status == status


rate = st.floats(1e-6, 0.999)


@given(st.floats(0.02, 0.98), st.floats(0.02, 0.98), rate, rate)
def test_a_larger_false_accept_rate_never_refuses_more(decided, right, known, one, other):
    strict, lax = decided(right, known, min(one, other)), decided(right, known, max(one, other))
    assert strict.confidence == lax.confidence
    assert lax.status == "LOCALIZED" or strict.status == lax.status


@pytest.mark.parametrize(
    ("share", "known", "status"),
    [
        (1.0, 0.9, "LOCALIZED"),
        (0.51, 0.9, "LOCALIZED"),
        (0.5, 0.9, "AMBIGUOUS"),  # two that are alike
        (1 / 6, 0.9, "AMBIGUOUS"),
        (1 / 6, 0.1, "OUT_OF_MAP"),
    ],
)
def test_a_candidate_with_at_most_half_of_the_support_is_not_accepted_at_any_confidence(decided, share, known, status):
    found = decided(0.95, known, share=share)
    assert found.status == status
    assert found.confidence == pytest.approx(0.95)


@pytest.mark.parametrize(
    ("right", "known", "nats", "confidence"),
    [
        # Three to one against being in the map, times e^5: 148.4 / 3 to one. Right given known stays 0.1 / 0.25.
        (0.1, 0.25, 5.0, 0.4 * 148.413 / 151.413),
        (0.1, 0.25, np.log(3), 0.4 * 0.5),
        # As surely right as known: the confidence is that of being known.
        (0.25, 0.25, np.log(3), 0.5),
        # More surely right than known: a right answer is in the map, so the odds of being there are 3 to 2 at least. Times 3: 9 to 2.
        (0.6, 0.25, np.log(3), 9 / 11),
    ],
)
def test_a_prior_changes_the_odds_of_being_in_the_map_by_bayes_rule(decided, right, known, nats, confidence):
    assert decided(right, known, prior_nats=nats).confidence == pytest.approx(confidence, rel=1e-4)


def test_a_prior_turns_an_uncertain_answer_into_an_accepted_one_and_out_of_map_into_ambiguous(decided):
    assert decided(0.2, 0.25).status == "OUT_OF_MAP"
    assert decided(0.2, 0.25, prior_nats=5.0).status == "LOCALIZED"
    assert decided(0.02, 0.25, prior_nats=5.0).status == "AMBIGUOUS"


@given(st.floats(0.01, 0.99), st.floats(0.01, 0.99), st.floats(0, 10))
def test_a_prior_that_agrees_never_lowers_a_confidence_nor_makes_it_more_than_one(decided, right, known, nats):
    without = decided(right, known).confidence
    assert without - 1e-9 <= decided(right, known, prior_nats=nats).confidence <= 1


RIG = {
    "name": "mule",
    "made_for": {"width": 6, "height": 4, "fx": 3.0, "fy": 3.0, "cx": 2.5, "cy": 1.5},
    "scale": 1.0,
    "offset": -1.0,
    "lower_only": False,
    "source": "drive",
    "measured_on": "a drive",
    **dict.fromkeys(("frames", "right", "outside", "accepted", "accepted_wrong", "outside_accepted"), 60),
    **dict.fromkeys(("error_before", "error_after", "wrong_share_upper", "outside_share_upper"), 0.1),
    "thresholds": [{"false_accept_rate": 0.05, "confidence": 0.7}],
}


@pytest.fixture
def query():
    """The camera of the rig, with half of the field of view of a rig without a correction."""
    camera = PinholeCamera(6, 4, 3.0, 3.0, 2.5, 1.5)
    return Query(rgb=np.zeros((4, 6, 3), np.uint8), depth_m=np.zeros((4, 6), np.float32), camera=camera)


def test_the_calibration_for_a_query_has_the_correction_of_its_rig(calibration_of, query):
    calibration = calibration_of(rigs=[RIG])
    found = calibration_for(calibration, (query, query))
    assert found is not None
    assert found.rig == calibration.rigs[0]
    wide = replace(query, camera=replace(query.camera, fx=1.5, fy=1.5))
    for queries in ((wide,), (query, wide), (replace(query, baseline_m=0.1),), (replace(query, max_range_m=9.0),)):
        found = calibration_for(calibration, queries)
        assert found is not None
        assert found.rig is None
    assert calibration_for(None, (query,)) is None
    plain = calibration_of()
    assert calibration_for(plain, (query,)) is plain


@pytest.mark.parametrize(
    ("rate", "named", "least"),
    [
        (0.04, True, "0.05"),  # the recording supports 0.05 or more
        (0.05, True, None),
        (0.04, False, None),  # the default of the service is answered
        (0.0005, False, "0.001"),  # not below what the map supports
    ],
)
def test_a_named_rate_must_be_supported_by_the_recording_of_the_rig(calibration_of, query, rate, named, least):
    asking = replace(query, false_accept_rate=rate, rate_is_named=named)
    calibration = calibration_for(calibration_of(rigs=[RIG]), (asking,))
    if least is None:
        require_promise(calibration, asking)
        return
    with pytest.raises(RequestError, match=f"send {least} or more") as caught:
        require_promise(calibration, asking)
    assert caught.value.field == "options.false_accept_rate"


def test_without_thresholds_of_its_own_a_rig_has_those_of_the_map(calibration_of, query):
    asking = replace(query, false_accept_rate=0.001, rate_is_named=True)
    calibration = calibration_for(calibration_of(rigs=[RIG | {"thresholds": []}]), (asking,))
    assert calibration is not None
    require_promise(calibration, asking)
    assert calibration.threshold(0.001) == 0.9


def test_a_status_follows_from_the_threshold_of_the_rig(calibration_of, query):
    """Log odds of 2 become 1, a confidence of 0.731. At a rate of 5 % the map accepts 0.5, and the recording 0.7."""
    in_range = {"right": {"terms": [], "bias": 2.0}}
    for threshold, status in ((0.7, "LOCALIZED"), (0.75, "AMBIGUOUS")):
        rig = RIG | {"thresholds": [{"false_accept_rate": 0.05, "confidence": threshold}]}
        calibration = calibration_for(calibration_of(rigs=[rig], **in_range), (query,))
        assert calibration is not None
        found = decide(calibration, np.zeros(len(FEATURES)), 0.05)
        assert (found.status, found.confidence) == (status, pytest.approx(0.7310586))
