"""Levelling and principal heading against the ground truth of a simulated city with slopes."""

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
import shapely

from model_training.simulation.city import City
from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.lidar import LIDARS, scan
from model_training.simulation.meshes import joined
from model_training.simulation.scene import Scene
from model_training.simulation.traversal import lidar_pose, stations
from service.geometry.rigid import heading_of_body, transform_from
from service.imaging.pca import level_scan, principal_heading

AWAY_M, EVERY = 15.0, 6


@dataclass(frozen=True)
class Measured:
    tilt_deg: float  # of the level found, against the ground under the sensor
    height_error_m: float
    heading_rad: float  # principal, in the map


def crossings(city):
    """Return the points where centre lines intersect, or end beside another."""
    lines = [shapely.LineString(line) for street in city.streets for line in street.lines]
    points = []
    for k, line in enumerate(lines):
        others = shapely.union_all([other for j, other in enumerate(lines) if j != k])
        points += [shapely.get_coordinates(line.intersection(others))]
        points += [
            np.array([end]) for end in (line.coords[0], line.coords[-1]) if others.distance(shapely.Point(end)) < 8
        ]
    return np.concatenate(points)


def measured_at(city, scene, station, rng):
    T_map_lidar = lidar_pose(city, station, rng)
    points = scan(
        scene, city.ground, LIDARS["paper_32"], LIDARS["paper_32"].rays(), T_map_lidar, CONDITIONS["clear"], rng
    )[:, :3]
    level = level_scan(points)
    normal = city.terrain.normal(np.array([station.x, station.y]))
    up = level.R_level_sensor @ T_map_lidar[:3, :3].T @ normal
    height = (T_map_lidar[2, 3] - city.height(station.x, station.y)) * normal[2]
    heading = principal_heading(points @ level.R_level_sensor.T.astype(np.float32), height_m=level.height_m)
    R_map_level = T_map_lidar[:3, :3] @ level.R_level_sensor.T
    return Measured(
        float(np.rad2deg(np.arccos(min(1.0, up[2])))),
        level.height_m - height,
        heading + heading_of_body(transform_from(R_map_level, np.zeros(3))),
    )


@pytest.fixture(scope="module")
def neighbours():
    """Return pairs of scans 1 m apart, spread over the streets of a city, away from crossings."""
    city = City(seed=5, size_m=(160.0, 160.0))
    scene, rng = Scene(joined([city.static, city.occupants(0)])), np.random.default_rng(1)
    track, corners = stations(city, 1.0), crossings(city)
    pairs = []
    for one, other in list(itertools.pairwise(track))[::EVERY]:
        positions = np.array([[one.x, one.y], [other.x, other.y]])
        away = np.linalg.norm(positions[:, None] - corners, axis=2).min() > AWAY_M
        if away and np.linalg.norm(positions[1] - positions[0]) < 1.5:
            pairs.append((measured_at(city, scene, one, rng), measured_at(city, scene, other, rng)))
    assert len(pairs) >= 60
    return pairs


def test_residual_tilt_is_under_half_a_degree(neighbours):
    tilts = np.array([m.tilt_deg for pair in neighbours for m in pair])
    assert np.mean(tilts < 0.5) >= 0.95


def test_heights_count_from_the_ground(neighbours):
    errors = np.array([m.height_error_m for pair in neighbours for m in pair])
    assert np.mean(np.abs(errors) < 0.1) >= 0.95


def test_the_principal_heading_repeats_between_neighbouring_scans(neighbours):
    turns = np.rad2deg([other.heading_rad - one.heading_rad for one, other in neighbours])
    assert np.mean(np.abs((turns + 90) % 180 - 90) < 10.0) >= 0.95
