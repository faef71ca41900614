"""Poses of a plan: those of the survey and of every query traversal. Random numbers depend on seed and traversal, not on frame order."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from model_training.simulation.city import City
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.simulation.streets import TABLE_I
from model_training.simulation.traversal import (
    QueryDrive,
    Station,
    lidar_pose,
    query_pose,
    stations_along,
    survey_error,
)
from service.errors import DatasetError
from service.geometry.rigid import R_BODY_OPTICAL, rotation_y, rotation_z, transform_from

Transforms = NDArray[np.float64]
#: Distance of several cameras from the centre of their vehicle, metres.
RING_M = 0.5
#: Distance between the frames of a sequence, metres.
DEFAULT_STEP_M = 2.0


@dataclass(frozen=True)
class Survey:
    """Poses of a survey.

    Attributes:
        stations: positions of the scans along the streets.
        T_map_lidar: true poses of the scans (n, 4, 4), LiDAR frame to map frame, metres.
        T_map_lidar_written: poses (n, 4, 4) that the survey reports. They contain its smooth error.
    """

    stations: list[Station]
    T_map_lidar: Transforms
    T_map_lidar_written: Transforms


def driven(city: City, plan: SimulationPlan, step_m: float) -> list[Station]:
    """Return the stations along the streets that the plan surveys.

    Args:
        city: city of the plan.
        plan: names the streets; no names mean all streets.
        step_m: distance between stations, metres.

    Raises:
        DatasetError: the plan names a street that the city does not have.
    """
    known = [street.street for street in city.streets]
    for wanted in plan.streets:
        if wanted not in known:
            raise DatasetError(f"streets: unknown street {wanted!r}; choose from: {', '.join(known)}", field="streets")
    wanted_streets = [street for street in city.streets if not plan.streets or street.street in plan.streets]
    return stations_along(wanted_streets, step_m)


def survey_of(city: City, plan: SimulationPlan) -> Survey:
    """Return the poses of the survey.

    Args:
        city: city of the plan.
        plan: settings of the survey.

    Raises:
        DatasetError: the plan names a street that the city does not have.
    """
    rng = np.random.default_rng([plan.seed, 21])
    track = driven(city, plan, plan.spacing_m)
    true = np.array([lidar_pose(city, station, rng, height_m=plan.lidar_height_m) for station in track])
    written = true.copy()
    if plan.survey_error:
        model = plan.survey_parameters.model()
        errors = survey_error(
            np.array([station.travelled for station in track]),
            rng,
            position_m=model.position_m,
            angle_deg=model.angle_deg,
        )
        written = np.array([T @ error for T, error in zip(true, errors, strict=True)])
    return Survey(track, true, written)


def query_candidates(city: City, plan: SimulationPlan, query: QueryPlan, survey: Survey) -> Transforms:
    """Return more camera poses than wanted (n, 4, 4), T_map_camera in metres, in the order in which to try them.

    Obstacles may block some of the poses. ``Quota`` says how many poses of each class to keep.

    Args:
        city: city of the plan.
        plan: camera height and seed.
        query: query traversal.
        survey: survey whose track the queries follow.
    """
    rng = np.random.default_rng([plan.seed, 22, query.traversal, 1 if query.on_track else 0])
    drive = QueryDrive(
        aside_m=query.aside_m,
        heading_deg=query.heading_deg,
        height_m=plan.camera_height_m,
        turn_deg=query.turn_deg,
        pitch_deg=query.pitch_deg,
    )
    if query.on_track:
        order = rng.permutation(len(survey.T_map_lidar))
        return np.array([_camera_on(survey.T_map_lidar[k], plan, query) for k in order])
    track = [survey.stations[k] for k in rng.permutation(len(survey.stations))]
    rounds = 1 + 3 * query.count // max(1, len(track))
    return np.array([query_pose(city, station, drive, rng) for _ in range(rounds) for station in track])


def followed(city: City, query: QueryPlan, poses: Transforms) -> Transforms:
    """Return every pose preceded by the other frames of its query, in recording order; the poses themselves for single frames.

    In a sequence the vehicle drives straight. The camera keeps its height above the ground and its rotation. Several cameras stand on a
    circle around the vehicle's centre and look outwards.

    Args:
        city: city of the poses.
        query: query traversal: length and step of a sequence, or number of cameras.
        poses: T_map_camera (n, 4, 4), metres.

    Returns:
        T_map_camera (n * frames, 4, 4), metres.
    """
    if query.cameras is not None:
        return np.array([each for T in poses for each in _around(T, query.cameras)])
    if query.sequence is None:
        return poses
    step_m, found = query.step_m or DEFAULT_STEP_M, []
    for T in poses:
        heading = np.arctan2(T[1, 2], T[0, 2]) - np.deg2rad(query.turn_deg)
        for back in range(query.sequence - 1, -1, -1):
            moved = T.copy()
            moved[:2, 3] -= back * step_m * np.array([np.cos(heading), np.sin(heading)])
            moved[2, 3] += city.height(*moved[:2, 3]) - city.height(*T[:2, 3])
            found.append(moved)
    return np.array(found)


def _around(T_map_camera: NDArray[np.float64], cameras: int) -> Transforms:
    """Return the poses T_map_camera (cameras, 4, 4) of all cameras of a vehicle; the last one is the given camera, which looks ahead."""
    ahead = T_map_camera[:3, 2] * [1, 1, 0]
    centre = T_map_camera[:3, 3] - RING_M * ahead / np.linalg.norm(ahead)
    turns = [rotation_z(2 * np.pi * k / cameras) for k in range(cameras - 1, -1, -1)]
    return np.array(
        [transform_from(R @ T_map_camera[:3, :3], centre + R @ (T_map_camera[:3, 3] - centre)) for R in turns]
    )


def _camera_on(T_map_lidar: NDArray[np.float64], plan: SimulationPlan, query: QueryPlan) -> NDArray[np.float64]:
    """Return T_map_camera of a camera below the LiDAR that looks ahead, plus its turn and pitch against the vehicle."""
    R = rotation_z(np.deg2rad(query.turn_deg)) @ rotation_y(np.deg2rad(query.pitch_deg)) @ R_BODY_OPTICAL
    T_lidar_camera = transform_from(R, np.array([0.0, 0.0, plan.camera_height_m - plan.lidar_height_m]))
    T: NDArray[np.float64] = T_map_lidar @ T_lidar_camera
    return T


@dataclass(frozen=True)
class Quota:
    """How many queries are wanted of each class. Without classes there is one class for all.

    Attributes:
        wanted: number of queries of each class.
        class_of: class of each candidate (n,); -1: not wanted.
    """

    wanted: list[int]
    class_of: NDArray[np.int64]


def quota_of(city: City, query: QueryPlan, candidates: Transforms) -> Quota:
    """Return the counts of the paper's Table I, or a single count if the query does not count by class.

    Args:
        city: city with street classes.
        query: query traversal.
        candidates: T_map_camera (n, 4, 4), metres.
    """
    if not query.per_class:
        return Quota([query.count], np.zeros(len(candidates), np.int64))
    shapes = [shapely.geometry.shape(feature["geometry"]) for feature in city.streets_geojson()["features"]]
    points = shapely.points(candidates[:, :2, 3])
    class_of = np.full(len(candidates), -1, np.int64)
    for index, shape in enumerate(shapes):
        class_of[shapely.contains(shape, points)] = index
    return Quota([count for _, _, count in TABLE_I], class_of)
