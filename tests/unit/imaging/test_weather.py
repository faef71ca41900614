import numpy as np
import pytest

from service.imaging.weather import remove_weather_noise

GROUND_M, WALL_M = -1.8, 6.0


def beams(channels, columns):
    elevation, azimuth = np.meshgrid(
        np.deg2rad(np.linspace(10, -25, channels)), np.linspace(-np.pi, np.pi, columns, endpoint=False), indexing="ij"
    )
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    return rays.reshape(-1, 3)


def street_with_flakes(*, channels=32, columns=1024, flakes=0.06, seed=3):
    """Return ground, a wall on the left and a pole. A share of the beams returns from flakes between 1 and 15 m."""
    rng = np.random.default_rng(seed)
    rays = beams(channels, columns)
    with np.errstate(divide="ignore"):
        to_ground = np.where(rays[:, 2] < 0, GROUND_M / rays[:, 2], np.inf)
        to_wall = np.where(rays[:, 1] > 0, WALL_M / rays[:, 1], np.inf)
    range_m = np.minimum(to_ground, to_wall)
    off_pole = np.abs(np.arctan2(rays[:, 1], rays[:, 0]) - np.arctan2(-2.0, 8.0))
    range_m = np.where(off_pole < 0.012, np.minimum(range_m, np.hypot(8.0, 2.0)), range_m)
    range_m += rng.normal(0, 0.02, len(rays))
    flake_m = rng.uniform(1, 15, len(rays))
    is_flake = (rng.random(len(rays)) < flakes) & (flake_m < range_m)
    range_m = np.where(is_flake, flake_m, range_m)
    seen = range_m < 60
    return (rays[seen] * range_m[seen, None]).astype(np.float32), is_flake[seen], (off_pole < 0.012)[seen]


@pytest.mark.parametrize(("channels", "columns"), [(16, 900), (32, 1024), (64, 1024)])
def test_flakes_go_and_structure_stays(channels, columns):
    points, is_flake, _ = street_with_flakes(channels=channels, columns=columns)
    keep = remove_weather_noise(points)
    assert np.mean(~keep[is_flake]) > 0.8
    assert np.mean(keep[~is_flake]) > 0.97


def test_a_thin_pole_stays():
    points, is_flake, is_pole = street_with_flakes()
    pole = is_pole & ~is_flake & (np.hypot(points[:, 0], points[:, 1]) < 8.5)
    assert np.mean(remove_weather_noise(points)[pole]) > 0.9


def test_a_clear_scan_keeps_nearly_everything():
    points, _, _ = street_with_flakes(flakes=0.0)
    assert np.mean(remove_weather_noise(points)) > 0.995


def test_neighbourhoods_close_over_the_seam_of_the_azimuth():
    points, _, _ = street_with_flakes(flakes=0.0)
    near = np.hypot(points[:, 0], points[:, 1]) < 20
    behind = near & (np.abs(np.arctan2(points[:, 1], points[:, 0])) > np.deg2rad(178))
    assert behind.sum() > 50
    assert np.mean(remove_weather_noise(points)[behind]) > 0.99


def test_points_beyond_the_limit_are_left_alone():
    far = np.array([[40.0, 0.0, 0.0], [0.0, -50.0, 3.0]], np.float32)
    assert remove_weather_noise(far).all()


def test_an_empty_scan_stays_empty():
    assert remove_weather_noise(np.zeros((0, 3), np.float32)).shape == (0,)
