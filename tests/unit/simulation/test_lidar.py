from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.lidar import LIDARS, scan
from model_training.simulation.sensor_parameters import LidarParameters

CLEAR = CONDITIONS["clear"]
MODEL = LIDARS["paper_32"]
EXACT = replace(MODEL, range_noise_m=0.0, dropout=0.0)


def scan_of(wall, model=MODEL, condition=CLEAR, *, seed=0, at_x_m=0.0):
    T_map_lidar = np.eye(4)
    T_map_lidar[0, 3] = at_x_m
    return scan(wall.scene, wall.ground, model, model.rays(), T_map_lidar, condition, np.random.default_rng(seed))


def along(points, wall, at_x_m=0.0):
    """Return range errors along the beams. The wall is at a known x."""
    ranges = np.linalg.norm(points[:, :3], axis=1)
    return ranges - (wall.x_m - at_x_m) * ranges / points[:, 0]


def test_without_errors_all_points_lie_on_the_wall(wall):
    points = scan_of(wall, EXACT)
    np.testing.assert_allclose(points[:, 0], wall.x_m, atol=1e-3)


def test_points_lie_on_the_beams_of_the_model(wall):
    directions = scan_of(wall)[:, :3]
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    elevations = np.rad2deg(np.arcsin(directions[:, 2]))
    beams = np.linspace(MODEL.top_deg, MODEL.bottom_deg, MODEL.channels)
    assert np.abs(elevations[:, None] - beams).min(axis=1).max() < 1e-3


@pytest.mark.parametrize("sigma_m", [0.02, 0.05])
def test_range_noise_has_the_stated_size(wall, sigma_m):
    errors = along(scan_of(wall, replace(EXACT, range_noise_m=sigma_m)), wall)
    assert errors.std() == pytest.approx(sigma_m, rel=0.1)
    assert abs(errors.mean()) < 0.1 * sigma_m


@pytest.mark.parametrize("dropout", [0.03, 0.2])
def test_the_stated_share_of_beams_drops_out(wall, dropout):
    lost = 1 - len(scan_of(wall, replace(EXACT, dropout=dropout))) / len(scan_of(wall, EXACT))
    assert lost == pytest.approx(dropout, abs=0.015)


def test_nothing_is_measured_beyond_the_range_limit(wall):
    points = scan_of(wall, replace(MODEL, max_range_m=30.0))
    assert 25 < np.linalg.norm(points[:, :3], axis=1).max() < 30.0


def test_a_wall_beyond_the_limit_is_not_seen(wall):
    assert len(scan_of(wall, replace(MODEL, max_range_m=15.0))) == 0


@pytest.mark.parametrize(
    ("name", "channels"),
    [
        ("vlp_16", 16),
        ("paper_32", 32),
        ("hdl_32", 32),
        ("hdl_64", 64),
        ("os0_128", 128),
        ("os1_64", 64),
        ("os1_128", 128),
        ("pandar_64", 64),
    ],
)
def test_presets_have_their_channels(name, channels):
    rays = LIDARS[name].rays()
    assert rays.shape == (channels * 1024, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-6)


def elevations_deg(model):
    return np.rad2deg(np.arcsin(model.rays().reshape(model.channels, model.columns, 3)[:, 0, 2]))


def test_beams_of_a_table_are_where_the_manual_has_them():
    """Two blocks of 32: spacing 1/3 degree from +2 degrees, 1/2 degree from -8.83 degrees."""
    beams = elevations_deg(LIDARS["hdl_64"])
    np.testing.assert_allclose(beams[[0, 1, 31, 32, 33, 63]], [2, 1.6667, -8.3333, -8.83, -9.33, -24.33], atol=1e-3)
    assert (np.diff(elevations_deg(LIDARS["pandar_64"])) < 0).all()


def test_another_vertical_field_has_evenly_spaced_beams():
    model = LidarParameters(bottom_deg=-29.5).on("hdl_64")
    np.testing.assert_allclose(np.diff(elevations_deg(model)), -0.5, atol=1e-3)
    assert LidarParameters(columns=512).on("hdl_64").beams_deg == LIDARS["hdl_64"].beams_deg


def test_fog_shortens_the_range(wall):
    def share(condition):
        return np.mean(np.isclose(scan_of(wall, MODEL, condition, at_x_m=-20.0)[:, 0], 40.0, atol=0.2))

    seen = {
        name: len(scan_of(wall, MODEL, CONDITIONS[name], at_x_m=-20.0)) * share(CONDITIONS[name])
        for name in ("clear", "fog")
    }
    assert seen["clear"] > 3000
    assert seen["fog"] < 0.05 * seen["clear"]


def test_fog_leaves_what_is_near(wall):
    on_wall = np.abs(along(scan_of(wall, MODEL, CONDITIONS["fog"], at_x_m=14.0), wall, at_x_m=14.0)) < 0.1
    assert on_wall.sum() > 3000


@pytest.mark.parametrize("name", ["rain", "snow", "fog"])
def test_drops_and_flakes_answer_near_the_sensor(wall, name):
    points = scan_of(wall, MODEL, CONDITIONS[name])
    false = points[np.abs(points[:, 0] - wall.x_m) > 0.5]
    ranges = np.linalg.norm(false[:, :3], axis=1)
    assert len(false) > 200
    assert np.median(ranges) < 8.0


@pytest.mark.parametrize("name", ["clear", "hard_light", "night", "low_sun"])
def test_light_does_not_trouble_the_lidar(wall, name):
    assert np.abs(scan_of(wall, MODEL, CONDITIONS[name])[:, 0] - wall.x_m).max() < 0.2


def test_snow_gives_more_false_returns_than_rain(wall):
    counts = [
        np.sum(np.abs(scan_of(wall, MODEL, CONDITIONS[name])[:, 0] - wall.x_m) > 0.5) for name in ("rain", "snow")
    ]
    assert counts[1] > 2 * counts[0]


@pytest.mark.parametrize(("name", "decibel_per_km"), [("rain", 9.3), ("snow", 14.3), ("fog", 339.8)])
def test_extinctions_are_those_of_the_stated_strengths(name, decibel_per_km):
    """25 mm/h: 1.076 * 25^0.67. 2 mm/h of water: 5.50 * 2^1.38. Visibility 50 m: 3.912 / 50 per metre."""
    in_decibel = CONDITIONS[name].extinction_per_m * 1000 * 10 / np.log(10)
    assert in_decibel == pytest.approx(decibel_per_km, rel=0.01)


def test_a_non_repetitive_scan_covers_its_field_of_view_evenly():
    model = LIDARS["livox_mid_360"]
    rays = model.rays()
    assert rays.shape == (40 * 1024, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-6)
    elevation_deg = np.rad2deg(np.arcsin(rays[:, 2]))
    assert -7.01 < elevation_deg.min() < -6.9 < 51.9 < elevation_deg.max() < 52.01
    azimuth_deg = np.rad2deg(np.arctan2(rays[:, 1], rays[:, 0]))
    cells, *_ = np.histogram2d(azimuth_deg, elevation_deg, [12, 6], [(-180, 180), (-7, 52)])
    assert cells.min() > 0.95 * cells.mean()
    assert cells.max() < 1.05 * cells.mean()


def test_two_non_repetitive_scans_have_other_points(wall):
    model = replace(MODEL, non_repetitive=True, range_noise_m=0.0)
    first, second = (scan_of(wall, model, seed=seed) for seed in (0, 1))
    distance, _ = cKDTree(first[:, :3]).query(second[:, :3])
    assert np.median(distance) > 0.01
    np.testing.assert_allclose(second[:, 0], first[0, 0], atol=1e-3)  # the same wall
