"""Query sets of a dataset asked over HTTP of a service that serves one map."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model_training.cli.demo_service import serving
from model_training.datasets.dataset import Dataset
from service.client import Client
from service.geometry.rigid import rotation_from_quaternion_xyzw, transform_from


def answers(bundle: Path, dataset: Dataset, queries: str) -> NDArray[np.float64]:
    """T_map_camera (n, 4, 4) of every query's answer, whatever its status: the best hypothesis counts; infinite where there is none."""
    found = []
    with serving(bundle, 0) as service, Client(service.url) as client:
        for frame in dataset.queries(queries):
            answer = client.localize(frame.rgb(), frame.depth_m(), frame.camera.pinhole())
            pose = answer.hypotheses[0].pose if answer.hypotheses else answer.pose
            if pose is None:
                found.append(np.full((4, 4), np.inf))
                continue
            position, turned = pose.position, pose.orientation
            R = rotation_from_quaternion_xyzw(np.array([turned.x, turned.y, turned.z, turned.w]))
            found.append(transform_from(R, np.array([position.x, position.y, position.z])))
    return np.array(found).reshape(-1, 4, 4)


def away_m(T: NDArray[np.float64], T_true: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances (n) between positions."""
    return np.asarray(np.linalg.norm(T[:, :3, 3] - T_true[:, :3, 3], axis=1))
