"""Errors of poses in the order of the answer's covariance."""

import numpy as np
from numpy.typing import NDArray


def pose_errors(T_answer: NDArray[np.float64], T_true: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return errors (n, 6) of translation (m) and rotation (rad) about map axes, in the covariance's order.

    Args:
        T_answer: T_map_camera of the answers (n, 4, 4).
        T_true: T_map_camera of the ground truth (n, 4, 4).
    """
    R = T_answer[:, :3, :3] @ T_true[:, :3, :3].transpose(0, 2, 1)
    angle = np.arccos(np.clip((np.trace(R, axis1=1, axis2=2) - 1) / 2, -1, 1))
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1) / 2
    scale = angle / np.maximum(np.sin(angle), 1e-12)
    return np.concatenate([T_answer[:, :3, 3] - T_true[:, :3, 3], axis * scale[:, None]], axis=1)
