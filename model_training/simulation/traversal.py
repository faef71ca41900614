"""Traversals: poses of the survey's LiDAR and of queries."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model_training.simulation.city import City
from model_training.simulation.streets import Street
from service.geometry.rigid import (
    R_BODY_OPTICAL,
    rotation_taking,
    rotation_x,
    rotation_y,
    rotation_z,
    transform_from,
)

#: Distance of the survey's vehicle to the right of the centre line, metres.
SURVEY_LANE_M = 0.5


@dataclass(frozen=True, slots=True)
class Station:
    """A point of a traversal on the ground plane.

    Attributes:
        x: map frame, metres.
        y: map frame, metres.
        heading: heading, radians, counter-clockwise from x.
        travelled: distance from the start of the traversal, metres.
    """

    x: float
    y: float
    heading: float
    travelled: float


def stations(city: City, step_m: float, *, lane_m: float = SURVEY_LANE_M) -> list[Station]:
    """Return the stations along all streets of a city; see ``stations_along``.

    Args:
        city: city with streets.
        step_m: distance between stations, metres.
        lane_m: distance to the right of the centre line, metres.
    """
    return stations_along(city.streets, step_m, lane_m=lane_m)


def stations_along(streets: Iterable[Street], step_m: float, *, lane_m: float = SURVEY_LANE_M) -> list[Station]:
    """Return stations that follow every street once, in its own direction.

    Args:
        streets: streets in the order of the traversal.
        step_m: distance between stations along the centre line, metres.
        lane_m: distance to the right of the centre line, metres.
    """
    found: list[Station] = []
    travelled = 0.0
    for street in streets:
        for line in street.lines:
            along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
            u = np.arange(0.0, along[-1], step_m)

            def at(
                u: NDArray[np.float64], line: NDArray[np.float64] = line, along: NDArray[np.float64] = along
            ) -> NDArray[np.float64]:
                return np.column_stack([np.interp(u, along, line[:, 0]), np.interp(u, along, line[:, 1])])

            direction = at(np.minimum(u + 1.5, along[-1])) - at(np.maximum(u - 1.5, 0.0))
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            points = at(u) + lane_m * np.column_stack([direction[:, 1], -direction[:, 0]])
            headings = np.arctan2(direction[:, 1], direction[:, 0])
            found += [Station(*row) for row in np.column_stack([points, headings, travelled + u]).tolist()]
            travelled += float(along[-1])
    return found


def upright_on(city: City, x: float, y: float, heading: float) -> NDArray[np.float64]:
    """Return the rotation (3, 3), vehicle frame to map frame, of a vehicle that stands on the slope.

    Args:
        city: city with terrain.
        x: map frame, metres.
        y: map frame, metres.
        heading: heading, radians, counter-clockwise from x.
    """
    tilt = rotation_taking(np.array([0.0, 0.0, 1.0]), city.terrain.normal(np.array([x, y])))
    return tilt @ rotation_z(heading)


def lidar_pose(
    city: City, station: Station, rng: np.random.Generator, *, height_m: float = 1.8, sway_deg: float = 0.4
) -> NDArray[np.float64]:
    """Return T_map_lidar (4, 4), metres, of a vehicle on the slope. The suspension adds random roll, pitch and height.

    Args:
        city: city with terrain.
        station: position and heading.
        rng: random generator.
        height_m: mean height of the LiDAR above the ground, metres.
        sway_deg: standard deviation of roll and pitch, degrees.
    """
    roll, pitch = np.deg2rad(rng.normal(0, sway_deg, 2))
    R = upright_on(city, station.x, station.y, station.heading) @ rotation_y(pitch) @ rotation_x(roll)
    z = city.height(station.x, station.y) + height_m + rng.normal(0, 0.02)
    return transform_from(R, np.array([station.x, station.y, z]))


@dataclass(frozen=True, slots=True)
class QueryDrive:
    """How far the query poses may deviate from the survey's track.

    Attributes:
        aside_m: largest lateral distance, metres.
        heading_deg: largest heading difference, degrees.
        height_m: mean height of the camera above the ground, metres.
        height_sigma_m: standard deviation of the height, metres.
        sway_deg: standard deviation of roll and pitch, degrees.
        both_directions: whether half of the queries face the opposite direction.
        turn_deg: yaw of the camera against the vehicle, degrees, counter-clockwise.
        pitch_deg: pitch of a wrongly mounted camera, degrees; positive is downwards.
    """

    aside_m: float = 2.0
    heading_deg: float = 15.0
    height_m: float = 1.5
    height_sigma_m: float = 0.1
    sway_deg: float = 1.0
    both_directions: bool = True
    turn_deg: float = 0.0
    pitch_deg: float = 0.0


def query_pose(city: City, station: Station, drive: QueryDrive, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return T_map_camera (4, 4), metres, of one query near a station of the survey.

    Args:
        city: city with terrain.
        station: station of the survey.
        drive: allowed deviations.
        rng: random generator.
    """
    aside = rng.uniform(-drive.aside_m, drive.aside_m)
    ahead = rng.uniform(-0.7, 0.7)
    c, s = np.cos(station.heading), np.sin(station.heading)
    x, y = station.x + aside * s + ahead * c, station.y - aside * c + ahead * s
    back = np.pi if drive.both_directions and rng.random() < 0.5 else 0.0
    heading = station.heading + back + np.deg2rad(rng.uniform(-drive.heading_deg, drive.heading_deg) + drive.turn_deg)
    roll, pitch = np.deg2rad(rng.normal(0, drive.sway_deg, 2) + [0.0, drive.pitch_deg])
    R = upright_on(city, x, y, heading) @ rotation_y(pitch) @ rotation_x(roll) @ R_BODY_OPTICAL
    z = city.height(x, y) + drive.height_m + rng.normal(0, drive.height_sigma_m)
    return transform_from(R, np.array([x, y, z]))


def survey_error(
    travelled_m: NDArray[np.float64], rng: np.random.Generator, *, position_m: float = 0.03, angle_deg: float = 0.05
) -> list[NDArray[np.float64]]:
    """Return one transform (4, 4) per station: a smooth error of the survey's pose. T_map_lidar @ error is the reported pose.

    Each error component is a sum of sine waves of 30 to 200 m of travel.

    Args:
        travelled_m: distance of each station from the start (n,), metres.
        rng: random generator.
        position_m: standard deviation per axis, metres.
        angle_deg: standard deviation of each angle, degrees.
    """
    waves = []
    for sigma in [position_m] * 3 + [np.deg2rad(angle_deg)] * 3:
        length, phase = rng.uniform(30, 200, 6), rng.uniform(0, 2 * np.pi, 6)
        wave = np.sin(travelled_m[:, None] * 2 * np.pi / length + phase).sum(axis=1) * sigma / np.sqrt(3.0)
        waves.append(wave)
    x, y, z, roll, pitch, yaw = waves
    return [
        transform_from(rotation_z(yaw[k]) @ rotation_y(pitch[k]) @ rotation_x(roll[k]), np.array([x[k], y[k], z[k]]))
        for k in range(len(travelled_m))
    ]
