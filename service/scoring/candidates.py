"""Candidates: registered poses with their scores; which of them exclude each other, and each one's share of the support."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import Transform
from service.registration.register import Registered
from service.scoring.confirmation import Confirmation
from service.scoring.ray_evidence import RayEvidence, RayPose

#: Two candidates are rivals beyond this distance or this angle. Adjacent positions on one street are not rivals.
RIVAL_M, RIVAL_RAD = 3.0, float(np.deg2rad(30.0))
#: Two candidates are at the same place up to this distance and this angle. The ray adjustment moves both to the same pose.
SAME_M, SAME_RAD = 0.7, 0.1
_LEAST_MAPPED = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A registered pose and its scores.

    Attributes:
        T_map_camera: pose of the reference camera.
        registered: result of the solver. For the best candidate the ray adjustment then moves the pose by centimetres. Its
            scores below come from before this adjustment.
        scores: scores of all scorers and their details, by name. ``structure``, its details,
            ``brightness`` and ``rays`` are missing if they were not computed. The best candidate always has its structure.
        support: weighted sum of the scores, in nats; only differences between candidates have a meaning.
        covariance: of ``T_map_camera``, if the candidate is right: translation (m), then rotation (rad), in map axes, about the
            camera. None if not computed.
    """

    T_map_camera: Transform
    registered: Registered
    scores: Mapping[str, float]
    support: float
    covariance: Float64[NDArray[np.float64], "6 6"] | None = None

    @property
    def mapped_share(self) -> float:
        """Share of the points where the map shows a surface from this pose, at least ``_LEAST_MAPPED``."""
        return max(1.0 - self.scores["unmapped"], _LEAST_MAPPED)

    @property
    def mapped_inliers(self) -> float:
        """Share of the points that lie on the map, relative to the share where the map shows a surface."""
        return self.registered.inliers / self.mapped_share


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Result of registration.

    Attributes:
        candidates: registered poses, the best supported first.
        covariance: of the best candidate: translation (m), then rotation (rad), in map axes, about the camera.
        registration_covariance: the part of it without the errors of the survey and of a stereo pair's rectification.
        points: number of registered points, over all frames.
        variance_inflation: how much the image patches disagree about the best pose: ratio of variances to those of their noise.
        confirmation: comparison of the best pose with poses next to it.
        ray_evidence: comparison of the depth with the map along the rays of the best pose.
        verified: log odds of the verifier that the best pose is right.
        compared: all poses that were compared along the rays. The training of the verifier compares them again.
        covariance_at: function that computes the covariance of a candidate without ray adjustment: of every one but the best.
    """

    candidates: tuple[Candidate, ...]
    covariance: Float64[NDArray[np.float64], "6 6"]
    registration_covariance: Float64[NDArray[np.float64], "6 6"]
    points: int
    variance_inflation: float
    confirmation: Confirmation
    ray_evidence: RayEvidence
    verified: float
    compared: tuple[RayPose, ...]
    covariance_at: Callable[[Candidate], Float64[NDArray[np.float64], "6 6"]]

    @property
    def best(self) -> Candidate:
        """The best supported candidate."""
        return self.candidates[0]

    def with_best(self, T_map_camera: Transform) -> "Refined":
        """Return the result with the candidate nearest to a pose as the best one.

        Args:
            T_map_camera: pose of one of the candidates that exclude each other.
        """
        found = self.candidates
        nearest = min(_distinct(found), key=lambda k: math.dist(found[k].T_map_camera[:3, 3], T_map_camera[:3, 3]))
        first = found[nearest]
        covariance = self.covariance_at(first) if first.covariance is None else first.covariance
        others = (candidate for k, candidate in enumerate(found) if k != nearest)
        return replace(self, candidates=(replace(first, covariance=covariance), *others), covariance=covariance)

    def with_covariances(self) -> tuple[Candidate, ...]:
        """Return all candidates, with a covariance for each of those that exclude each other.

        A covariance takes about 0.5 ms. So only answers that are not LOCALIZED need this method.
        """
        found = list(self.candidates)
        for k in _distinct(self.candidates):
            if found[k].covariance is None:
                found[k] = replace(found[k], covariance=self.covariance_at(found[k]))
        return tuple(found)


def is_rival(one: Candidate, other: Candidate) -> bool:
    """Return whether two candidates exclude each other by position or rotation.

    Args:
        one: candidate.
        other: another candidate.
    """
    return _is_apart(one, other, RIVAL_M, RIVAL_RAD)


def is_same_place(one: Candidate, other: Candidate) -> bool:
    """Return whether two candidates are so near that the ray adjustment moves them to the same pose.

    Args:
        one: candidate.
        other: another candidate.
    """
    return not _is_apart(one, other, SAME_M, SAME_RAD)


def _is_apart(one: Candidate, other: Candidate, most_m: float, most_rad: float) -> bool:
    """Return whether two candidates differ by more than a distance or an angle."""
    apart = math.dist(one.T_map_camera[:3, 3], other.T_map_camera[:3, 3])
    # The trace of the relative rotation is 1 + 2 cos(angle).
    trace = (one.T_map_camera[:3, :3] * other.T_map_camera[:3, :3]).sum()
    return bool(apart > most_m or trace < 1 + 2 * np.cos(most_rad))


def distinct_candidates(candidates: tuple[Candidate, ...]) -> tuple[Candidate, ...]:
    """Select candidates that exclude each other, the best supported one of each place.

    Args:
        candidates: registered poses, the best supported first.
    """
    return tuple(candidates[k] for k in _distinct(candidates))


def _distinct(candidates: tuple[Candidate, ...]) -> list[int]:
    """Return the indices of ``distinct_candidates``."""
    kept: list[int] = []
    for k, candidate in enumerate(candidates):
        if all(is_rival(candidates[other], candidate) for other in kept):
            kept.append(k)
    return kept


def support_gaps(distinct: tuple[Candidate, ...], frames: int) -> Float64[NDArray[np.float64], " C"]:
    """Compute the support gap of each candidate to the best one, nats.

    The gap grows with the square root of the number of frames, because the noise of their mean support falls with it.

    Args:
        distinct: candidates that exclude each other, the best supported first.
        frames: number of image pairs in the query.
    """
    support = np.array([candidate.support for candidate in distinct])
    gaps: Float64[NDArray[np.float64], " C"] = np.sqrt(frames) * (support[0] - support)
    return gaps


def log_shares(gaps: Float64[NDArray[np.float64], " C"]) -> Float64[NDArray[np.float64], " C"]:
    """Compute the log of each candidate's share of the support: a log softmax.

    Two candidates with equal support have a share of 1/2 each, six have 1/6 each.

    Args:
        gaps: support gaps, as returned by ``support_gaps``, nats.
    """
    shares: Float64[NDArray[np.float64], " C"] = -gaps - np.log(np.exp(-gaps).sum())
    return shares


def shares_of(distinct: tuple[Candidate, ...], frames: int) -> Float64[NDArray[np.float64], " C"]:
    """Compute each candidate's share of the support, 0 to 1; the shares sum to 1.

    Args:
        distinct: candidates that exclude each other, the best supported first; may be empty.
        frames: number of image pairs in the query.
    """
    if not distinct:
        return np.zeros(0)
    shares: Float64[NDArray[np.float64], " C"] = np.exp(log_shares(support_gaps(distinct, frames)))
    return shares
