"""Frames of a dataset as one question: the odometry between them as a robot's wheels would give it."""

from dataclasses import replace

import numpy as np

from model_training.datasets.dataset import QueryFrame
from service.geometry.rigid import Transform, inverse, rotation_z, transform_from
from service.imaging.view_grid import ViewGrid
from service.localization.query import Query

#: Errors of the odometry from frame to frame: a share of the way, and a turn.
_WAY, _TURN_RAD = 0.01, float(np.deg2rad(0.2))


def as_query(
    frames: list[QueryFrame],
    rng: np.random.Generator,
    *,
    grid: ViewGrid,
    ranked: int,
    refine: bool = True,
    exact: bool = False,
) -> tuple[tuple[Query, ...], tuple[Transform, ...]]:
    """The last frame first, and where the others stood against it, by odometry.

    Args:
        frames: in the order of the drive.
        rng: of the odometry's errors.
        grid: of the map that will be asked.
        ranked: distinct places that the answer shall name.
        refine: whether to register.
        exact: the odometry is that of the frames' true poses, without errors of its own.
    """
    queries, poses, T_last_this = [], [], np.eye(4)
    for k in range(len(frames) - 1, -1, -1):
        frame, later = frames[k], frames[k + 1] if k + 1 < len(frames) else None
        if later is not None and frame.T_map_camera is not None and later.T_map_camera is not None:
            step = inverse(later.T_map_camera) @ frame.T_map_camera
            way = float(np.linalg.norm(step[:3, 3]))
            error = transform_from(rotation_z(rng.normal(0, _TURN_RAD)), rng.normal(0, _WAY * way, 3))
            T_last_this = T_last_this @ step if exact else T_last_this @ step @ error
        queries.append(replace(frame.query(grid), ranked=ranked, refine=refine))
        poses.append(T_last_this)
    return tuple(queries), tuple(poses)
