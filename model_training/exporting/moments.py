"""Order a dataset in time as one traversal: first its survey, then a query set, as if a vehicle had recorded them."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from model_training.datasets.dataset import CameraSensor, Dataset, QueryFrame
from service.errors import DatasetError
from service.geometry.rigid import R_BODY_OPTICAL, Transform, inverse, transform_from

#: Time between the survey's last scan and the first image if their own times would overlap, seconds.
PAUSE_S = 10.0
#: Default mounting of a camera: at the vehicle's origin, looking ahead (T_vehicle_camera, optical frame).
_AHEAD: Transform = transform_from(R_BODY_OPTICAL, np.zeros(3))


@dataclass(frozen=True, slots=True)
class Moment:
    """A scan or an image pair at one time; never both.

    Attributes:
        stamp_s: time, seconds.
        T_map_vehicle: pose of the vehicle.
        points: x y z (m, LiDAR frame) and intensity; None for an image pair.
        frame: image pair; None for a scan.
    """

    stamp_s: float
    T_map_vehicle: Transform
    points: Float32[NDArray[np.float32], "N 4"] | None = None
    frame: QueryFrame | None = None


def T_vehicle_lidar(dataset: Dataset) -> Transform:
    """Return the mounting of the first LiDAR (4, 4); the identity if the dataset does not give one.

    Args:
        dataset: to read.
    """
    lidars = dataset.description.sensors.lidars
    mounted = lidars[0].T_vehicle_sensor if lidars else None
    return np.eye(4) if mounted is None else np.array(mounted, np.float64)


def T_vehicle_camera(camera: CameraSensor) -> Transform:
    """Return the mounting of a camera (4, 4), optical frame; looking ahead if the dataset does not give one.

    Args:
        camera: of the dataset.
    """
    return _AHEAD if camera.T_vehicle_sensor is None else np.array(camera.T_vehicle_sensor, np.float64)


def single_camera(dataset: Dataset, queries: str) -> CameraSensor:
    """Return the one camera of a query set.

    Args:
        dataset: to read.
        queries: name of the query set.

    Raises:
        DatasetError: the set has no camera, or several: one topic holds only one.
    """
    cameras = {frame.camera.name: frame.camera for frame in dataset.queries(queries)}
    if len(cameras) != 1:
        raise DatasetError(
            f"query set {queries!r} has images of {len(cameras)} cameras ({', '.join(cameras)}); expected one camera",
            field="queries",
        )
    return next(iter(cameras.values()))


def moments(dataset: Dataset, queries: str | None) -> Iterator[Moment]:
    """Yield the scans in order, then the image pairs of a query set, shifted in time so that they follow.

    Args:
        dataset: to read.
        queries: name of the query set; None for none.

    Raises:
        DatasetError: an image pair has no pose.
    """
    stamps, poses = dataset.survey_trajectory()
    T_lidar_vehicle = inverse(T_vehicle_lidar(dataset))
    for number, (stamp_s, T_map_lidar) in enumerate(zip(stamps, poses, strict=True)):
        yield Moment(float(stamp_s), T_map_lidar @ T_lidar_vehicle, points=dataset.scan(number))
    shift_s: float | None = None
    for frame in dataset.queries(queries) if queries else ():
        if frame.T_map_camera is None or frame.stamp_s is None:
            raise DatasetError(f"query set {queries!r} has no poses.txt, so it cannot be exported", field="queries")
        if shift_s is None:
            shift_s = max(0.0, float(stamps[-1]) + PAUSE_S - frame.stamp_s)
        T_map_vehicle = frame.T_map_camera @ inverse(T_vehicle_camera(frame.camera))
        yield Moment(frame.stamp_s + shift_s, T_map_vehicle, frame=frame)
