"""Localization of a moving robot from its last frames. A stream keeps its track until it ends."""

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.errors import RequestError
from service.localization.belief import OdometryStd
from service.localization.localizer import Localizer
from service.localization.tracker import Track
from service.runtime.engine import EncodedQuery, Engine, Located


class Stream:
    """Frames of one robot. It is not thread-safe.

    Args:
        engine: localizes the frames.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._localizer: Localizer | None = None
        self._name: str | None = None
        self._track = Track()

    def localize(
        self,
        encoded: EncodedQuery,
        T_previous_camera: Float64[NDArray[np.float64], "4 4"] | None,
        odometry_std: OdometryStd | None = None,
    ) -> tuple[Located, int]:
        """Localize the next frame with what the frames before say.

        Args:
            encoded: the frame.
            T_previous_camera: odometry, from this camera's frame to the previous camera's frame, metres. None begins again.
            odometry_std: standard deviations of the odometry; None if they are unknown.

        Returns:
            The answer, and the number of frames that are registered together in it.

        Raises:
            RequestError: the frame names another map than the frames before, or has a track of its own; or as for a single query.
        """
        before = self._track
        self.forget()  # any failure below begins again
        if encoded.track is not None:
            raise RequestError("track: the stream keeps the track; omit track in a stream", field="track")
        last, localizer = self._localizer, self._localizer_for(encoded)
        if (
            localizer is not last
        ):  # the first frame, or another map version serves now: the poses before refer to the old one
            before = before.broken()
        located, self._track = self._engine.follow(localizer, (encoded,), before, T_previous_camera, odometry_std)
        return located, located.answer.frames

    def forget(self) -> None:
        """Begin again. After a failed frame the next odometry refers to a frame that the stream does not have."""
        self._track = self._track.broken()

    def _localizer_for(self, encoded: EncodedQuery) -> Localizer:
        if self._localizer is None:
            self._name = encoded.map_name
        elif encoded.map_name not in (None, self._name, self._localizer.bundle.name):
            raise RequestError(
                f"map: this stream uses {self._localizer.bundle.name!r} since its first frame, not {encoded.map_name!r}; "
                "open another stream for another map",
                field="map",
            )
        if self._name is None:  # the frames after the first one keep to its map
            self._localizer = self._engine.localizer_for(encoded)
            self._name = self._localizer.bundle.name
        else:
            self._localizer = self._engine.registry.get(self._name)
        return self._localizer
