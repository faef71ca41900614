"""Drives: where the survey's LiDAR stood, and where queries are asked."""

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

SURVEY_LANE_M = 0.5  # right of the centre line


@dataclass(frozen=True, slots=True)
class Station:
    """A point of a drive: position (m) and heading (rad) on the ground plane; ``travelled`` (m) from the drive's start."""

    x: float
    y: float
    heading: float
    travelled: float


def stations(city: City, step_m: float, *, lane_m: float = SURVEY_LANE_M) -> list[Station]:
    """The stations along all streets of a city, as ``stations_along`` says."""
    return stations_along(city.streets, step_m, lane_m=lane_m)


def stations_along(streets: Iterable[Street], step_m: float, *, lane_m: float = SURVEY_LANE_M) -> list[Station]:
    """Every street once, in its own direction, a station each ``step_m``, ``lane_m`` right of its centre line (m)."""
    found: list[Station] = []
    travelled = 0.0
    for street in streets:
        for line in street.lines:
            along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]

            def at(
                u: float, line: NDArray[np.float64] = line, along: NDArray[np.float64] = along
            ) -> NDArray[np.float64]:
                return np.array([np.interp(u, along, line[:, 0]), np.interp(u, along, line[:, 1])])

            for u in np.arange(0.0, along[-1], step_m):
                ahead, behind = at(min(u + 1.5, along[-1])), at(max(u - 1.5, 0.0))
                direction = (ahead - behind) / np.linalg.norm(ahead - behind)
                point = at(u) + lane_m * np.array([direction[1], -direction[0]])
                found.append(
                    Station(
                        float(point[0]), float(point[1]), float(np.arctan2(direction[1], direction[0])), travelled + u
                    )
                )
            travelled += float(along[-1])
    return found


def upright_on(city: City, x: float, y: float, heading: float) -> NDArray[np.float64]:
    """Rotation of a vehicle that stands on the slope at (x, y) with a heading."""
    tilt = rotation_taking(np.array([0.0, 0.0, 1.0]), city.terrain.normal(np.array([x, y])))
    return tilt @ rotation_z(heading)


def lidar_pose(
    city: City, station: Station, rng: np.random.Generator, *, height_m: float = 1.8, sway_deg: float = 0.4
) -> NDArray[np.float64]:
    """T_map_lidar of a vehicle on the slope, with the suspension's sway in roll, pitch and height."""
    roll, pitch = np.deg2rad(rng.normal(0, sway_deg, 2))
    R = upright_on(city, station.x, station.y, station.heading) @ rotation_y(pitch) @ rotation_x(roll)
    z = city.height(station.x, station.y) + height_m + rng.normal(0, 0.02)
    return transform_from(R, np.array([station.x, station.y, z]))


@dataclass(frozen=True, slots=True)
class QueryDrive:
    """How far a query may be from the survey's track."""

    aside_m: float = 2.0
    heading_deg: float = 15.0
    height_m: float = 1.5
    height_sigma_m: float = 0.1
    sway_deg: float = 1.0
    both_directions: bool = True
    turn_deg: float = 0.0  # of the camera against the vehicle, counter-clockwise
    pitch_deg: float = 0.0  # a camera mounted wrong by this


def query_pose(city: City, station: Station, drive: QueryDrive, rng: np.random.Generator) -> NDArray[np.float64]:
    """T_map_camera of one query near a station of the survey."""
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
    """Smooth errors of survey poses: for each station a transform to multiply T_map_lidar with, from the right.

    Waves of 30 to 200 m of travel; ``position_m`` is one sigma an axis, ``angle_deg`` one sigma of each angle.
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
