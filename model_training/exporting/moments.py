"""A dataset as one drive in time: its survey first, then a query set, as a recorder on the vehicle would have met them."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from model_training.datasets.dataset import CameraSensor, Dataset, QueryFrame
from service.errors import DatasetError
from service.geometry.rigid import R_BODY_OPTICAL, Transform, inverse, transform_from

#: Between the survey's last scan and the first picture, where their own times would overlap.
PAUSE_S = 10.0
#: Where a camera stands that the dataset does not mount: at the vehicle's origin, looking ahead.
_AHEAD: Transform = transform_from(R_BODY_OPTICAL, np.zeros(3))


@dataclass(frozen=True, slots=True)
class Moment:
    """A scan or a picture pair at a time; never both."""

    stamp_s: float
    T_map_vehicle: Transform
    points: Float32[NDArray[np.float32], "N 4"] | None = None
    frame: QueryFrame | None = None


def T_vehicle_lidar(dataset: Dataset) -> Transform:
    """Where the first LiDAR stands; the vehicle's own frame where the dataset does not say."""
    lidars = dataset.description.sensors.lidars
    mounted = lidars[0].T_vehicle_sensor if lidars else None
    return np.eye(4) if mounted is None else np.array(mounted, np.float64)


def T_vehicle_camera(camera: CameraSensor) -> Transform:
    """Where a camera stands."""
    return _AHEAD if camera.T_vehicle_sensor is None else np.array(camera.T_vehicle_sensor, np.float64)


def the_camera(dataset: Dataset, queries: str) -> CameraSensor:
    """The one camera of a query set.

    Raises:
        DatasetError: there are several, which one topic cannot hold.
    """
    cameras = {frame.camera.name: frame.camera for frame in dataset.queries(queries)}
    if len(cameras) != 1:
        raise DatasetError(
            f"query set {queries!r} has pictures of {len(cameras)} cameras ({', '.join(cameras)}); one is wanted",
            field="queries",
        )
    return next(iter(cameras.values()))


def moments(dataset: Dataset, queries: str | None) -> Iterator[Moment]:
    """Scans in their order, then the picture pairs of a query set, shifted in time to come after them.

    Raises:
        DatasetError: a picture of the set has no pose.
    """
    stamps, poses = dataset.survey_trajectory()
    T_lidar_vehicle = inverse(T_vehicle_lidar(dataset))
    for number, (stamp_s, T_map_lidar) in enumerate(zip(stamps, poses, strict=True)):
        yield Moment(float(stamp_s), T_map_lidar @ T_lidar_vehicle, points=dataset.scan(number))
    shift_s: float | None = None
    for frame in dataset.queries(queries) if queries else ():
        if frame.T_map_camera is None or frame.stamp_s is None:
            raise DatasetError(f"query set {queries!r} has no poses.txt, so it is no part of a drive", field="queries")
        if shift_s is None:
            shift_s = max(0.0, float(stamps[-1]) + PAUSE_S - frame.stamp_s)
        T_map_vehicle = frame.T_map_camera @ inverse(T_vehicle_camera(frame.camera))
        yield Moment(frame.stamp_s + shift_s, T_map_vehicle, frame=frame)
