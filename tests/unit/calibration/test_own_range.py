import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model_training.calibration.bounds import WRONG_RATE, trials_needed
from model_training.calibration.labelled_frames import LabelledFrames
from model_training.calibration.own_range import acceptable, range_lines, ranges_of
from model_training.calibration.own_rig import learn_correction
from service.confidence.features import FEATURES
from service.confidence.fitted_range import extrapolated
from service.maps.calibration import FeatureRange
from service.option_limits import FALSE_ACCEPT_RATE

MARGIN, NOISE = FEATURES.index("margin"), FEATURES.index("log_noise")
#: The calibration data have a noise of -6 to -4, and the range is 0.2 wider at both ends.
QUIET, LOUD = -5.0, -3.0
NEEDED = trials_needed(WRONG_RATE)


@pytest.fixture(scope="module")
def stock(calibration_json, calibration_of):
    """The margin is the log odds, and the noise only has a range."""
    terms = [
        {"feature": "margin", "knots": [-30.0, 30.0], "log_odds": [-30.0, 30.0]},
        {"feature": "log_noise", "knots": [-6.0, -4.0], "log_odds": [0.0, 0.0]},
    ]
    thresholds = [{"false_accept_rate": FALSE_ACCEPT_RATE, "confidence": 0.9}]
    return calibration_of(right=calibration_json()["right"] | {"terms": terms, "bias": 0.0}, thresholds=thresholds)


def recording(right, outside=NEEDED, *, wrong=0, noise=LOUD, wrong_noise=LOUD, outside_odds=-8.0):
    """Return frames of a rig: right answers, wrong ones, and out-of-map frames. Right and wrong ones have log odds of 8."""
    odds = np.r_[np.full(right + wrong, 8.0), np.full(outside, outside_odds)]
    evidence = np.zeros((len(odds), len(FEATURES)))
    evidence[:, MARGIN] = odds
    evidence[:, NOISE] = np.r_[np.full(right, noise), np.full(wrong, wrong_noise), np.full(outside, noise)]
    number = np.arange(len(odds))
    return LabelledFrames(evidence, number < right, number >= right + wrong, number % 5)


def learned(stock, frames, source="drive"):
    return learn_correction(stock, frames, source=source, measured_on="a test")


def test_a_recording_without_an_error_widens_the_range_of_its_rig(stock):
    frames = recording(NEEDED)
    found = learned(stock, frames)
    assert found.ranges == (FeatureRange(feature="log_noise", least=LOUD, most=LOUD),)
    assert (found.accepted, found.accepted_wrong, found.outside_accepted) == (NEEDED, 0, 0)
    corrected = stock.model_copy(update={"rig": found})
    assert extrapolated(stock, frames.evidence[0]) != ()
    assert extrapolated(corrected, frames.evidence[0]) == ()
    assert acceptable(corrected, frames).all()
    louder = frames.evidence[0].copy()
    louder[NOISE] = LOUD + 0.01
    assert [name for name, _ in extrapolated(corrected, louder)] == ["log_noise"]


@pytest.mark.parametrize(
    "frames",
    [
        recording(NEEDED - 1),  # too few right answers
        recording(NEEDED, NEEDED - 1),  # too few out-of-map frames
        recording(NEEDED, 0),
        recording(NEEDED + 1, wrong=1, noise=LOUD),  # one wrong answer needs 473 frames
        recording(NEEDED, 2 * NEEDED, outside_odds=8.0),  # the confidence does not tell out-of-map frames from others
    ],
)
def test_a_recording_that_cannot_support_both_rates_widens_nothing(stock, frames):
    found = learned(stock, frames)
    assert found.ranges == ()
    assert found.accepted == 0


def test_wrong_answers_of_the_wider_range_cannot_hide_among_many_in_range(stock):
    """Ten thousand answers in range are right. Of the ten that only the wider range accepts, one is wrong."""
    inside, gained = recording(10_000, noise=QUIET), recording(9, 0, wrong=1)
    parts = [
        np.concatenate([getattr(each, name) for each in (inside, gained)])
        for name in ("evidence", "right", "outside", "block")
    ]
    found = learned(stock, LabelledFrames(*parts))
    assert found.wrong_share_upper < WRONG_RATE
    assert (found.ranges, found.accepted, found.accepted_wrong) == ((), 10_000, 0)


def test_rendered_images_never_widen_the_range(stock):
    assert learned(stock, recording(NEEDED), "rendered").ranges == ()


def test_a_recording_in_range_has_no_range_of_its_own(stock):
    found = learned(stock, recording(NEEDED, noise=QUIET))
    assert (found.ranges, found.accepted) == ((), NEEDED)
    assert range_lines(stock, found, recording(NEEDED, noise=QUIET)) == []


@settings(max_examples=20)
@given(st.lists(st.floats(-9.0, -1.0), min_size=1, max_size=30))
def test_the_ranges_hold_all_right_answers_and_nothing_beyond_them(stock, noises):
    frames = recording(len(noises), 3, wrong=2, wrong_noise=0.0)
    frames.evidence[: len(noises), NOISE] = noises
    found = ranges_of(stock, frames)
    away = [each for each in noises if each < -6.2 or each > -3.8]
    assert [(each.least, each.most) for each in found] == ([(min(noises), max(noises))] if away else [])


def test_the_command_says_how_many_frames_are_out_of_range_and_what_widens_it(stock):
    frames = recording(NEEDED)
    widened = range_lines(stock, learned(stock, frames), frames)
    assert widened == [
        f"outside the range of the calibration data: {NEEDED} of {NEEDED} frames in the map (log_noise in {NEEDED})",
        "range widened for this rig: log_noise -3 to -3",
    ]
    few = recording(20)
    refused = range_lines(stock, learned(stock, few), few)
    assert refused[0].startswith("outside the range of the calibration data: 20 of 20 frames")
    assert "never LOCALIZED at a false-accept rate of 0.01 or below" in refused[1]
    assert f"each needs {NEEDED} frames" in refused[1]
    assert "--drive" in range_lines(stock, learned(stock, few, "rendered"), few)[1]
