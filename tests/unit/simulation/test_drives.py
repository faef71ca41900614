import numpy as np
import pytest
from pydantic import ValidationError

from model_training.simulation.drives import driven, followed, query_candidates, survey_of
from model_training.simulation.plan import QueryPlan
from model_training.simulation.traversal import stations, stations_along, survey_error
from service.errors import DatasetError
from service.geometry.rigid import R_BODY_OPTICAL, heading_of_body, heading_of_camera, inverse


@pytest.fixture
def plan(plan_of):
    return plan_of(seed=5, size_m=(160.0, 160.0), spacing_m=1.0)


QUERY = QueryPlan(name="a", traversal=1, count=100)


def offsets(city, plan, query):
    """Return for every candidate the lateral and longitudinal offset from its station (m) and the yaw offset (degrees)."""
    survey = survey_of(city, plan)
    candidates = query_candidates(city, plan, query, survey)
    order = np.random.default_rng([plan.seed, 22, query.traversal, 0]).permutation(len(survey.stations))
    rows = []
    for T, k in zip(candidates, order, strict=False):
        station = survey.stations[k]
        ahead = np.array([np.cos(station.heading), np.sin(station.heading)])
        away = T[:2, 3] - [station.x, station.y]
        turn = np.rad2deg(heading_of_camera(T) - station.heading)
        rows.append((away @ [ahead[1], -ahead[0]], away @ ahead, (turn + 90) % 180 - 90, np.cos(np.deg2rad(turn)) > 0))
    return np.array(rows, float)


def test_queries_stand_within_two_metres_of_the_lane(city, plan):
    aside, ahead, _, _ = offsets(city, plan, QUERY).T
    assert np.abs(aside).max() <= 2.0
    assert np.abs(aside).max() > 1.8
    assert np.abs(ahead).max() <= 0.7


def test_queries_look_within_fifteen_degrees_of_the_street(city, plan):
    turn = offsets(city, plan, QUERY)[:, 2]
    assert 13 < np.abs(turn).max() < 15.5  # half a degree for the sway on a slope


def test_queries_go_both_ways(city, plan):
    assert offsets(city, plan, QUERY)[:, 3].mean() == pytest.approx(0.5, abs=0.1)


def test_cameras_ride_at_their_height_above_the_ground(city, plan):
    T = query_candidates(city, plan, QUERY, survey_of(city, plan))
    heights = np.array([t[2, 3] - city.height(t[0, 3], t[1, 3]) for t in T])
    assert heights.mean() == pytest.approx(1.5, abs=0.03)
    assert heights.std() == pytest.approx(0.1, rel=0.2)


def test_a_turned_camera_is_turned_against_the_vehicle(city, plan):
    turned = QUERY.model_copy(update={"turn_deg": 30.0})
    assert offsets(city, plan, turned)[:, 2].mean() == pytest.approx(30.0, abs=1.5)


def test_other_traversals_stand_elsewhere(city, plan):
    survey = survey_of(city, plan)
    one, other = (query_candidates(city, plan, QUERY.model_copy(update={"traversal": t}), survey) for t in (1, 2))
    assert np.abs(one[:50, :2, 3] - other[:50, :2, 3]).min() > 1e-6


def test_queries_on_the_track_stand_below_the_surveys_lidar(city, plan):
    survey = survey_of(city, plan)
    T_map_camera = query_candidates(city, plan, QueryPlan(name="a", traversal=0, count=9, on_track=True), survey)
    own = {tuple(np.round(T[:2, 3], 6)): T for T in survey.T_map_lidar}
    for T in T_map_camera[:20]:
        nearest = min(own, key=lambda xy: np.hypot(*(np.array(xy) - T[:2, 3])))
        in_lidar = inverse(own[nearest]) @ T
        np.testing.assert_allclose(in_lidar[:3, 3], [0, 0, -0.3], atol=1e-9)
        np.testing.assert_allclose(in_lidar[:3, 2], [1, 0, 0], atol=1e-9)


def test_a_camera_on_the_track_is_mounted_as_the_plan_says(city, plan):
    survey = survey_of(city, plan)
    on_track = QueryPlan(name="a", traversal=0, count=9, on_track=True)
    mounted = on_track.model_copy(update={"turn_deg": 30.0, "pitch_deg": 10.0})
    straight, turned = (query_candidates(city, plan, query, survey) for query in (on_track, mounted))
    np.testing.assert_array_equal(straight[:, :3, 3], turned[:, :3, 3])
    axes = straight[:, :3, :3].transpose(0, 2, 1) @ turned[:, :3, 2:3]  # of the mounted camera, in the straight one
    left, down, ahead = np.sin(np.deg2rad(30)), np.sin(np.deg2rad(10)), np.cos(np.deg2rad(30))
    shrunk = np.cos(np.deg2rad(10))
    np.testing.assert_allclose(axes[..., 0], np.tile([-left * shrunk, down, ahead * shrunk], (len(axes), 1)), atol=1e-9)


@pytest.mark.parametrize("field", ["spacing_m", "lidar_height_m", "camera_height_m"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_lengths_that_are_none_are_refused(plan_of, field, value):
    with pytest.raises(ValidationError, match=field):
        plan_of(**{field: value})


def test_stations_stand_a_step_apart_in_each_street(city):
    track = stations(city, 2.0)
    steps = np.diff([s.travelled for s in track])
    assert np.median(steps) == pytest.approx(2.0)
    assert steps.max() <= 2.0 + 1e-6


def test_only_the_wanted_streets_are_driven(city, plan):
    part = driven(city, plan.model_copy(update={"streets": ("2",)}), 1.0)
    line = next(street for street in city.streets if street.street == "2").lines[0]
    distances = [np.linalg.norm(line - [s.x, s.y], axis=1).min() for s in part]
    assert max(distances) < 2.5
    assert len(part) < len(driven(city, plan, 1.0))


def test_stations_of_some_streets_are_those_of_the_whole_drive_renumbered(city, plan):
    part = driven(city, plan.model_copy(update={"streets": ("3", "2")}), 1.0)
    whole = stations(city, 1.0)
    expected, travelled = [], 0.0
    for street in city.streets:
        own = stations_along([street], 1.0)
        if street.street in ("2", "3"):
            first = next(k for k, s in enumerate(whole) if (s.x, s.y) == (own[0].x, own[0].y))
            expected += [
                (s.x, s.y, s.heading, travelled + o.travelled)
                for s, o in zip(whole[first : first + len(own)], own, strict=True)
            ]
            travelled += sum(float(np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum()[-1]) for line in street.lines)
    assert [(s.x, s.y, s.heading, s.travelled) for s in part] == expected


def test_the_lidar_stands_upright_on_the_slope_but_for_its_sway(city, plan):
    survey = survey_of(city, plan)
    tilts = [np.rad2deg(np.arccos(min(1.0, T[:3, 2] @ city.terrain.normal(T[:2, 3])))) for T in survey.T_map_lidar]
    assert 0.2 < np.mean(tilts) < 0.8
    turns = [heading_of_body(T) - s.heading for T, s in zip(survey.T_map_lidar, survey.stations, strict=True)]
    assert np.abs(np.angle(np.exp(1j * np.array(turns)))).max() < np.deg2rad(0.3)


def errors(*, length_m=4000.0, seed=0):
    transforms = np.array(survey_error(np.arange(0.0, length_m, 1.0), np.random.default_rng(seed)))
    angles = np.stack([transforms[:, 2, 1], transforms[:, 0, 2], transforms[:, 1, 0]], axis=1)
    return transforms[:, :3, 3], np.rad2deg(angles)


def test_the_survey_error_has_the_stated_size():
    position_m, angle_deg = errors()
    np.testing.assert_allclose(position_m.std(axis=0), 0.03, rtol=0.15)
    np.testing.assert_allclose(angle_deg.std(axis=0), 0.05, rtol=0.15)


def test_the_survey_error_is_smooth():
    position_m, angle_deg = errors()
    assert np.abs(np.diff(position_m, axis=0)).max() < 0.015
    assert np.abs(np.diff(angle_deg, axis=0)).max() < 0.025


def test_written_poses_are_the_true_ones_without_the_error(city, plan):
    survey = survey_of(city, plan.model_copy(update={"survey_error": False}))
    np.testing.assert_array_equal(survey.T_map_lidar, survey.T_map_lidar_written)


def test_a_street_that_is_not_there_is_refused_with_those_that_are(city, plan):
    with pytest.raises(DatasetError, match=r"unknown street 'x'; choose from: 1, 2"):
        driven(city, plan.model_copy(update={"streets": ("x",)}), 1.0)


@pytest.mark.parametrize(("step_m", "expected_m"), [(None, 2.0), (3.5, 3.5)])
@pytest.mark.parametrize("turn_deg", [0.0, 90.0, -30.0])
def test_frames_of_a_sequence_follow_a_straight_line_to_the_sampled_pose(city, plan, step_m, expected_m, turn_deg):
    """Frames are two metres apart by default. The vehicle drives along its heading for any camera direction."""
    query = QUERY.model_copy(update={"sequence": 4, "step_m": step_m, "turn_deg": turn_deg})
    poses = query_candidates(city, plan, query, survey_of(city, plan))[:25]
    frames = followed(city, query, poses).reshape(25, 4, 4, 4)
    np.testing.assert_array_equal(frames[:, 3], poses)
    steps = np.diff(frames[:, :, :2, 3], axis=1)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=2), expected_m, atol=1e-9)
    np.testing.assert_allclose(steps, np.repeat(steps[:, :1], 3, axis=1), atol=1e-9)
    driven_rad = np.arctan2(steps[:, 0, 1], steps[:, 0, 0])
    looked_rad = np.array([heading_of_camera(T) for T in poses])
    np.testing.assert_allclose(np.angle(np.exp(1j * (looked_rad - driven_rad - np.deg2rad(turn_deg)))), 0, atol=1e-9)


def test_the_camera_keeps_its_angles_and_its_height_above_the_ground(city, plan):
    query = QUERY.model_copy(update={"sequence": 3, "step_m": 5.0})
    poses = query_candidates(city, plan, query, survey_of(city, plan))[:25]
    frames = followed(city, query, poses).reshape(25, 3, 4, 4)
    np.testing.assert_array_equal(frames[:, :, :3, :3], np.repeat(poses[:, None, :3, :3], 3, axis=1))
    above = [[T[2, 3] - city.height(T[0, 3], T[1, 3]) for T in frames_of_one] for frames_of_one in frames]
    np.testing.assert_allclose(above, np.repeat(np.array(above)[:, 2:], 3, axis=1), atol=1e-9)
    assert np.ptp(frames[:, :, 2, 3], axis=1).max() > 0.05  # it is no plain


def test_cameras_around_a_vehicle_look_outwards_from_a_circle(city, plan):
    query = QueryPlan(name="ring", traversal=1, cameras=4)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R_BODY_OPTICAL, (10.0, 5.0, 1.5)  # it looks along x
    ring = followed(city, query, T[None])
    assert ring.shape == (4, 4, 4)
    np.testing.assert_allclose(ring[-1], T, atol=1e-12)
    np.testing.assert_allclose(ring[:, :3, 2], [[0, -1, 0], [-1, 0, 0], [0, 1, 0], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(ring[:, :3, 3] - [9.5, 5.0, 1.5], 0.5 * ring[:, :3, 2], atol=1e-12)


def test_a_ring_of_cameras_has_no_sequence():
    with pytest.raises(DatasetError, match="cameras: 'ring' has a sequence already"):
        QueryPlan(name="ring", traversal=1, cameras=4, sequence=3).refuse_what_does_nothing()


def test_single_pictures_are_followed_by_themselves(city, plan):
    poses = query_candidates(city, plan, QUERY, survey_of(city, plan))
    assert followed(city, QUERY, poses) is poses
