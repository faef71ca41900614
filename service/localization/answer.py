"""What is known about where a query was taken."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.errors import NotFiniteError
from service.geometry.rigid import Transform
from service.localization.hypotheses import Hypothesis
from service.localization.judge import Candidate
from service.localization.reasons import Reason
from service.localization.search import Neighbour
from service.localization.spread import Spread
from service.localization.street_vote import StreetVote

Status = Literal["LOCALIZED", "AMBIGUOUS", "OUT_OF_MAP"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Timings:
    """Milliseconds of each stage; ``decode_ms`` and ``total_ms`` with it are filled in by whoever decoded."""

    decode_ms: float = 0.0
    fuse_ms: float
    encode_ms: float
    search_ms: float
    register_ms: float = 0.0
    total_ms: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """The answer to one query.

    What is named ``_guess``, the street and the covariance are of the best guess, whatever the status. Only evaluation may use them
    of an answer that is not LOCALIZED: ``service.contract.convert`` leaves them out of what a caller gets.

    Attributes:
        status: how far the answer can be trusted; LOCALIZED wherever confidence is None.
        confidence: calibrated probability that the position is within 1 m; None without registration or calibration.
        evidence: what the confidence rests on, as ``service.maps.calibration.FEATURES``; None without registration.
        street: number of the best guess' street; -1 for none. With registration the street under the position, else the vote's.
        vote: the k-nearest vote over streets; None where the map has none.
        T_map_camera_guess: best guess of the camera's pose: registered, or of the heaviest cluster.
        covariance: of ``T_map_camera_guess`` if that is right, translation first, then rotation, map axes, about the camera; None
            without registration.
        candidates: the registered poses, the best supported first; None where nothing was registered. Where the answer is not
            LOCALIZED, each of those that exclude each other has its covariance, else only the first.
        spread: where the camera may be; None for a LOCALIZED answer.
        reasons: what may be wrong with the question or the map, the likeliest first; empty for a LOCALIZED answer, and where all
            evidence lies in the range that calibration saw.
        frames: so many were asked together.
        T_map_vehicle_guess: best guess of the vehicle's pose, where the query said how the camera sits on it.
        neighbours: k distinct places, those nearest to the registered poses first, then the most similar.
        hypotheses: all clusters of the most similar views, the heaviest first; with a prior, what it believes most.
        measured_share: share of the view grid's cells with a measurement.
        height_m: of the camera above the ground.
    """

    status: Status
    confidence: float | None
    street: int
    vote: StreetVote | None
    T_map_camera_guess: Transform
    covariance: Float64[NDArray[np.float64], "6 6"] | None
    candidates: tuple[Candidate, ...] | None
    spread: Spread | None
    reasons: tuple[Reason, ...]
    frames: int
    evidence: Float64[NDArray[np.float64], " F"] | None
    T_map_vehicle_guess: Transform | None
    neighbours: tuple[Neighbour, ...]
    hypotheses: tuple[Hypothesis, ...]
    measured_share: float
    height_m: float
    timings: Timings


def require_finite(answer: Answer) -> None:
    """Refuse an answer with a number that is not finite: NaN would reach a robot's controller, or pass as OUT_OF_MAP without a word.

    Every field is looked at, with all that it holds, so that a new one cannot be left out.

    Raises:
        NotFiniteError: naming the first such number's path, as ``candidates.0.support``.
    """
    numbers: list[float] = []
    _gather(answer, numbers)
    if np.isfinite(numbers).all():
        return
    for path, value in _paths(answer, ""):  # a sum may overflow without any such number
        if not np.isfinite(value).all():
            raise NotFiniteError(path)


def _gather(value: object, numbers: list[float]) -> None:
    """Append every number below a value; of an array its sum, which is not finite if any number in it is not."""
    if isinstance(value, float):
        numbers.append(value)
    elif isinstance(value, np.ndarray):
        numbers.append(float(value.sum()))
    elif isinstance(value, tuple):
        for each in value:
            _gather(each, numbers)
    else:
        for name in getattr(value, "__dataclass_fields__", ()):
            _gather(getattr(value, name), numbers)


def _paths(value: object, path: str) -> Iterator[tuple[str, float | NDArray[np.generic]]]:
    """Every number and array below a value, with its path."""
    if isinstance(value, (float, np.ndarray)):
        yield path, value
    elif isinstance(value, tuple):
        for number, each in enumerate(value):
            yield from _paths(each, f"{path}.{number}")
    else:
        for name in getattr(value, "__dataclass_fields__", ()):
            yield from _paths(getattr(value, name), f"{path}.{name}".removeprefix("."))
