import numpy as np
import pytest

from model_training.importing.ros_frames import FrameTree, stamp_of, transform_of
from service.geometry.rigid import rotation_x, rotation_z, transform_from


def moved(x=0.0, turn=0.0):
    return transform_from(rotation_z(turn), np.array([x, 0.0, 0.0]))


@pytest.fixture
def tree_of(ros):
    def made(*edges):
        """Return frames from (parent, child, T), static, or (parent, child, T, seconds), dynamic."""
        tree = FrameTree()
        for parent, child, T, *stamp in edges:
            tree.add(ros.edge(stamp[0] if stamp else 0.0, parent, child, T), static=not stamp)
        return tree

    return made


def test_fixed_edges_are_chained_up_and_down(tree_of):
    up, across = moved(1.0, np.pi / 2), transform_from(rotation_x(0.3), np.array([0, 2.0, 0]))
    tree = tree_of(("base", "rack", up), ("rack", "lidar", across), ("base", "camera", moved(5.0)))
    np.testing.assert_allclose(tree.fixed("base", "lidar"), up @ across, atol=1e-12)
    np.testing.assert_allclose(tree.fixed("lidar", "camera"), np.linalg.inv(up @ across) @ moved(5.0), atol=1e-12)
    np.testing.assert_array_equal(tree.fixed("lidar", "lidar"), np.eye(4))


def test_slashes_before_names_mean_nothing(tree_of):
    tree = tree_of(("/base", "/lidar", moved(1.0)))
    np.testing.assert_allclose(tree.fixed("base", "/lidar"), moved(1.0))
    assert tree.chain("/lidar") == ["lidar", "base"]


def test_frames_that_nothing_joins_have_no_way(tree_of):
    tree = tree_of(("base", "lidar", moved(1.0)), ("mast", "camera", moved(1.0)))
    assert tree.fixed("lidar", "camera") is None
    assert tree.fixed("lidar", "unheard of") is None


def test_a_way_over_an_edge_that_moves_is_none(tree_of):
    tree = tree_of(("base", "arm", moved(1.0), 0.0), ("base", "arm", moved(2.0), 1.0), ("arm", "camera", moved(1.0)))
    assert tree.fixed("base", "camera") is None


def test_an_edge_with_one_message_is_static(tree_of):
    np.testing.assert_allclose(tree_of(("base", "lidar", moved(1.0), 3.0)).fixed("base", "lidar"), moved(1.0))


def test_the_last_message_of_a_static_edge_counts(tree_of):
    tree = tree_of(("base", "lidar", moved(1.0)), ("base", "lidar", moved(2.0)))
    np.testing.assert_allclose(tree.fixed("base", "lidar"), moved(2.0))


def test_a_loop_of_frames_ends(tree_of):
    tree = tree_of(("a", "b", moved(1.0)), ("b", "c", moved(1.0)), ("c", "a", moved(1.0)))
    assert tree.chain("b") == ["b", "a", "c"]
    assert tree.moving("b", name="loop") is None
    assert tree.fixed("b", "elsewhere") is None


def test_a_moving_frame_is_followed_through_slower_edges(tree_of):
    slow = [("map", "odom", moved(10.0 * s), float(s)) for s in (0, 2)]
    fast = [("odom", "base", moved(1.0 + s), s) for s in (0.0, 0.5, 1.0, 1.5, 2.0)]
    root, trajectory = tree_of(*slow, *fast, ("base", "lidar", moved(0.25))).moving("lidar", name="tf")
    assert root == "map"
    np.testing.assert_allclose(trajectory.stamps_s, [0, 0.5, 1, 1.5, 2])
    np.testing.assert_allclose(trajectory.T_map_vehicle[:, 0, 3], 1.25 + 11 * trajectory.stamps_s)


def test_only_the_time_that_all_edges_cover_is_given(tree_of):
    outer = [("map", "odom", moved(0.0), s) for s in (1.0, 2.0)]
    inner = [("odom", "base", moved(s), s) for s in (0.0, 1.0, 1.5, 3.0)]
    _, trajectory = tree_of(*outer, *inner).moving("base", name="tf")
    assert trajectory.stamps_s.tolist() == [1.0, 1.5]


def test_edges_with_a_repeated_stamp_or_an_invalid_pose_are_ignored(ros):
    tree = FrameTree()
    nan = ros.edge(1.0, "a", "b", moved(np.nan))
    zero = ros.edge(2.0, "a", "b", moved())
    zero.transform.rotation.w = 0.0
    given = [
        ros.edge(0.0, "a", "b", moved()),
        nan,
        zero,
        ros.edge(3.0, "a", "b", moved(3.0)),
        ros.edge(3.0, "a", "b", moved(4.0)),
    ]
    assert [tree.add(edge, static=False) for edge in given] == [True, False, False, True, False]
    found = tree.moving("b", name="tf")
    assert found is not None
    assert found[1].stamps_s.tolist() == [0.0, 3.0]


def test_the_lowest_frame_that_moves_is_that_of_the_vehicle(tree_of):
    both = [edge for s in (0.0, 1.0) for edge in (("map", "odom", moved(s), s), ("odom", "base", moved(s), s))]
    assert tree_of(*both, ("base", "camera", moved())).lowest_that_moves() == "base"
    assert tree_of(("base", "camera", moved())).lowest_that_moves() is None


def test_times_and_poses_of_messages(ros):
    assert stamp_of(ros.header(12.25, "map")) == 12.25
    T = transform_from(rotation_z(1.0) @ rotation_x(0.2), np.array([1.0, 2, 3]))
    for message in (ros.pose(T), ros.edge(0, "a", "b", T).transform):
        found = transform_of(message)
        assert found is not None
        np.testing.assert_allclose(found, T, atol=1e-12)
