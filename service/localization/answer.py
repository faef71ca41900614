"""The answer to a query: its fields, and the check that all numbers are finite."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.confidence.reasons import Reason
from service.confidence.spread import Spread
from service.errors import NotFiniteError
from service.geometry.rigid import Transform
from service.imaging.level import HeightOrigin
from service.localization.belief import Belief
from service.maps.calibration import Threshold
from service.retrieval.hypotheses import Hypothesis
from service.retrieval.knn import Neighbour, StreetVote
from service.scoring.candidates import Candidate

Status = Literal["LOCALIZED", "AMBIGUOUS", "OUT_OF_MAP"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Timings:
    """Duration of each stage of one request, in milliseconds.

    A frame that a stream has kept counts in the request that brought it.

    Attributes:
        decode_ms: decoding of the images, summed over the frames; 0 if the query came decoded.
        fuse_ms: levelling, resampling and fusion to query views, summed over the frames.
        encode_ms: encoding to descriptors, summed over the frames.
        search_ms: search of the map, ranking of the places, clustering and street vote.
        register_ms: everything after retrieval; 0 without registration.
        total_ms: all stages.
    """

    decode_ms: float = 0.0
    fuse_ms: float
    encode_ms: float
    search_ms: float
    register_ms: float = 0.0
    total_ms: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """The answer to one query.

    The street, the covariance and the fields named ``_guess`` describe the best guess, whatever the status.
    If the answer is not LOCALIZED, only evaluation may use them: ``service.contract.convert`` removes them from the response.

    Attributes:
        status: how far the answer can be trusted; LOCALIZED if ``confidence`` is None.
        confidence: calibrated probability that the position is within 1 m. None if the query requested no registration, the map
            has no cloud or no calibration. 0 if the images have too few points to register.
        street: number of the street of the best guess, -1 for none. With registration it is the street under the position, else
            the street of the heaviest cluster.
        vote: street vote of the k nearest places; None if the map has no streets.
        T_map_camera_guess: best guess of the camera pose: registered, or that of the heaviest cluster.
        covariance: of ``T_map_camera_guess``, if this pose is right: translation (m), then rotation (rad), in map axes, about
            the camera. None without registration.
        candidates: registered poses, the best supported first; None without registration. In a LOCALIZED answer only the first
            has a covariance. In any other answer every candidate that excludes the others has one.
        spread: mean and covariance over all places where the camera may be; None for a LOCALIZED answer.
        reasons: what may be wrong with the query or the map, the likeliest first. Empty for a LOCALIZED answer, and if all
            confidence features lie in the range of the calibration data.
        extrapolated: confidence features outside the range of the calibration data: name, and signed distance from its mean in
            standard deviations, the farthest first. The confidence is an extrapolation then.
        threshold: the threshold that decided the status, with its false-accept rate; None if ``confidence`` is None.
        frames: number of image pairs in the query.
        evidence: confidence features, in the order of ``service.confidence.features.FEATURES``; None without registration.
        T_map_vehicle_guess: best guess of the vehicle pose; None if the query does not give the camera's pose on the vehicle.
        neighbours: distinct places, as many as the query requested. First those nearest to the registered poses, then the most
            similar.
        hypotheses: all clusters of the most similar views, the heaviest first; a prior, if given, counts in this order.
        measured_share: share of the view grid's cells with a measurement, 0 to 1.
        height_m: height of the reference camera above the ground, metres.
        height_origin: where this height comes from: the query ("given"), the depth image ("estimated"), or neither ("assumed").
        timings: duration of each stage.
        belief: belief of a track after this frame; None without a track, and if ``confidence`` is None.
        epoch: number of disruptions of the track; 0 without a track.
        rig_correction: name of the correction for a rig that the confidence has; None without one.
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
    extrapolated: tuple[tuple[str, float], ...]
    threshold: Threshold | None
    frames: int
    evidence: Float64[NDArray[np.float64], " F"] | None
    T_map_vehicle_guess: Transform | None
    neighbours: tuple[Neighbour, ...]
    hypotheses: tuple[Hypothesis, ...]
    measured_share: float
    height_m: float
    height_origin: HeightOrigin
    timings: Timings
    belief: Belief | None = None
    epoch: int = 0
    rig_correction: str | None = None


def require_finite(answer: Answer) -> None:
    """Refuse an answer that contains a number that is not finite.

    A NaN would reach the controller of a robot, or turn the answer into OUT_OF_MAP without an error.
    The check walks all fields recursively, so it also covers fields that are added later.

    Args:
        answer: the answer to check.

    Raises:
        NotFiniteError: a number is not finite. The error names the path of the first one, for example ``candidates.0.support``.
    """
    numbers: list[float] = []
    _gather(answer, numbers)
    if np.isfinite(numbers).all():
        return
    for path, value in _paths(answer, ""):  # the sum of an array may overflow although its numbers are finite
        if not np.isfinite(value).all():
            raise NotFiniteError(path)


def _gather(value: object, numbers: list[float]) -> None:
    """Append every number in a value. An array adds its sum, because one number that is not finite makes the sum not finite."""
    if isinstance(value, float):
        numbers.append(value)
    elif isinstance(value, np.ndarray):
        numbers.append(float(value.sum()))
    elif isinstance(value, tuple):
        for each in value:
            _gather(each, numbers)
    elif isinstance(value, Mapping):
        for each in value.values():
            _gather(each, numbers)
    else:
        for name in getattr(value, "__dataclass_fields__", ()):
            _gather(getattr(value, name), numbers)


def _paths(value: object, path: str) -> Iterator[tuple[str, float | NDArray[np.generic]]]:
    """Yield every number and array in a value, with its path."""
    if isinstance(value, (float, np.ndarray)):
        yield path, value
    elif isinstance(value, tuple):
        for number, each in enumerate(value):
            yield from _paths(each, f"{path}.{number}")
    elif isinstance(value, Mapping):
        for name, each in value.items():
            yield from _paths(each, f"{path}.{name}")
    else:
        for name in getattr(value, "__dataclass_fields__", ()):
            yield from _paths(getattr(value, name), f"{path}.{name}".removeprefix("."))
