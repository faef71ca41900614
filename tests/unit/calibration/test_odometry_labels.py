"""A hand-made track: twenty frames along x, 2 m apart. The odometry has its own frame, turned and shifted."""

import numpy as np
import pytest

from model_training.calibration.odometry_labels import labels_by_odometry
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from

COUNT = 20
T_ODOM_MAP = transform_from(rotation_z(2.0), np.array([40.0, -7.0, 1.0]))


def track(count=COUNT):
    return np.stack([transform_from(R_BODY_OPTICAL, np.array([2.0 * k, 0.0, 1.5])) for k in range(count)])


def labels(off, *, noise=0.01, sigma_m=0.02, truth=None):
    """Labels of answers that are off by (x, y) metres; None for no answer."""
    truth = track() if truth is None else truth
    T_answer, covariance = truth.copy(), np.tile(np.diag([sigma_m**2] * 3 + [1e-6] * 3), (len(truth), 1, 1))
    for k, by in off.items():
        if by is None:
            T_answer[k] = np.nan
        else:
            T_answer[k, :2, 3] += by
    return labels_by_odometry(T_answer, covariance, T_ODOM_MAP @ truth, noise)


def numbers(of):
    return np.flatnonzero(of).tolist()


def test_answers_that_follow_the_odometry_are_right():
    found = labels({})
    assert found.right.all()
    np.testing.assert_allclose(found.reference_xy, track()[:, :2, 3], atol=1e-9)


def test_an_answer_that_leaves_the_track_is_wrong_and_its_neighbours_stay_right():
    found = labels({7: (0.0, 5.0), 12: (300.0, -80.0)})
    assert numbers(found.wrong) == [7, 12]
    assert found.right.sum() == COUNT - 2


def test_the_frames_own_answer_is_not_part_of_its_reference():
    assert labels({7: (0.0, 5.0)}).reference_xy[7] == pytest.approx([14.0, 0.0], abs=1e-9)


@pytest.mark.parametrize(("off_m", "label"), [(0.5, "right"), (1.0, "none"), (1.6, "wrong")])
def test_an_answer_near_1_m_has_no_label(off_m, label):
    found = labels({9: (off_m, 0.0)})
    assert (found.right[9], found.wrong[9]) == {"right": (1, 0), "none": (0, 0), "wrong": (0, 1)}[label]


def test_noisier_odometry_leaves_more_answers_without_a_label():
    """At 2 m to the next frame, 20 % are 0.4 m: no answer is certainly within 1 m of a reference of 0.45 m by two deviations."""
    assert labels({9: (0.3, 0.0)}, noise=0.01).right[9]
    assert not labels({9: (0.3, 0.0)}, noise=0.2).right[9]


def test_an_answer_with_a_large_covariance_does_not_blur_the_reference():
    found = labels({})
    assert found.sigma_m.max() < 0.15


def test_one_in_three_right_answers_are_enough_if_the_others_scatter():
    rng = np.random.default_rng(5)
    off = {k: rng.uniform(-200, 200, 2) for k in range(COUNT) if k % 3}
    found = labels(off)
    assert numbers(found.wrong) == sorted(off)
    assert numbers(found.right) == [k for k in range(COUNT) if not k % 3]


def test_scattered_answers_beyond_the_map_are_wrong_by_the_track_before_them():
    """The last 30 frames answer at random: nobody agrees there, and the odometry carries the reference on."""
    truth, rng = track(60), np.random.default_rng(1)
    off = {k: rng.uniform(100, 900, 2) for k in range(30, 60)}
    found = labels(off, truth=truth)
    assert numbers(found.wrong) == sorted(off)
    assert found.sigma_m[59] > found.sigma_m[40] > found.sigma_m[10]
    np.testing.assert_allclose(found.reference_xy[59], truth[59, :2, 3], atol=0.5)


def test_answers_that_never_agree_have_no_label():
    rng = np.random.default_rng(2)
    found = labels({k: rng.uniform(-500, 500, 2) for k in range(COUNT)})
    assert not found.right.any()
    assert not found.wrong.any()
    assert np.isnan(found.reference_xy).all()


@pytest.mark.parametrize(("aliases", "is_known"), [(10, False), (5, True)])
def test_a_second_group_of_more_than_half_the_size_leaves_no_reference(aliases, is_known):
    chosen = np.linspace(0, COUNT - 1, aliases).astype(int)
    found = labels({int(k): (50.0, 0.0) for k in chosen})
    assert found.right.any() == is_known
    assert set(numbers(found.wrong)) <= set(chosen.tolist())


def test_an_offset_that_most_answers_share_is_not_seen():
    """The limit of labels without ground truth."""
    found = labels(dict.fromkeys(range(COUNT), (30.0, 0.0)))
    assert found.right.all()


def test_a_frame_without_an_answer_has_no_label_but_a_reference():
    found = labels({4: None})
    assert not found.right[4]
    assert not found.wrong[4]
    assert found.reference_xy[4] == pytest.approx([8.0, 0.0], abs=1e-9)


def test_an_answer_that_looks_another_way_does_not_agree():
    truth = track()
    T_answer = truth.copy()
    for k in range(0, COUNT, 2):
        T_answer[k, :3, :3] = rotation_z(np.deg2rad(40.0)) @ T_answer[k, :3, :3]
    covariance = np.tile(np.diag([4e-4] * 3 + [1e-6] * 3), (COUNT, 1, 1))
    found = labels_by_odometry(T_answer[:4], covariance[:4], truth[:4], 0.01)
    assert not found.right.any()


def test_no_frames_have_no_labels():
    found = labels_by_odometry(np.zeros((0, 4, 4)), np.zeros((0, 6, 6)), np.zeros((0, 4, 4)), 0.01)
    assert len(found.right) == len(found.wrong) == len(found.reference_xy) == 0
