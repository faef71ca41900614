import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model_training.calibration.bounds import bounded_thresholds, upper_bound
from model_training.calibration.labelled_frames import BLOCKS, LabelledFrames, blocks_of, frames_of, joined_frames
from model_training.calibration.own_rig import (
    LEAST_SCALE,
    calibration_error,
    fit_correction,
    learn_correction,
    log_odds_of,
    replaced_by,
    report_lines,
    support_of,
    weights_of,
    with_correction,
)
from service.confidence.features import FEATURES
from service.errors import DatasetError
from service.maps.calibration import corrected_log_odds, probability
from service.maps.rig_key import RigKey
from service.option_limits import FALSE_ACCEPT_RATE, SAFE_CONFIDENCE

KEY = RigKey(width=640, height=480, fx=320.0, fy=320.0, cx=319.5, cy=239.5)
SHARE = FEATURES.index("log_share")


def flags(*values):
    return np.array(values, bool)


@pytest.mark.parametrize(
    ("events", "trials", "bound"),
    [
        (0, 26, 1 - 0.05 ** (1 / 26)),  # 0.109: no event in n trials leaves (1 - p)^n = 0.05
        (0, 1, 0.95),
        (1, 10, 0.3941633),
        (26, 26, 1.0),
        (0, 0, 1.0),
    ],
)
def test_clopper_pearson_bound_by_hand(events, trials, bound):
    assert upper_bound(events, trials) == pytest.approx(bound, abs=1e-6)


def test_26_trials_without_an_event_bound_the_share_by_0_109():
    assert round(upper_bound(0, 26), 3) == 0.109


@pytest.mark.parametrize(
    ("frames", "rate", "line"),
    [
        (26, 0.01, "26 frames cannot support a rate of 0.01: the least rate they support is 0.11"),
        (298, 0.01, "298 frames cannot support a rate of 0.01: the least rate they support is 0.01"),
        (299, 0.01, None),
        (0, 0.5, "there are no frames, so no rate is supported"),
    ],
)
def test_frames_that_cannot_support_a_rate_are_named(frames, rate, line):
    assert support_of(frames, rate, "frames") == line


def test_without_frames_the_prior_keeps_scale_1_and_offset_0():
    assert fit_correction(np.zeros(0), flags(), np.zeros(0)) == (1.0, 0.0)


def test_one_wrong_answer_at_even_odds_moves_the_offset_only():
    """p(x) + x = 0 at -0.40105 under a prior of one nat, as in the site check. At log odds of 0 the scale has no effect."""
    scale, offset = fit_correction(np.zeros(1), flags(0), np.ones(1))
    assert scale == pytest.approx(1)
    assert offset == pytest.approx(-0.40105, abs=1e-4)


def test_frames_that_agree_with_the_confidence_change_nothing():
    scale, offset = fit_correction(np.r_[np.full(4, np.log(3)), np.zeros(2)], flags(1, 1, 1, 0, 1, 0), np.ones(6))
    assert (scale, offset) == (pytest.approx(1, abs=1e-6), pytest.approx(0, abs=1e-6))


def test_many_frames_overrule_the_prior():
    rng = np.random.default_rng(0)
    odds = rng.normal(0, 4, 40_000)
    right = rng.random(len(odds)) < probability(0.5 * odds - 1.0)
    scale, offset = fit_correction(odds, right, np.ones(len(odds)))
    assert scale == pytest.approx(0.5, abs=0.02)
    assert offset == pytest.approx(-1.0, abs=0.05)


def test_wrong_labels_count_less_if_they_are_expected():
    odds, right = np.full(20, 8.0), np.arange(20) > 0
    without, _ = fit_correction(odds, right, np.ones(20))
    expected, _ = fit_correction(odds, right, np.ones(20), label_noise=0.05)
    assert without < expected <= 1.05


odds_and_labels = st.lists(st.tuples(st.floats(-25, 25), st.booleans()), max_size=40).map(
    lambda rows: (np.array([row[0] for row in rows]), np.array([row[1] for row in rows], bool))
)


@settings(max_examples=30)
@given(odds_and_labels)
def test_every_fit_keeps_the_order_of_answers(rows):
    odds, right = rows
    scale, offset = fit_correction(odds, right, np.ones(len(odds)))
    assert scale >= LEAST_SCALE
    order = np.argsort(odds, kind="stable")
    assert (np.diff((scale * odds + offset)[order]) >= 0).all()


@settings(max_examples=30)
@given(odds_and_labels)
def test_a_fit_that_may_only_lower_raises_nothing_and_keeps_the_order(rows):
    odds, right = rows
    scale, offset = fit_correction(odds, right, np.ones(len(odds)), lower_only=True)
    assert scale >= LEAST_SCALE
    grid = np.linspace(-25, 25, 101)
    confidence = probability(corrected_log_odds(grid, scale, offset, lower_only=True))
    assert (confidence <= probability(grid) + 1e-12).all()
    assert (np.diff(confidence) >= 0).all()


def test_a_fit_that_may_only_lower_corrects_the_upper_end_alone():
    """Log odds of 6 were right nine times in ten (2.2), those of -4 as often as they said."""
    odds = np.r_[np.full(200, 6.0), np.full(200, -4.0)]
    right = np.r_[np.arange(200) % 10 > 0, np.arange(200) % 55 == 0]
    scale, offset = fit_correction(odds, right, np.ones(400), lower_only=True)
    confidence = probability(corrected_log_odds(np.array([6.0, -4.0]), scale, offset, lower_only=True))
    assert confidence[0] == pytest.approx(0.9, abs=0.02)
    assert confidence[1] == pytest.approx(probability(np.array(-4.0)), abs=0.01)


def test_weights_by_hand():
    """Three frames in the map weigh as much as one outside it: shares 1/6 and 1/2; their squares sum to 1/3, so 3 effective frames."""
    np.testing.assert_allclose(weights_of(flags(0, 0, 0, 1)), [0.5, 0.5, 0.5, 1.5])
    np.testing.assert_array_equal(weights_of(flags(0, 0)), [1, 1])
    np.testing.assert_array_equal(weights_of(flags(1)), [1])


@given(st.integers(1, 50), st.integers(1, 50))
def test_both_sorts_of_frames_have_the_same_weight_and_no_more_than_all_frames(inside, outside):
    is_out = np.arange(inside + outside) >= inside
    weight = weights_of(is_out)
    assert weight[is_out].sum() == pytest.approx(weight[~is_out].sum())
    assert weight.sum() <= inside + outside + 1e-9


@pytest.mark.parametrize(
    ("confidence", "right", "weight", "bins", "error"),
    [
        ([0.1, 0.2, 0.8, 0.9], [0, 0, 1, 1], [1, 1, 1, 1], 2, 0.15),
        ([0.1, 0.2, 0.8, 0.9], [0, 0, 1, 1], [1, 1, 1, 1], 1, 0.0),
        ([0.9, 0.1], [1, 0], [3, 1], 1, 0.75 * 0.1 - 0.25 * 0.1),
        ([0.5], [1], [7], None, 0.5),
    ],
)
def test_calibration_error_by_hand(confidence, right, weight, bins, error):
    found = calibration_error(np.array(confidence), flags(*right), np.array(weight, float), bins=bins)
    assert found == pytest.approx(error)


def test_blocks_are_consecutive_and_of_equal_length():
    assert blocks_of(10).tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    assert blocks_of(3).tolist() == [0, 1, 3]
    assert len(blocks_of(0)) == 0
    assert blocks_of(1000).max() == BLOCKS - 1


@pytest.fixture(scope="module")
def stock(calibration_json, calibration_of):
    """The first feature is the log odds. The default rate has the threshold 0.4."""
    term = {"feature": FEATURES[0], "knots": [-30.0, 30.0], "log_odds": [-30.0, 30.0]}
    thresholds = [{"false_accept_rate": FALSE_ACCEPT_RATE, "confidence": 0.4}]
    return calibration_of(right=calibration_json()["right"] | {"terms": [term]}, thresholds=thresholds)


def labelled(odds, right, outside=None):
    evidence = np.zeros((len(odds), len(FEATURES)))
    evidence[:, 0] = odds
    outside = np.zeros(len(odds), bool) if outside is None else np.array(outside, bool)
    block = np.zeros(len(odds), np.int64)
    for sort in (outside, ~outside):  # a block has frames of both sorts, as in a recording
        block[sort] = blocks_of(int(sort.sum()))
    return LabelledFrames(evidence, np.array(right, bool), outside, block)


def learned(stock, frames, source="drive", **more):
    return learn_correction(stock, frames, source=source, measured_on="a test", **more)


def overconfident():
    """Ten nats were said for answers that are right nine times in ten."""
    return labelled(np.full(100, 10.0), np.arange(100) % 10 > 0)


def test_confidence_that_is_too_high_is_lowered_and_the_counts_are_kept(stock):
    found = learned(stock, overconfident())
    assert probability(np.array([found.scale * 10 + found.offset]))[0] == pytest.approx(0.9, abs=0.05)
    assert (found.frames, found.right, found.outside) == (100, 90, 0)
    assert found.error_before == pytest.approx(0.1, abs=0.001)
    assert found.error_after < 0.05
    assert (found.accepted, found.accepted_wrong) == (100, 10)
    assert found.wrong_share_upper == pytest.approx(upper_bound(10, 100))
    assert (found.outside_accepted, found.outside_share_upper) == (0, 1.0)


def underconfident(outside):
    """One to three was said for answers that are all right; out-of-map answers have eight nats against them."""
    odds = np.r_[np.full(100, -1.0), np.full(outside, -8.0)]
    return labelled(odds, odds > -2, odds < -2)


def test_only_out_of_map_frames_of_the_camera_allow_to_accept_more(stock):
    threshold = np.log(0.4 / 0.6)
    raised = learned(stock, underconfident(100))
    assert raised.scale * threshold + raised.offset > threshold
    assert not raised.lower_only
    assert (raised.accepted, raised.outside_accepted) == (100, 0)
    for frames, source in ((underconfident(0), "drive"), (underconfident(100), "rendered")):
        found = learned(stock, frames, source)
        assert found.lower_only
        assert found.accepted == 0


def test_a_correction_may_not_let_through_more_out_of_map_frames_than_the_rate(stock):
    """One in ten out-of-map answers has the log odds of the right ones: a higher confidence would accept them too."""
    odds = np.r_[np.full(100, -1.0), np.where(np.arange(100) % 10 == 0, -1.0, -8.0)]
    right = np.arange(200) < 100
    assert fit_correction(odds, right, np.ones(200))[1] > 0.5
    found = learned(stock, labelled(odds, right, ~right))
    assert found.lower_only
    assert found.outside_accepted == 0


def test_a_correction_that_does_not_help_held_out_blocks_is_left_out(stock):
    """The share of right answers differs from block to block, so no block predicts the next."""
    rng = np.random.default_rng(3)
    odds = np.log(3) + rng.normal(0, 0.1, 20)
    found = learned(stock, labelled(odds, np.tile([1, 1, 1, 0], 5)))
    assert (found.scale, found.offset) == (1.0, 0.0)
    assert found.error_after == found.error_before


def test_an_earlier_correction_does_not_count(stock):
    once = with_correction(stock, learned(stock, overconfident(), name="mule", made_for=KEY))
    (rig,) = once.rigs
    for each in (once, stock.model_copy(update={"rig": rig})):
        assert learned(each, overconfident(), name="mule", made_for=KEY) == rig


def test_another_rig_is_added_and_the_same_rig_replaced(stock):
    wide, again = KEY.model_copy(update={"fx": 200.0}), KEY.model_copy(update={"fx": 325.0, "max_range_m": 20.0})
    first, second, third = (
        learned(stock, overconfident(), name=name, made_for=rig)
        for name, rig in (("first", KEY), ("second", wide), ("third", again))
    )
    both = with_correction(with_correction(stock, first), second)
    assert both.rigs == (first, second)
    assert replaced_by(both, third) == (first,)
    assert with_correction(both, third).rigs == (second, third)
    with pytest.raises(ValueError, match="made_for is missing"):
        with_correction(stock, learned(stock, overconfident()))


def test_a_correction_of_an_earlier_release_stays(stock):
    old = stock.model_copy(update={"rig": learned(stock, overconfident())})
    new = with_correction(old, learned(stock, overconfident(), made_for=KEY))
    assert (new.rig, len(new.rigs)) == (old.rig, 1)


def separated(outside):
    """Answers in the map have log odds of 5. Those outside have -8 to -2, the last one the largest."""
    odds = np.r_[np.full(50, 5.0), np.linspace(-8, -2, outside)]
    return labelled(odds, odds > 0, odds < 0)


def test_thresholds_of_a_recording_by_hand(stock):
    """Of 100 out-of-map frames the bound of 0 accepted ones is 3.0 %, of 1 4.7 %, of 2 6.2 %, of 5 10.2 %: 0, 1 and 4 may pass."""
    frames = separated(100)
    found = learned(stock, frames, false_accept_rate=0.03)
    assert [each.false_accept_rate for each in found.thresholds] == [0.03, 0.05, 0.1]
    corrected = stock.model_copy(update={"rig": found}).confidence(frames.evidence[frames.outside])
    passed = [int((corrected >= each.confidence).sum()) for each in found.thresholds]
    assert passed == [0, 1, 4]
    assert [each.confidence for each in found.thresholds] == pytest.approx(corrected[[-1, -2, -5]], rel=1e-9)
    (line, *_) = [line for line in report_lines(found) if line.startswith("threshold")]
    assert line == (
        f"threshold for a false-accept rate of 0.03: confidence {found.thresholds[0].confidence:.3f} (100 out-of-map frames, 95 %)"
    )


def test_a_rate_between_those_of_a_calibration_has_a_threshold_too(stock):
    found = learned(stock, separated(100), false_accept_rate=0.04)
    assert [each.false_accept_rate for each in found.thresholds] == [0.03, 0.04, 0.05, 0.1]


def test_without_a_rate_the_thresholds_of_the_map_stay(stock):
    assert learned(stock, separated(400)).thresholds == ()


def test_at_the_default_rate_the_threshold_is_at_least_the_safe_confidence(stock):
    found = learned(stock, separated(299), false_accept_rate=FALSE_ACCEPT_RATE)
    assert found.thresholds[0].false_accept_rate == FALSE_ACCEPT_RATE
    assert found.thresholds[0].confidence == SAFE_CONFIDENCE
    assert found.thresholds[1].confidence < SAFE_CONFIDENCE
    assert found.accepted == 50


@pytest.mark.parametrize(
    ("outside", "rate", "message"),
    [
        (
            298,
            0.01,
            r"0\.01: it needs 299 out-of-map frames, and the recording has 298; .* \(a rate of 0\.011 or more\)",
        ),
        (26, 0.05, r"0\.05: it needs 59 out-of-map frames, and the recording has 26; .* \(a rate of 0\.11 or more\)"),
        (0, 0.5, r"0\.5: it needs 5 out-of-map frames, and the recording has 0; .* \(no rate\)"),
    ],
)
def test_a_rate_that_the_frames_cannot_support_is_refused_with_the_number_that_it_needs(stock, outside, rate, message):
    with pytest.raises(DatasetError, match=message) as caught:
        learned(stock, separated(outside), false_accept_rate=rate)
    assert caught.value.field == "false_accept_rate"


def test_thresholds_accept_what_thresholds_of_the_confidence_without_the_correction_accept(stock):
    """The correction saw the frames, but the stock confidence did not. So the bound of the latter holds."""
    rng = np.random.default_rng(5)
    odds = np.r_[rng.normal(8, 2, 60), rng.normal(0, 3, 100)]
    frames = labelled(odds, (np.arange(160) < 60) & (rng.random(160) < 0.8), np.arange(160) >= 60)
    found = learned(stock, frames, false_accept_rate=0.03)
    assert (found.scale, found.offset) != (1.0, 0.0)
    before = stock.confidence(frames.evidence)
    after = stock.model_copy(update={"rig": found}).confidence(frames.evidence)
    plain = bounded_thresholds(before[frames.outside], np.full(100, 0.01), (0.03, 0.05, 0.1))
    for one, other in zip(plain, found.thresholds, strict=True):
        np.testing.assert_array_equal(before >= one.confidence, after >= other.confidence)


def test_an_answer_without_more_than_half_of_the_support_is_not_accepted(stock):
    frames = overconfident()
    frames.evidence[:40, SHARE] = np.log(0.5)
    assert learned(stock, frames).accepted == 60


def test_frames_outside_the_map_alone_are_refused(stock):
    with pytest.raises(DatasetError, match="a test: no frame in the map could be registered and labelled"):
        learned(stock, labelled([0.0, 1.0], [0, 0], [1, 1]))


def test_the_report_says_what_the_frames_cannot_support(stock):
    odds = np.r_[np.full(26, 5.0), np.full(26, -5.0)]
    lines = report_lines(learned(stock, labelled(odds, odds > 0, odds < 0)))
    assert lines[0] == "frames: 52 labelled, 26 with a right answer, 26 out-of-map"
    assert lines[3] == "accepted in the map: 26, 0 of them wrong; upper bound of the share 0.11 (95 %)"
    assert lines[-2:] == [
        "not supported: 26 accepted frames cannot support a rate of 0.01: the least rate they support is 0.11",
        f"not supported: 26 out-of-map frames cannot support a rate of {FALSE_ACCEPT_RATE:g}: the least rate they support is 0.11",
    ]


def test_frames_without_evidence_are_left_out_and_out_of_map_frames_are_never_right():
    row = np.ones(len(FEATURES))
    found = frames_of([row, None, row * np.nan, row], flags(1, 1, 1, 1), flags(0, 0, 0, 1), np.arange(4))
    assert (found.right.tolist(), found.outside.tolist(), found.block.tolist()) == (
        [True, False],
        [False, True],
        [0, 3],
    )
    assert len(joined_frames([found, found])) == 4
    assert len(frames_of([None], flags(1), flags(0), np.arange(1))) == 0


def test_log_odds_by_hand():
    np.testing.assert_allclose(log_odds_of(np.array([0.5, 0.75])), [0, np.log(3)])
