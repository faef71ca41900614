"""A LiDAR that moves while it rotates, and a vehicle ahead of it."""

from dataclasses import replace

import numpy as np
import pytest

from model_training.simulation.blocker import AHEAD_M, SWING_M, Blocker
from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.lidar import LIDARS, scan
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.simulation.sensor_parameters import SurveyParameters
from model_training.simulation.survey_drive import SurveyModel, moved_m
from service.errors import DatasetError

EXACT = replace(LIDARS["paper_32"], range_noise_m=0.0, dropout=0.0)


def scan_of(wall, survey, ahead=None):
    return scan(
        wall.scene,
        wall.ground,
        EXACT,
        EXACT.rays(),
        np.eye(4),
        CONDITIONS["clear"],
        np.random.default_rng(0),
        survey=survey,
        ahead=ahead,
    )


def test_the_way_within_a_turn_follows_the_azimuth():
    """At 10 m/s a rotation of 0.1 s covers 1 m: half a metre before mid-rotation and half after."""
    rays = np.array([[1, 0, 0], [0, 1, 0], [0, -1, 0], [-1, 1e-6, 0]], np.float32)
    np.testing.assert_allclose(moved_m(rays, 10.0)[:, 0], [0.0, 0.25, -0.25, 0.5], atol=1e-3)
    assert not moved_m(rays, 10.0)[:, 1:].any()


def test_a_scan_whose_motion_was_taken_out_shows_the_wall_where_it_stands(wall):
    points = scan_of(wall, SurveyModel(speed_m_s=10.0))
    np.testing.assert_allclose(points[:, 0], wall.x_m, atol=2e-3)


def test_a_scan_as_the_sensor_turned_is_off_by_the_way_it_drove(wall):
    """A point at azimuth a was measured 1 m * a / 2 pi later along the path, so it appears nearer by that distance."""
    points = scan_of(wall, SurveyModel(speed_m_s=10.0, deskewed=False))
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    np.testing.assert_allclose(points[:, 0], wall.x_m - azimuth / (2 * np.pi), atol=5e-3)
    assert np.ptp(points[:, 0]) > 0.3


def test_a_standing_survey_is_what_it_was(wall):
    np.testing.assert_array_equal(scan_of(wall, SurveyModel()), scan_of(wall, SurveyModel(speed_m_s=0.0)))


def ahead_of(share, along_m=0.0, seed=0):
    return Blocker.driving_ahead(np.array([0.0, 0.0, -1.8]), 0.0, along_m, share, np.random.default_rng(seed))


@pytest.mark.parametrize("share", [0.1, 0.3, 0.8])
def test_a_vehicle_is_ahead_for_the_share_of_the_way(share):
    ahead = [ahead_of(share, along_m) is not None for along_m in np.arange(0, 7500, 7.5)]
    assert np.mean(ahead) == pytest.approx(share, abs=0.02)


def test_no_vehicle_is_ahead_where_none_is_wanted():
    assert all(ahead_of(0.0, along_m) is None for along_m in range(0, 1000, 10))


def test_a_vehicle_ahead_is_in_the_scan_at_its_distance(wall):
    vehicle = ahead_of(1.0)
    assert vehicle is not None
    points = scan_of(wall, SurveyModel(), vehicle)
    on_it = points[points[:, 0] < wall.x_m - 0.5]
    assert len(on_it) > 50
    assert AHEAD_M - SWING_M <= on_it[:, 0].min() <= AHEAD_M + SWING_M
    assert np.abs(on_it[:, 1]).max() < 1.2


def test_a_motion_that_is_taken_out_of_a_standing_scan_is_refused():
    with pytest.raises(DatasetError, match=r"survey\.deskewed"):
        SimulationPlan(name="x", survey_parameters=SurveyParameters(deskewed=False)).checked()


def test_errors_of_poses_are_refused_where_the_survey_has_none():
    plan = SimulationPlan(name="x", survey_error=False, survey_parameters=SurveyParameters(position_m=0.1))
    with pytest.raises(DatasetError, match="survey_error"):
        plan.checked()


def test_a_picture_is_blocked_once():
    query = QueryPlan(name="a", traversal=1, blocked=0.3, followed=0.5)
    with pytest.raises(DatasetError, match="followed"):
        SimulationPlan(name="x", queries=(query,)).checked()
