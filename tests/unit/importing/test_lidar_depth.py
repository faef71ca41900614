import numpy as np

from model_training.importing.lidar_depth import depth_from_scan
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import transform_from

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
HERE = np.eye(4)


def rays(step=4, jitter=0.0):
    """Return directions through a grid of pixels, z = 1."""
    u, v = (a.ravel().astype(float) for a in np.meshgrid(np.arange(2, 63, step), np.arange(2, 47, step)))
    rng = np.random.default_rng(0)
    u, v = (a + rng.uniform(-jitter, jitter, len(a)) for a in (u, v))
    return np.c_[(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))]


def on_plane(directions, normal, distance):
    return directions * (distance / (directions @ normal))[:, None]


def test_an_oblique_wall_comes_out_exactly_between_the_beams():
    normal = np.array([0.3, 0.1, 1.0])
    depth = depth_from_scan(on_plane(rays(jitter=0.4), normal, 8.0), HERE, CAMERA)
    v, u = np.nonzero(depth)
    every = np.c_[(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))]
    np.testing.assert_allclose(depth[v, u], 8.0 / (every @ normal), rtol=1e-5)
    assert len(u) > 0.8 * 60 * 44


def test_the_mounting_moves_the_points_into_the_camera():
    T_camera_lidar = transform_from(np.eye(3), np.array([0.0, 0.0, 2.0]))
    depth = depth_from_scan(rays() * 5.0, T_camera_lidar, CAMERA)
    np.testing.assert_allclose(depth[24, 32], 7.0, rtol=1e-6)


def test_across_an_edge_of_depth_there_is_nothing():
    directions = rays()
    near = directions[:, 0] < 0
    depth = depth_from_scan(directions * np.where(near, 4.0, 12.0)[:, None], HERE, CAMERA)
    assert set(np.unique(np.round(depth[depth > 0], 3))) == {4.0, 12.0}
    assert (depth[4:44, 30:34].min(axis=1) == 0).all()


def test_a_gap_in_the_scan_stays_empty():
    directions = rays()
    seen = directions[np.abs(directions[:, 0]) > 0.25]
    depth = depth_from_scan(seen * 5.0, HERE, CAMERA)
    assert not depth[10:38, 28:36].any()
    assert depth[24, 4] > 0


def test_points_behind_what_the_camera_sees_are_dropped():
    front = rays(step=2) * 4.0
    behind = rays(step=5) * 9.0
    depth = depth_from_scan(np.r_[behind, front], HERE, CAMERA)
    assert set(np.unique(np.round(depth[depth > 0], 3))) == {4.0}


def test_points_behind_the_camera_or_too_few_points_give_no_depth():
    assert not depth_from_scan(rays() * -5.0, HERE, CAMERA).any()
    assert not depth_from_scan(rays()[:3] * 5.0, HERE, CAMERA).any()
    assert not depth_from_scan(np.zeros((0, 3)), HERE, CAMERA).any()


def test_a_single_row_of_beams_spans_no_surface():
    row = np.c_[np.linspace(-0.4, 0.4, 30), np.full(30, 0.5 / 60), np.ones(30)]
    assert not depth_from_scan(row * 5.0, HERE, CAMERA).any()
