"""Ask a service for the pose of an image pair."""

import numpy as np
from numpy.typing import NDArray

from service.bridge.known import Known
from service.client import Client
from service.client.prepare import RequestOptions
from service.contract.schema import LocalizeAnswer
from service.geometry.camera import PinholeCamera


class AskService:
    """Sends image pairs to a service.

    Args:
        client: of the service.
        map_name: name of the map; None if the service has one.
    """

    def __init__(self, client: Client, map_name: str | None = None) -> None:
        self._client, self._map_name = client, map_name

    def __call__(
        self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32], camera: PinholeCamera, known: Known
    ) -> LocalizeAnswer:
        """Localize an image pair.

        Args:
            rgb: sRGB image, (H, W, 3).
            depth_m: z along the optical axis, metres, (H, W).
            camera: intrinsics and distortion of both images.
            known: facts beside the images.

        Raises:
            StreetfixError: as ``Client.localize``.
        """
        return self._client.localize(rgb, depth_m, camera, **self._about(known))

    def _about(self, known: Known) -> RequestOptions:
        """Return the optional data of the request. An earlier service does not know all of them, so only known facts are sent."""
        about: RequestOptions = {"map": self._map_name}
        if known.baseline_m is not None:
            about["baseline_m"] = known.baseline_m
        if (height := known.camera_height) is not None:
            about["camera_height_m"], about["camera_height_std_m"] = height.height_m, height.std_m
        return about
