"""Given poses with errors, in a hall with known poses."""

import sys
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from model_training.importing.trajectory import Trajectory
from model_training.odometry.align_poses import aligned_with_scans, usual_poses
from model_training.odometry.pose_graph import held_near
from service.errors import ExtraMissingError
from service.geometry.rigid import inverse, rotation_z, transform_from

from .conftest import HallDrive, pose_at

pytest.importorskip("gtsam", reason="needs the extra `mapping`")
pytest.importorskip("small_gicp", reason="needs the extra `mapping`")

STAMPS_S = np.arange(0.0, 1.401, 0.05)  # twice as often as the scans


def given(error_of):
    """Return poses with an error (x, y) at each time."""
    poses = np.stack([pose_at(t) for t in STAMPS_S])
    poses[:, :2, 3] += np.array([error_of(t) for t in STAMPS_S])
    return Trajectory(STAMPS_S, poses, "given")


def swinging(t):
    """Return a lateral error of 0.15 m, once per second: steps between scans are wrong by up to 0.09 m."""
    return 0.15 * np.array([np.sin(2 * np.pi * t), np.cos(2 * np.pi * t)])


def steps(trajectory):
    T = trajectory.between(np.arange(0.0, 1.401, 0.1))
    return np.stack([(inverse(a) @ b)[:3, 3] for a, b in pairwise(T)])


def true_steps():
    return steps(Trajectory(STAMPS_S, np.stack([pose_at(t) for t in STAMPS_S]), "true"))


def test_steps_are_those_of_the_scans_and_the_whole_stays_where_it_was():
    wrong = given(swinging)
    found = aligned_with_scans(HallDrive(), wrong)
    assert found is not None
    before = np.linalg.norm(steps(wrong) - true_steps(), axis=1)
    after = np.linalg.norm(steps(found.trajectory) - true_steps(), axis=1)
    assert before.max() > 0.08
    assert after.max() < 0.03
    away = found.trajectory.T_map_vehicle[:, :3, 3] - wrong.T_map_vehicle[:, :3, 3]
    assert np.linalg.norm(away.mean(axis=0)) < 0.1
    assert (found.scans, len(found.trajectory.stamps_s)) == (15, len(STAMPS_S))
    assert found.most_step_m == pytest.approx(before.max(), abs=0.04)


def test_right_poses_stay_as_they_are():
    right = given(lambda _: np.zeros(2))
    found = aligned_with_scans(HallDrive(), right)
    assert found is not None
    np.testing.assert_allclose(found.trajectory.T_map_vehicle, right.T_map_vehicle, atol=0.03)


def test_the_lidar_may_stand_anywhere_on_the_vehicle():
    drive, T_vehicle_lidar = HallDrive(), transform_from(rotation_z(0.5), np.array([1.0, 0.2, 1.8]))
    drive.lidar = drive.lidar.model_copy(update={"T_vehicle_sensor": T_vehicle_lidar.tolist()})
    wrong = given(swinging).moved_by(T_vehicle_lidar)
    found = aligned_with_scans(drive, wrong)
    assert found is not None
    of_lidar = Trajectory(found.trajectory.stamps_s, found.trajectory.T_map_vehicle @ T_vehicle_lidar, "lidar")
    assert np.linalg.norm(steps(of_lidar) - true_steps(), axis=1).max() < 0.03


def test_a_single_scan_has_nothing_to_be_matched_to():
    assert aligned_with_scans(HallDrive(count_of_scans=1), given(swinging)) is None


def test_progress_ends_with_all():
    told = []
    aligned_with_scans(HallDrive(), given(swinging), report=lambda *each: told.append(each))
    assert told[-1] == ("poses", 15, 15)


def test_a_drift_is_held_by_given_poses():
    """Steps are 0.3 % too long over a kilometre. Without given poses the end would be 3 m wrong."""
    true = np.stack([transform_from(np.eye(3), np.array([2.0 * k, 0.0, 0.0])) for k in range(500)])
    drifted = true.copy()
    drifted[:, 0, 3] *= 1.003
    held = held_near(drifted, true)
    assert np.abs(held[:, 0, 3] - true[:, 0, 3]).max() < 1.2
    assert np.abs(np.diff(held[:, 0, 3]) - 2.0).max() < 0.0065  # steps stay those of the chain, nearly


@dataclass
class Raw(HallDrive):
    kind: str = "kitti-raw"


def test_only_formats_with_inertial_poses_are_aligned_by_default():
    wrong = given(swinging)
    assert usual_poses(Raw(), wrong, align=False) == (wrong, None)
    assert usual_poses(HallDrive(), wrong, align=False) == (wrong, None)
    for drive, align in ((Raw(), None), (HallDrive(), True)):
        poses, line = usual_poses(drive, wrong, align=align)
        assert poses is not wrong
        assert line is not None
        assert "aligned with 15 scans" in line


def test_poses_that_stay_are_named_with_the_option_that_corrects_them():
    wrong = given(swinging)
    poses, line = usual_poses(HallDrive(), wrong)
    assert poses is wrong
    assert line == (
        "poses are the recording's own; if they err by decimetres, --align corrects them with the scans (--no-align hides this line)"
    )
    assert usual_poses(HallDrive(kind="carla"), wrong) == (wrong, None)  # exact


def test_without_the_packages_poses_stay_and_a_line_says_so_unless_it_was_asked_for(monkeypatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    wrong = given(swinging)
    poses, line = usual_poses(Raw(), wrong)
    assert poses is wrong
    assert line is not None
    assert "pip install" in line
    assert line.startswith("--align is off: poses are the recording's own, which may be off by decimetres")
    with pytest.raises(ExtraMissingError, match="--no-align") as missing:
        usual_poses(Raw(), wrong, align=True)
    assert missing.value.field == "align"
