"""The last answers of a process, for monitoring by operators. No image data is kept."""

from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import count

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import heading_of_camera
from service.localization.answer import Answer, Status
from service.maps.map import Map

MOST = 200


@dataclass(frozen=True, slots=True, eq=False)
class LastAnswer:
    """Figures of one answer.

    Attributes:
        number: of the answer; counts from 1 since the process started.
        at: time of the answer, UTC.
        map_name: map that answered.
        map_version: version of that map.
        status: of the answer.
        confidence: None if the map is not calibrated.
        street: name of the street; None unless LOCALIZED, or if there is no street.
        position_m: of the camera, map frame; None unless LOCALIZED.
        heading_rad: of the camera, map frame; None unless LOCALIZED.
        frames: number of image pairs that the answer uses.
        total_ms: duration of the answer.
    """

    number: int
    at: datetime
    map_name: str
    map_version: str
    status: Status
    confidence: float | None
    street: str | None
    position_m: Float64[NDArray[np.float64], "3"] | None
    heading_rad: float | None
    frames: int
    total_ms: float


class LastAnswers:
    """Ring buffer of the last ``MOST`` answers.

    It is thread-safe without a lock, because every step of the deque and of the counter is atomic.
    """

    def __init__(self) -> None:
        self._kept: deque[LastAnswer] = deque(maxlen=MOST)
        self._numbers = count(1)

    def add(self, answer: Answer, bundle: Map, *, frames: int) -> None:
        """Keep the figures of an answer.

        Args:
            answer: to keep.
            bundle: map that answered.
            frames: number of image pairs that the answer uses.
        """
        localized, T_map_camera = answer.status == "LOCALIZED", answer.T_map_camera_guess
        has_street = localized and bundle.streets is not None and answer.street >= 0
        self._kept.append(
            LastAnswer(
                number=next(self._numbers),
                at=datetime.now(UTC),
                map_name=bundle.name,
                map_version=bundle.manifest.version,
                status=answer.status,
                confidence=answer.confidence,
                street=bundle.streets[answer.street].name if has_street and bundle.streets is not None else None,
                position_m=T_map_camera[:3, 3].copy() if localized else None,
                heading_rad=heading_of_camera(T_map_camera) if localized else None,
                frames=frames,
                total_ms=answer.timings.total_ms,
            )
        )

    def newest(self, most: int) -> list[LastAnswer]:
        """Return the newest answers, the newest one first.

        Args:
            most: number of answers at most.
        """
        return list(self._kept.copy())[: -most - 1 : -1]
