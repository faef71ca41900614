"""The filter over modes, with values worked out by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.rigid import rotation_y, transform_from
from service.localization.belief import (
    ALTERNATIVES,
    LEAST_WEIGHT,
    MISSED,
    MOST_MODES,
    NEW_M,
    NEW_RAD,
    ODOMETRY_STD,
    Belief,
    FrameCandidate,
    Mode,
    OdometryStd,
    Sighting,
    agrees,
    sighting_of,
    std_of_motion,
)

SMALL = np.diag([0.01**2] * 6)
#: A camera that looks along map x: its z axis is map x, its x axis is map -y.
LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


#: 2 m straight ahead: a whole new picture.
AHEAD = transform_from(np.eye(3), np.array([0.0, 0.0, NEW_M]))


def pose(x: float, y: float = 0.0) -> np.ndarray:
    return transform_from(LEVEL, np.array([x, y, 1.5]))


def candidate(x: float, probability: float = 0.0) -> FrameCandidate:
    return FrameCandidate(pose(x), SMALL, probability, 0.6, 0.8)


def sum_of(belief: Belief) -> float:
    return sum(mode.weight for mode in belief.modes) + belief.elsewhere + belief.outside


def test_the_first_frame_gives_the_belief_its_own_probabilities():
    """The prior has one half in the map and one half outside, as the calibration data, so the first frame decides alone."""
    belief = Belief().seen(Sighting((candidate(0.0, 0.7), candidate(50.0, 0.1)), elsewhere=0.1, outside=0.1))
    assert [mode.weight for mode in belief.modes] == pytest.approx([0.7, 0.1])
    assert (belief.elsewhere, belief.outside) == pytest.approx((0.1, 0.1))
    assert [mode.number for mode in belief.modes] == [0, 1]


def test_a_second_frame_that_agrees_raises_the_probability():
    """After 2 m: 0.5 x 2 x 0.5 = 0.5 against 0.25 x 0.25 twice, which is 0.8."""
    belief = Belief().seen(Sighting((candidate(0.0, 0.5),), elsewhere=0.25, outside=0.25))
    belief = belief.moved(AHEAD, kidnapped=0.0).seen(Sighting((candidate(2.0, 0.5),), elsewhere=0.25, outside=0.25))
    right, rest = 0.5 * ALTERNATIVES * 0.5, 0.25 * 0.25
    assert belief.modes[0].weight == pytest.approx(right / (right + 2 * rest))
    assert (belief.modes[0].unseen, belief.modes[0].news) == (0, 0.0)


def test_a_robot_that_stands_still_learns_nothing_from_the_same_picture():
    frame = Sighting((candidate(0.0, 0.5),), elsewhere=0.25, outside=0.25)
    belief = Belief().seen(frame)
    for _ in range(20):
        belief = belief.moved(np.eye(4), kidnapped=0.0).seen(frame)
    assert belief.modes[0].weight == pytest.approx(0.5)
    assert belief.modes[0].covariance[0, 0] == pytest.approx(0.01**2)


def test_many_small_steps_count_as_one_long_step():
    """20 steps of 0.1 m have the weight of one step of 2 m: the same odds of the mode against the outside."""
    step = transform_from(np.eye(3), np.array([0.0, 0.0, 0.1]))
    slow = Belief().seen(Sighting((candidate(0.0, 0.5),), 0.25, 0.25))
    for k in range(1, 21):
        slow = slow.moved(step, kidnapped=0.0).seen(Sighting((candidate(0.1 * k, 0.5),), 0.25, 0.25))
    fast = Belief().seen(Sighting((candidate(0.0, 0.5),), 0.25, 0.25)).moved(AHEAD, kidnapped=0.0)
    fast = fast.seen(Sighting((candidate(2.0, 0.5),), 0.25, 0.25))
    assert slow.modes[0].weight / slow.outside == pytest.approx(fast.modes[0].weight / fast.outside)


def test_a_turn_shows_another_picture_too():
    belief = Belief().seen(Sighting((candidate(0.0, 0.5),), 0.25, 0.25))
    turned = belief.moved(transform_from(rotation_y(NEW_RAD / 2), np.zeros(3)))
    assert turned.modes[0].news == pytest.approx(0.5)


def test_a_frame_that_finds_another_place_lowers_the_mode():
    """0.9 x 0.1 = 0.09 for the mode that nothing confirms, 0.05 x 0.8 = 0.04 for the new one, 0.005 for each rest."""
    belief = (
        Belief().seen(Sighting((candidate(0.0, 0.9),), 0.05, 0.05)).seen(Sighting((candidate(50.0, 0.8),), 0.1, 0.1))
    )
    total = 0.09 + 0.04 + 0.005 + 0.005
    assert [mode.weight for mode in belief.modes] == pytest.approx([0.09 / total, 0.04 / total])
    assert [(mode.number, mode.unseen) for mode in belief.modes] == [(0, 1), (1, 0)]


def test_a_candidate_that_is_unlikelier_than_all_other_places_confirms_nothing():
    belief = Belief().seen(Sighting((candidate(0.0, 0.9),), 0.05, 0.05))
    after = belief.seen(Sighting((candidate(50.0, 0.6), candidate(0.2, 0.01)), 0.3, 0.09))
    assert after.modes[0].unseen == 1
    np.testing.assert_array_equal(after.modes[0].T_map_camera, pose(0.0))


def test_equal_look_alikes_stay_equal():
    belief = Belief()
    for x in (0.0, 2.0, 4.0):
        belief = belief.moved(AHEAD).seen(Sighting((candidate(x, 0.4), candidate(50.0 + x, 0.4)), 0.1, 0.1))
    assert belief.modes[0].weight == pytest.approx(belief.modes[1].weight)
    assert belief.modes[0].weight < 0.5


def test_a_motion_moves_the_modes_and_widens_them():
    """2 m ahead: the odometry adds 0.02 + 0.03 x 2 = 0.08 m. The rotation of 0.01 rad adds 0.02 m across, and nothing along."""
    belief = Belief().seen(Sighting((candidate(3.0, 0.8),), 0.1, 0.1))
    mode = belief.moved(AHEAD).modes[0]
    np.testing.assert_allclose(mode.T_map_camera[:3, 3], [5.0, 0.0, 1.5], atol=1e-12)
    share, least_m, _, least_rad = ODOMETRY_STD
    of_odometry = (least_m + 2 * share) ** 2
    assert mode.covariance[0, 0] == pytest.approx(0.01**2 + of_odometry)
    assert mode.covariance[1, 1] == pytest.approx(0.01**2 + 0.02**2 + of_odometry)
    assert mode.covariance[5, 5] == pytest.approx(0.01**2 + least_rad**2)


def test_a_turn_counts_in_the_covariance_of_the_angle():
    mode = (
        Belief()
        .seen(Sighting((candidate(0.0, 0.8),), 0.1, 0.1))
        .moved(transform_from(rotation_y(0.5), np.zeros(3)))
        .modes[0]
    )
    _, _, share, least_rad = ODOMETRY_STD
    assert mode.covariance[5, 5] == pytest.approx(0.01**2 + (least_rad + share * 0.5) ** 2)


def test_told_standard_deviations_of_the_odometry_replace_the_usual_ones():
    """0.3 m and 0.05 rad in all directions, also for a robot that stands still. The 2 m ahead carry the angle of the mode along."""
    seen = Belief().seen(Sighting((candidate(3.0, 0.8),), 0.1, 0.1))
    told = OdometryStd(position_m=0.3, angle_rad=0.05)
    moved_on, stays = seen.moved(AHEAD, std=told).modes[0], seen.moved(np.eye(4), std=told).modes[0]
    assert moved_on.covariance[0, 0] == pytest.approx(0.01**2 + 0.3**2)
    assert moved_on.covariance[1, 1] == pytest.approx(0.01**2 + 0.02**2 + 0.3**2)
    assert moved_on.covariance[5, 5] == pytest.approx(0.01**2 + 0.05**2)
    np.testing.assert_allclose(np.diag(stays.covariance)[[0, 1, 2]], 0.01**2 + 0.3**2)
    assert np.diag(seen.moved(np.eye(4)).modes[0].covariance)[0] == pytest.approx(0.01**2)


def test_a_share_of_the_motion_replaces_the_usual_one():
    """A tenth of 2 m plus 0.02 m. Without a share it is 3 %: 0.08 m."""
    assert std_of_motion(AHEAD, 0.1).position_m == pytest.approx(0.22)
    assert std_of_motion(AHEAD).position_m == pytest.approx(0.08)
    assert std_of_motion(np.eye(4), 0.1) == OdometryStd(0.0, 0.0)


def test_somebody_may_have_carried_the_robot_away():
    belief = Belief().seen(Sighting((candidate(0.0, 0.8),), 0.1, 0.1)).moved(np.eye(4), kidnapped=0.1)
    assert (belief.modes[0].weight, belief.elsewhere, belief.outside) == pytest.approx((0.72, 0.14, 0.14))


def test_an_answer_of_several_frames_raises_its_mode_and_scales_the_rest():
    belief = Belief().seen(Sighting((candidate(0.0, 0.5), candidate(50.0, 0.3)), 0.1, 0.1)).raised(candidate(0.1, 0.9))
    assert [mode.weight for mode in belief.modes] == pytest.approx([0.9, 0.06])
    assert (belief.elsewhere, belief.outside) == pytest.approx((0.02, 0.02))
    assert belief.modes[0].number == 0


def test_an_answer_of_several_frames_elsewhere_becomes_a_mode_of_its_own():
    belief = Belief().seen(Sighting((candidate(0.0, 0.5),), 0.4, 0.1)).raised(candidate(50.0, 0.8))
    assert [(mode.number, mode.weight) for mode in belief.modes] == [(1, pytest.approx(0.8)), (0, pytest.approx(0.1))]


def test_an_answer_that_the_belief_is_surer_of_changes_nothing():
    belief = Belief().seen(Sighting((candidate(0.0, 0.9),), 0.05, 0.05))
    assert belief.raised(candidate(0.0, 0.8)) is belief


def test_a_frame_that_says_nothing_leaves_the_weights():
    belief = Belief().seen(Sighting((candidate(0.0, 0.9),), 0.05, 0.05)).unseen()
    assert (belief.modes[0].weight, belief.modes[0].unseen) == (pytest.approx(0.9), 1)


def test_weak_modes_return_to_the_rest_of_the_map():
    many = tuple(candidate(20.0 * k, 0.05) for k in range(MOST_MODES + 3))
    belief = Belief().seen(Sighting((*many, candidate(-50.0, LEAST_WEIGHT / 2)), elsewhere=0.2, outside=0.2))
    assert len(belief.modes) == MOST_MODES
    assert sum_of(belief) == pytest.approx(1.0)


def test_the_probabilities_of_one_frame():
    """A share of 0.8 and a confidence of 0.6: all candidates have 0.75 together, the second one 0.15; the rest of the map has 0.15."""
    found = sighting_of([candidate(0.0), candidate(50.0)], np.array([0.8, 0.2]), 0.6, 0.9)
    assert [each.probability for each in found.candidates] == pytest.approx([0.6, 0.15])
    assert (found.elsewhere, found.outside) == pytest.approx((0.15, 0.1))


def test_look_alikes_share_the_probability_whatever_the_confidence():
    """Six equal candidates: the confidence of 0.95 cannot mean the first one alone."""
    found = sighting_of([candidate(20.0 * k) for k in range(6)], np.full(6, 1 / 6), 0.95, 0.98)
    assert [each.probability for each in found.candidates] == pytest.approx([0.98 * (1 - MISSED) / 6] * 6)
    assert sum(each.probability for each in found.candidates) == pytest.approx(0.98 * (1 - MISSED))


def test_a_frame_without_candidates_tells_inside_from_outside_only():
    found = sighting_of([], np.zeros(0), 0.0, 0.3)
    assert (found.candidates, found.elsewhere, found.outside) == ((), 0.3, pytest.approx(0.7))


def test_agreement_needs_position_and_heading():
    mode = Mode(pose(0.0), SMALL, 0.9, 0, 0.6, 0.8)
    assert agrees(mode, pose(1.0))
    assert not agrees(mode, pose(1.1))
    wide = Mode(pose(0.0), np.diag([100.0**2] * 6), 0.9, 0, 0.6, 0.8)
    assert agrees(wide, pose(9.9))
    assert not agrees(wide, pose(10.1))
    turned = pose(0.0)
    turned[:3, :3] = turned[:3, :3] @ rotation_y(math.radians(16.0))
    assert not agrees(mode, turned)


@given(
    st.lists(
        st.tuples(
            st.lists(st.tuples(st.floats(-50, 50), st.floats(0.01, 1.0)), max_size=12),
            st.floats(0.0, 1.0),
            st.floats(0.0, 1.0),
        ),
        min_size=1,
        max_size=12,
    )
)
def test_every_belief_is_a_probability(frames):
    belief = Belief()
    step = transform_from(rotation_y(0.1), np.array([0.0, 0.0, 1.0]))
    for candidates, confidence, known in frames:
        support = np.array([share for _, share in candidates])
        order = np.argsort(-support)
        shares = support[order] / support.sum() if len(support) else support
        frame = sighting_of([candidate(candidates[k][0]) for k in order], shares, min(confidence, known), known)
        assert 0 <= frame.elsewhere <= 1
        assert sum(each.probability for each in frame.candidates) + frame.elsewhere + frame.outside == pytest.approx(1)
        belief = belief.moved(step).seen(frame)
        assert sum_of(belief) == pytest.approx(1)
        assert all(LEAST_WEIGHT <= mode.weight <= 1 + 1e-12 for mode in belief.modes)
        assert min(belief.elsewhere, belief.outside) >= 0
        assert len(belief.modes) <= MOST_MODES
        assert all(np.isfinite(mode.covariance).all() for mode in belief.modes)
