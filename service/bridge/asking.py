"""Ask a service for the pose of an image pair."""

import math

import numpy as np
from numpy.typing import NDArray

from service.bridge.known import Known, Motion
from service.client import Client
from service.client.prepare import RequestOptions, Track
from service.contract import schema
from service.errors import RefusedError
from service.geometry.camera import PinholeCamera
from service.localization.belief import OdometryStd
from service.option_limits import (
    LEAST_ODOMETRY_STD_DEG,
    LEAST_ODOMETRY_STD_M,
    MOST_ODOMETRY_STD_DEG,
    MOST_ODOMETRY_STD_M,
)
from service.retrieval.prior import Prior


class AskService:
    """Sends image pairs to a service, and carries the belief of a track from answer to query.

    Args:
        client: of the service.
        map_name: name of the map; None if the service has one.
        false_accept_rate: tolerated share of out-of-map queries that become LOCALIZED, 0 to 1; None takes that of the service.
    """

    def __init__(self, client: Client, map_name: str | None = None, false_accept_rate: float | None = None) -> None:
        self._client, self._map_name, self._false_accept_rate = client, map_name, false_accept_rate
        self._before: schema.LocalizeAnswer | None = None

    def __call__(
        self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32], camera: PinholeCamera, known: Known
    ) -> schema.LocalizeAnswer:
        """Localize an image pair.

        If the service refuses the track, for example because it was restarted, the next query begins another track.

        Args:
            rgb: sRGB image, (H, W, 3).
            depth_m: z along the optical axis, metres, (H, W).
            camera: intrinsics and distortion of both images.
            known: facts beside the images.

        Raises:
            StreetfixError: as ``Client.localize``.
        """
        try:
            answer = self._client.localize(rgb, depth_m, camera, **self._about(known))
        except RefusedError as error:
            if error.field.startswith("track"):
                self._before = None
            raise
        self._before = None if known.motion is None else answer
        return answer

    def _about(self, known: Known) -> RequestOptions:
        """Return the optional data of the request. An earlier service does not know all of them, so only known facts are sent."""
        about: RequestOptions = {"map": self._map_name}
        if self._false_accept_rate is not None:
            about["options"] = schema.Options(false_accept_rate=self._false_accept_rate)
        if known.baseline_m is not None:
            about["baseline_m"] = known.baseline_m
        if (height := known.camera_height) is not None:
            about["camera_height_m"], about["camera_height_std_m"] = height.height_m, height.std_m
        if known.down_camera is not None:
            about["gravity"] = known.down_camera
        if known.prior is not None:
            about["prior"] = _prior(known.prior)
        if known.motion is not None:
            about["track"] = self._track(known.motion)
        return about

    def _track(self, motion: Motion) -> Track:
        if self._before is None:
            return Track()
        return Track(
            before=self._before,
            T_previous_camera=motion.T_previous_camera,
            odometry_std=None if motion.std is None else _odometry_std(motion.std),
        )


def _odometry_std(std: OdometryStd) -> schema.OdometryStd:
    """Convert standard deviations of odometry to the contract. A robot that stands still has none, and the contract has a least one."""
    return schema.OdometryStd(
        position_m=float(np.clip(std.position_m, LEAST_ODOMETRY_STD_M, MOST_ODOMETRY_STD_M)),
        angle_deg=float(np.clip(math.degrees(std.angle_rad), LEAST_ODOMETRY_STD_DEG, MOST_ODOMETRY_STD_DEG)),
    )


def _prior(prior: Prior) -> schema.Prior:
    """Convert a prior to the contract."""
    position = None
    if prior.position_m is not None:
        x, y = prior.position_m.tolist()
        position = schema.PriorPosition(x=x, y=y, std_m=prior.position_std_m)
    heading_deg = None if prior.heading_rad is None else math.degrees(prior.heading_rad)
    return schema.Prior(position=position, heading_deg=heading_deg, heading_std_deg=math.degrees(prior.heading_std_rad))
