import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model_training.importing.pose_file import read_pose_file
from model_training.importing.trajectory import Trajectory
from service.errors import DatasetError
from service.geometry.rigid import rotation_z, transform_from


def turning(stamps, angles, xs):
    T = [transform_from(rotation_z(float(angle)), np.array([x, 0.0, 0.0])) for angle, x in zip(angles, xs, strict=True)]
    return Trajectory(np.array(stamps, np.float64), np.array(T), "turning")


def test_halfway_through_a_quarter_turn_is_an_eighth():
    T = turning([0, 1], [0, np.pi / 2], [0, 4]).at(0.5, sync="interpolate", tolerance_s=1.0)
    np.testing.assert_allclose(T, transform_from(rotation_z(np.pi / 4), np.array([2.0, 0, 0])), atol=1e-12)


def test_nearest_takes_a_pose_as_it_is_and_of_two_as_near_the_earlier():
    trajectory = turning([0, 1, 2], [0, 1, 2], [0, 10, 20])
    taken = [trajectory.at(s, sync="nearest", tolerance_s=0.5)[0, 3] for s in (0.5, 0.6, 1.5, 2.0)]
    assert taken == [0, 10, 10, 20]


@pytest.mark.parametrize("epoch_s", [0.0, 1_700_000_000.0])
def test_a_pose_at_the_tolerance_is_near_enough_also_in_doubles_since_1970(epoch_s):
    trajectory = turning(epoch_s + np.array([0.0, 0.2]), [0, 0], [0, 2])
    T = trajectory.at(epoch_s + 0.1, sync="interpolate", tolerance_s=0.1)
    assert T[0, 3] == pytest.approx(1.0, abs=1e-5)
    assert trajectory.at(epoch_s + 0.3, sync="nearest", tolerance_s=0.1)[0, 3] == 2.0


def test_a_gap_wider_than_the_tolerance_is_not_bridged():
    why = turning([0, 1], [0, 0], [0, 1]).at(0.95, sync="interpolate", tolerance_s=0.1)
    assert why == "no poses within 0.1 s before and after"


@pytest.mark.parametrize(("stamp_s", "why"), [(-0.01, "before the first pose"), (1.01, "after the last pose")])
def test_nothing_is_made_up_beyond_the_ends(stamp_s, why):
    assert why in turning([0, 1], [0, 0], [0, 1]).at(stamp_s, sync="interpolate", tolerance_s=5.0)


def test_a_single_pose_holds_within_the_tolerance_and_no_further():
    single = turning([5], [0.3], [7])
    np.testing.assert_array_equal(single.at(5.1, sync="interpolate", tolerance_s=0.2), single.T_map_vehicle[0])
    assert single.at(5.3, sync="interpolate", tolerance_s=0.2) == "no pose within 0.2 s"
    np.testing.assert_array_equal(single.between(np.array([0.0, 9.0])), single.T_map_vehicle[[0, 0]])


def test_before_and_after_the_drive_between_stands_still():
    trajectory = turning([0, 1], [0, 1], [0, 1])
    np.testing.assert_allclose(trajectory.between(np.array([-3.0, 4.0])), trajectory.T_map_vehicle, atol=1e-12)


number = st.floats(-3, 3)


@given(st.tuples(number, number, number), st.tuples(number, number, number), st.floats(0, 1))
def test_constant_rotation_and_speed_are_interpolated_exactly(turn_rad_s, speed_m_s, stamp_s):
    """For poses 0.1 s apart, slerp of the rotation and linear interpolation of the position are exact."""
    stamps = np.linspace(0, 1, 11)

    def pose(s):
        return transform_from(Rotation.from_rotvec(np.array(turn_rad_s) * s).as_matrix(), np.array(speed_m_s) * s)

    trajectory = Trajectory(stamps, np.stack([pose(s) for s in stamps]), "steady")
    found = trajectory.at(stamp_s, sync="interpolate", tolerance_s=0.1)
    assert not isinstance(found, str)
    np.testing.assert_allclose(found, pose(stamp_s), atol=1e-5)
    np.testing.assert_allclose(trajectory.between(np.array([stamp_s, 0.5]))[0], pose(stamp_s), atol=1e-9)


def test_many_moments_at_once_are_as_one_by_one():
    trajectory = turning(np.arange(20.0), np.linspace(0, 6, 20), np.arange(20.0) ** 2)
    moments = np.array([17.3, 2.0, 2.5, 18.99])
    one_by_one = [trajectory.at(m, sync="interpolate", tolerance_s=1.0) for m in moments]
    np.testing.assert_allclose(trajectory.between(moments), one_by_one, atol=1e-12)


@pytest.mark.parametrize("stamps", [[0, 1, 1], [0, 2, 1]])
def test_time_that_does_not_rise_is_refused_naming_the_pose(stamps):
    with pytest.raises(DatasetError, match=r"turning, pose 3: .*sort the poses"):
        turning(stamps, [0, 0, 0], [0, 1, 2])


def test_no_poses_and_poses_that_are_no_numbers_are_refused():
    with pytest.raises(DatasetError, match="the file has no pose"):
        Trajectory(np.zeros(0), np.zeros((0, 4, 4)), "empty")
    with pytest.raises(DatasetError, match=r"turning, pose 2: .*finite"):
        turning([0, 1], [0, 0], [0, np.nan])
    with pytest.raises(DatasetError, match=r"turning, pose 2: .*finite"):
        turning([0, np.nan], [0, 0], [0, 1])


def test_poses_of_a_sensor_become_those_of_its_vehicle():
    T_vehicle_lidar = transform_from(rotation_z(np.pi / 2), np.array([1.0, 0, 2.0]))
    T_map_vehicle = turning([0, 1], [0, 0.7], [0, 3])
    of_lidar = Trajectory(T_map_vehicle.stamps_s, T_map_vehicle.T_map_vehicle @ T_vehicle_lidar, "lidar")
    np.testing.assert_allclose(
        of_lidar.moved_by(T_vehicle_lidar).T_map_vehicle, T_map_vehicle.T_map_vehicle, atol=1e-12
    )


def test_a_tum_file_is_read_also_as_poses_of_a_sensor(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("# a comment\n0 1 2 3 0 0 0 1\n1.5 4 5 6 0 0 0.7071067811865476 0.7071067811865476\n")
    assert read_pose_file(path).T_map_vehicle[1, :3, 3].tolist() == [4, 5, 6]
    T_vehicle_sensor = transform_from(np.eye(3), np.array([1.0, 0, 0]))
    moved = read_pose_file(path, T_vehicle_posed=T_vehicle_sensor).T_map_vehicle
    np.testing.assert_allclose(moved[:, :3, 3], [[0, 2, 3], [4, 4, 6]], atol=1e-12)


@pytest.mark.parametrize(
    "line", [b"1 2 3", b"x y z a b c d e", b"0 0 0 0 0 0 0 0", b"0 nan 0 0 0 0 0 1", b"\xff\xfe\x00"]
)
def test_a_broken_line_of_a_tum_file_is_named(tmp_path, line):
    path = tmp_path / "poses.txt"
    path.write_bytes(b"0 0 0 0 0 0 0 1\n" + line + b"\n")
    with pytest.raises(DatasetError, match=r"poses\.txt, line 2"):
        read_pose_file(path)
