"""Combine frames of a dataset into one sequence query, with simulated odometry between them."""

from dataclasses import replace

import numpy as np

from model_training.datasets.dataset import QueryFrame, Transforms
from service.geometry.rigid import Transform, inverse, rotation_y, transform_from
from service.imaging.view_grid import ViewGrid
from service.retrieval.query import Query

#: Standard deviations of the odometry's error from frame to frame: translation as a share of the travelled distance, and yaw.
_WAY, _TURN_RAD = 0.01, float(np.deg2rad(0.2))


def odometry_between(T_map_one: Transform, T_map_other: Transform, rng: np.random.Generator | None) -> Transform:
    """Return the pose of a camera in the frame of another one, with the errors of an odometry step.

    Args:
        T_map_one: true pose (4, 4) of the camera whose frame it is, metres.
        T_map_other: true pose (4, 4) of the camera whose pose it is, metres.
        rng: random generator of the errors; None: exact.
    """
    step: Transform = inverse(T_map_one) @ T_map_other
    if rng is None:
        return step
    way = float(np.linalg.norm(step[:3, 3]))
    # The y axis of a camera points down, so yaw is a rotation about it.
    return step @ transform_from(rotation_y(rng.normal(0, _TURN_RAD)), rng.normal(0, _WAY * way, 3))


def as_query(
    frames: list[QueryFrame],
    rng: np.random.Generator,
    *,
    grid: ViewGrid,
    ranked: int,
    refine: bool = True,
    exact: bool = False,
    T_odom_camera: Transforms | None = None,
) -> tuple[tuple[Query, ...], tuple[Transform, ...]]:
    """Return the queries of a sequence, the last frame first, and the pose of each camera in the last camera's frame (4, 4).

    Args:
        frames: frames in the order of the traversal.
        rng: random generator for the errors of the odometry.
        grid: view grid of the map to query.
        ranked: number of distinct places in the answer.
        refine: register the answer.
        exact: take the odometry from the true poses, without errors.
        T_odom_camera: recorded odometry of the frames (n, 4, 4), metres, instead of the true poses.
    """
    queries, poses, T_last_this = [], [], np.eye(4)
    for k in range(len(frames) - 1, -1, -1):
        frame, later = frames[k], frames[k + 1] if k + 1 < len(frames) else None
        if T_odom_camera is not None:
            T_last_this = inverse(T_odom_camera[-1]) @ T_odom_camera[k]
        elif later is not None and frame.T_map_camera is not None and later.T_map_camera is not None:
            T_last_this = T_last_this @ odometry_between(later.T_map_camera, frame.T_map_camera, None if exact else rng)
        queries.append(replace(frame.query(grid), ranked=ranked, refine=refine))
        poses.append(T_last_this)
    return tuple(queries), tuple(poses)
