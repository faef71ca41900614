import numpy as np
import pytest

from model_training.calibration.out_of_map import KINDS, Box, out_of_map_queries
from model_training.simulation.depth_noise import DEPTHS
from service.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)


def ray(x, y, z=1.0):
    return np.array([[[x, y, z]]], float)


@pytest.mark.parametrize(
    ("xyz", "expected"),
    [
        ((0, 0, 1), 4.0),
        ((0, 0, 2), 2.0),  # a ray of twice the length needs half the multiple
        ((0.2, 0.1, 1), 4.0),
        ((0.3, 0, 1), np.inf),  # beside it at 1.2 m
        ((0, -0.6, 1), np.inf),  # over it
        ((0, 0, -1), np.inf),  # behind
    ],
)
def test_where_a_ray_enters_a_box_by_hand(xyz, expected):
    box = Box((-1, -2, 4), (1, 2, 6))
    assert box.entered(ray(*xyz)).item() == pytest.approx(expected)


def test_a_box_is_turned_about_the_camera():
    """By 90 degrees to the right what was ahead lies to the right."""
    box = Box((-1, -1, 4), (1, 1, 6), yaw_rad=np.pi / 2)
    assert box.entered(ray(1, 0, 0)).item() == pytest.approx(4.0)
    assert box.entered(ray(0, 0, 1)).item() == np.inf


def test_who_stands_inside_enters_nothing():
    assert Box((-1, -1, -1), (1, 1, 1)).entered(ray(0, 0, 1)).item() == np.inf


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("preset", ["precise", "stereo"])
def test_out_of_map_queries_are_pictures_that_a_depth_camera_takes(kind, preset):
    drawn = list(out_of_map_queries(kind, CAMERA, DEPTHS[preset], 12, np.random.default_rng(1)))
    assert len(drawn) == 12
    for query in drawn:
        assert query.rgb.shape == (48, 64, 3)
        assert query.depth_m.shape == (48, 64)
        measured = query.depth_m[query.depth_m > 0]
        assert measured.min() >= DEPTHS[preset].min_range_m
        assert measured.max() <= DEPTHS[preset].max_range_m
    shares = [(query.depth_m > 0).mean() for query in drawn]
    assert np.median(shares) > 0.5  # a wall fills the picture


@pytest.mark.parametrize("kind", KINDS)
def test_chance_alone_makes_them_differ(kind):
    first, again, other = (
        next(out_of_map_queries(kind, CAMERA, DEPTHS["precise"], 1, np.random.default_rng(seed))) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.depth_m, again.depth_m)
    assert not np.array_equal(first.depth_m, other.depth_m)


def test_a_wall_stands_upright_before_the_camera():
    """Along most columns the depth does not change with the row, but for tilt: a wall, not a floor."""
    upright = 0
    for query in out_of_map_queries("wall", CAMERA, DEPTHS["ideal"], 20, np.random.default_rng(4)):
        middle = query.depth_m[8:24, 32]
        middle = middle[middle > 0]
        upright += len(middle) > 4 and np.ptp(middle) < 0.25 * middle.mean()
    assert upright >= 14
