"""Localization of a moving robot from its last frames. A stream keeps them until it ends."""

from collections import deque
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.errors import RequestError
from service.geometry.rigid import Transform, inverse
from service.localization.localizer import Localizer
from service.retrieval.frame import Frame
from service.runtime.engine import EncodedQuery, Engine, Located
from service.timing import StageTimer

#: Maximum number of frames that an answer uses. Five frames resolve a street of repeating blocks (decision log).
MOST_FRAMES = 5


class Stream:
    """Frames of one robot. It is not thread-safe.

    Args:
        engine: localizes the frames.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._localizer: Localizer | None = None
        self._name: str | None = None
        self._frames: deque[Frame] = deque(maxlen=MOST_FRAMES - 1)  # newest first; poses are relative to the newest

    def localize(
        self, encoded: EncodedQuery, T_previous_camera: Float64[NDArray[np.float64], "4 4"] | None
    ) -> tuple[Located, int]:
        """Localize the next frame together with the frames before it.

        Args:
            encoded: the frame.
            T_previous_camera: odometry, from this camera's frame to the previous camera's frame, metres. None drops the frames
                before.

        Returns:
            The answer, and the number of frames that it uses.

        Raises:
            RequestError: the frame names another map than the frames before; or as for a single query.
        """
        before, self._frames = self._frames, deque(maxlen=MOST_FRAMES - 1)  # any failure below restarts the stream
        last, localizer = self._localizer, self._localizer_for(encoded)
        if (
            localizer is not last
        ):  # the first frame, or another map version serves now: the kept frames were retrieved from the old one
            before.clear()
        timer = StageTimer()
        frame = self._engine.look_up(localizer, encoded, timer)
        kept: list[Frame] = []
        if T_previous_camera is not None:
            back = inverse(T_previous_camera)
            kept = [replace(each, T_reference_camera=_closed(back @ each.T_reference_camera)) for each in before]
        located = self._engine.answer(localizer, (frame, *kept), timer)
        self._frames.extend([frame, *kept])
        return located, 1 + len(kept)

    def forget(self) -> None:
        """Drop all frames. After a failed frame the next odometry refers to a frame that the stream does not have."""
        self._frames.clear()

    def _localizer_for(self, encoded: EncodedQuery) -> Localizer:
        if self._localizer is None:
            self._name = encoded.map_name
        elif encoded.map_name not in (None, self._name, self._localizer.bundle.name):
            raise RequestError(
                f"map: this stream uses {self._localizer.bundle.name!r} since its first frame, not {encoded.map_name!r}; "
                "open another stream for another map",
                field="map",
            )
        self._localizer = self._engine.registry.get(self._name)
        if self._name is None:  # it is the only map now, but others may be mounted later
            self._name = self._localizer.bundle.name
        return self._localizer


def _closed(T: Transform) -> Transform:
    """Project the rotation onto SO(3) by SVD, because products of many odometry steps drift away from it."""
    u, _, vt = np.linalg.svd(T[:3, :3])
    found = T.copy()
    found[:3, :3] = u @ vt
    return found
