"""The pipeline in the process of the bridge, without a service and without encoded images. It keeps the track of the robot."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.bridge.known import Known, Motion
from service.contract.convert import answer_from, require_camera
from service.contract.schema import LocalizeAnswer
from service.geometry.camera import PinholeCamera
from service.imaging.decode import require_sizes
from service.imaging.depth_units import depth_from_values
from service.localization.answer import Answer
from service.localization.tracker import Track, follow
from service.option_limits import FALSE_ACCEPT_RATE
from service.retrieval.query import Query
from service.runtime.engine import Located, expect_next
from service.runtime.map_registry import MapRegistry
from service.runtime.threads import limit_pools


class InPlace:
    """Localizes in a map that this process has open.

    Args:
        bundle: folder of the map bundle.
        false_accept_rate: tolerated share of out-of-map queries that become LOCALIZED, 0 to 1; None for the default.

    Raises:
        BundleError: the bundle is missing or damaged.
    """

    def __init__(self, bundle: Path, false_accept_rate: float | None = None) -> None:
        limit_pools()
        self._false_accept_rate = false_accept_rate
        self._localizer = MapRegistry.open((bundle,)).get(None)
        self._track = Track()

    def __call__(
        self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32], camera: PinholeCamera, known: Known
    ) -> LocalizeAnswer:
        """Localize an image pair, like ``Client.localize``.

        Args:
            rgb: sRGB image, (H, W, 3).
            depth_m: z along the optical axis, metres, (H, W).
            camera: intrinsics and distortion of both images.
            known: facts beside the images.

        Raises:
            RequestError: the intrinsics or the distortion are invalid, an image does not fit them, or the depth image holds no depth.
        """
        require_camera(camera)
        z_m = depth_from_values(depth_m, scale_m=1.0, kind="z", camera=camera, baseline_m=None, max_range_m=None)
        require_sizes(rgb, z_m, camera)
        pair = Query.of_images(rgb, z_m, camera, baseline_m=known.baseline_m)
        query = replace(
            pair,
            camera_height=known.camera_height,
            down_camera=known.down_camera,
            prior=known.prior,
            false_accept_rate=self._false_accept_rate or FALSE_ACCEPT_RATE,
            rate_is_named=self._false_accept_rate is not None,
        )
        return answer_from(Located(self._answer(query, known.motion), self._localizer.bundle))

    def _answer(self, query: Query, motion: Motion | None) -> Answer:
        """Answer a query alone, or as the next one of the track, as a stream of the service does."""
        if motion is None:
            answer = self._localizer.localize(query)
            self._track = Track()
            return answer
        frame, T_previous_camera = self._localizer.encode_and_search(query), motion.T_previous_camera
        answer, self._track = follow(self._localizer, frame, self._track, T_previous_camera, motion.std)
        expect_next(self._localizer.bundle, self._track, T_previous_camera)
        return answer
