"""The whole method of [31] by stage: the poses of GoogLeNet, PointNetLK and ICP."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from research.baselines.answers import PlaceAnswers, nearest_streets
from research.baselines.learning import Report, one_thread
from research.baselines.paper_data.pairs import Pairs
from research.baselines.regression.clouds import depth_points
from research.baselines.regression.map_cloud import MapCloud
from research.baselines.regression.pointnet import PointNet
from research.baselines.regression.refine import by_icp, by_pointnet_lk
from research.baselines.regression.train_pose import PoseRegressor
from service.maps.streets import Streets

#: Stages; each continues from the previous one, and the last one is the method.
STAGES = ("googlenet", "googlenet_pointnetlk", "icp_pointnetlk_googlenet")


@dataclass(frozen=True, slots=True, eq=False)
class StageAnswers:
    """Answers of a stage.

    Attributes:
        places: position and street of each query.
        T_map_camera: poses (n, 4, 4).
        registered: whether the pose is the stage's own (n,); otherwise it is the previous stage's.
    """

    places: PlaceAnswers
    T_map_camera: NDArray[np.float64]
    registered: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Method:
    """Trained parts of the method.

    Attributes:
        regressor: trained GoogLeNet.
        net: trained PointNet.
        cloud: map cloud.
        streets: streets of the map.
    """

    regressor: PoseRegressor
    net: PointNet
    cloud: MapCloud
    streets: Streets


def locate(method: Method, pairs: Pairs, *, report: Report = lambda *_: None) -> PlaceAnswers:
    """Locate each pair by all stages.

    Args:
        method: trained parts.
        pairs: RGB-D queries.
        report: receives a label, the number done and the total.

    Raises:
        ExtraMissingError: small_gicp is not installed.
    """
    return locate_by_stage(method, pairs, report=report)[STAGES[-1]].places


def locate_by_stage(method: Method, pairs: Pairs, *, report: Report = lambda *_: None) -> Mapping[str, StageAnswers]:
    """Locate each pair, and return the answers of each of ``STAGES``.

    Args:
        method: trained parts.
        pairs: RGB-D queries.
        report: receives a label, the number done and the total.

    Raises:
        ExtraMissingError: small_gicp is not installed.
    """
    with one_thread():
        guessed = method.regressor.poses(pairs)
        after_lk, after_icp = guessed.copy(), guessed.copy()
        by_lk, by_last = np.zeros(len(pairs), np.bool_), np.zeros(len(pairs), np.bool_)
        for row in range(len(pairs)):
            points = depth_points(pairs, row)
            first = by_pointnet_lk(method.net, method.cloud, points, guessed[row], pairs.camera)
            second = by_icp(method.cloud, points, first.T_map_camera)
            after_lk[row], by_lk[row] = first.T_map_camera, first.registered
            after_icp[row], by_last[row] = second.T_map_camera, second.registered
            report("refinement", row + 1, len(pairs))
    every = np.ones(len(pairs), np.bool_)
    stages = zip(STAGES, (guessed, after_lk, after_icp), (every, by_lk, by_last), strict=True)
    return {name: _answered(method.streets, T, own) for name, T, own in stages}


def _answered(streets: Streets, T_map_camera: NDArray[np.float64], registered: NDArray[np.bool_]) -> StageAnswers:
    xy = T_map_camera[:, :2, 3].copy()
    return StageAnswers(PlaceAnswers(xy, nearest_streets(streets, xy)), T_map_camera, registered)
