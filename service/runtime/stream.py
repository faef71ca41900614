"""A robot that drives: its last frames, kept as long as its stream lives."""

from collections import deque
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.errors import RequestError
from service.geometry.rigid import Transform, inverse
from service.localization.frames import Frame
from service.localization.localizer import Localizer
from service.runtime.engine import EncodedQuery, Engine, Located

#: Frames that an answer rests on at most; in a street of repeating blocks five tell (decision log).
MOST_FRAMES = 5


class Stream:
    """Frames of one robot; not safe to call from several threads at once."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._localizer: Localizer | None = None
        self._name: str | None = None
        self._frames: deque[Frame] = deque(maxlen=MOST_FRAMES - 1)  # the newest first, against the newest

    def localize(
        self, encoded: EncodedQuery, T_previous_camera: Float64[NDArray[np.float64], "4 4"] | None
    ) -> tuple[Located, int]:
        """Answer the next frame together with those before it; the answer, and how many frames it rests on.

        Args:
            encoded: the frame.
            T_previous_camera: odometry: coordinates of this camera to the one before; None forgets the frames before.

        Raises:
            RequestError: another map is asked than before, or as for a single query.
        """
        before, self._frames = self._frames, deque(maxlen=MOST_FRAMES - 1)  # whatever fails here begins the stream anew
        last, localizer = self._localizer, self._localizer_for(encoded)
        if (
            localizer is not last
        ):  # the first frame, or another version of the map serves now: what was looked up is not of it
            before.clear()
        frame, decode_ms = self._engine.look_up(localizer, encoded)
        kept: list[Frame] = []
        if T_previous_camera is not None:
            back = inverse(T_previous_camera)
            kept = [replace(each, T_reference_camera=_closed(back @ each.T_reference_camera)) for each in before]
        located = self._engine.answer(localizer, (frame, *kept), decode_ms)
        self._frames.extend([frame, *kept])
        return located, 1 + len(kept)

    def forget(self) -> None:
        """Begin anew: the next frame's odometry would lead to a frame that is not there."""
        self._frames.clear()

    def _localizer_for(self, encoded: EncodedQuery) -> Localizer:
        if self._localizer is None:
            self._name = encoded.map_name
        elif encoded.map_name not in (None, self._name, self._localizer.bundle.name):
            raise RequestError(
                f"map: this stream asks {self._localizer.bundle.name!r} since its first frame, not {encoded.map_name!r}; "
                "open another stream for another map", field="map",
            )  # fmt: skip
        self._localizer = self._engine.registry.get(self._name)
        if self._name is None:  # the only map now; others may come
            self._name = self._localizer.bundle.name
        return self._localizer


def _closed(T: Transform) -> Transform:
    """The nearest rotation again: products of many odometry steps drift off it."""
    u, _, vt = np.linalg.svd(T[:3, :3])
    found = T.copy()
    found[:3, :3] = u @ vt
    return found
