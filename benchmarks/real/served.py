"""Send the query sets of a dataset over HTTP to a service with one map."""

from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
from numpy.typing import NDArray

from model_training.cli.demo_service import serving
from model_training.datasets.dataset import Dataset
from model_training.loadtest.payloads import payloads
from service.geometry.rigid import rotation_from_quaternion_xyzw, transform_from

_TIMEOUT_S = 60.0


@dataclass(frozen=True, slots=True, eq=False)
class Served:
    """Answers of a service, one row per query.

    Attributes:
        T_map_camera: pose of the best hypothesis for any status (n, 4, 4), metres; infinite without a hypothesis.
        localized: whether the answer is accepted (n,).
        confidence: confidence of the answer (n,); NaN if there is none.
    """

    T_map_camera: NDArray[np.float64]
    localized: NDArray[np.bool_]
    confidence: NDArray[np.float64]


def served(bundle: Path, dataset: Dataset, queries: str) -> Served:
    """Send every query of a set over HTTP, with the files, intrinsics and depth format of the dataset.

    Args:
        bundle: folder of the map bundle to serve.
        dataset: dataset with the queries.
        queries: name of the query set.
    """
    poses, localized, confidence = [], [], []
    with serving(bundle, 0) as service, httpx.Client(base_url=service.url, timeout=_TIMEOUT_S) as client:
        for payload in payloads(dataset, queries, map_name=None, refine=True, most=1_000_000):
            reply = client.post("/v1/localize", content=payload.body, headers={"Content-Type": payload.content_type})
            answer = reply.raise_for_status().json()
            pose = answer["hypotheses"][0]["pose"] if answer["hypotheses"] else answer["pose"]
            localized.append(answer["status"] == "LOCALIZED")
            confidence.append(np.nan if answer["confidence"] is None else answer["confidence"])
            poses.append(np.full((4, 4), np.inf) if pose is None else _transform(pose))
    return Served(np.array(poses).reshape(-1, 4, 4), np.array(localized, bool), np.array(confidence, np.float64))


def _transform(pose: dict[str, dict[str, float]]) -> NDArray[np.float64]:
    position, orientation = pose["position"], pose["orientation"]
    R = rotation_from_quaternion_xyzw(np.array([orientation[axis] for axis in "xyzw"]))
    return transform_from(R, np.array([position[axis] for axis in "xyz"]))


def away_m(T: NDArray[np.float64], T_true: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances (n,) between positions, metres.

    Args:
        T: poses (n, 4, 4).
        T_true: ground-truth poses (n, 4, 4).
    """
    return np.asarray(np.linalg.norm(T[:, :3, 3] - T_true[:, :3, 3], axis=1))
