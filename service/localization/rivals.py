"""Find candidates that exclude each other (rivals), and each one's share of the support."""

import math

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.localization.scoring import Candidate

#: Two candidates are rivals beyond this distance or this angle. Adjacent positions on one street are not rivals.
RIVAL_M, RIVAL_RAD = 3.0, float(np.deg2rad(30.0))


def is_rival(one: Candidate, other: Candidate) -> bool:
    """Return whether two candidates exclude each other by position or rotation.

    Args:
        one: candidate.
        other: another candidate.
    """
    apart = math.dist(one.T_map_camera[:3, 3], other.T_map_camera[:3, 3])
    # The trace of the relative rotation is 1 + 2 cos(angle).
    trace = (one.T_map_camera[:3, :3] * other.T_map_camera[:3, :3]).sum()
    return bool(apart > RIVAL_M or trace < 1 + 2 * np.cos(RIVAL_RAD))


def distinct_candidates(candidates: tuple[Candidate, ...]) -> tuple[Candidate, ...]:
    """Select candidates that exclude each other, the best supported one of each place.

    Args:
        candidates: registered poses, the best supported first.
    """
    kept: list[Candidate] = []
    for candidate in candidates:
        if all(is_rival(other, candidate) for other in kept):
            kept.append(candidate)
    return tuple(kept)


def behind(distinct: tuple[Candidate, ...], frames: int) -> Float64[NDArray[np.float64], " C"]:
    """Compute the support gap of each candidate to the best one, nats.

    The gap grows with the square root of the number of frames, because the noise of their mean support falls with it.

    Args:
        distinct: candidates that exclude each other, the best supported first.
        frames: number of image pairs in the query.
    """
    support = np.array([candidate.support for candidate in distinct])
    less: Float64[NDArray[np.float64], " C"] = np.sqrt(frames) * (support[0] - support)
    return less


def log_shares(less: Float64[NDArray[np.float64], " C"]) -> Float64[NDArray[np.float64], " C"]:
    """Compute the log of each candidate's share of the support: a log softmax.

    Two candidates with equal support have a share of 1/2 each, six have 1/6 each.

    Args:
        less: support gaps, as returned by ``behind``, nats.
    """
    shares: Float64[NDArray[np.float64], " C"] = -less - np.log(np.exp(-less).sum())
    return shares


def shares_of(distinct: tuple[Candidate, ...], frames: int) -> Float64[NDArray[np.float64], " C"]:
    """Compute each candidate's share of the support, 0 to 1; the shares sum to 1.

    Args:
        distinct: candidates that exclude each other, the best supported first; may be empty.
        frames: number of image pairs in the query.
    """
    if not distinct:
        return np.zeros(0)
    shares: Float64[NDArray[np.float64], " C"] = np.exp(log_shares(behind(distinct, frames)))
    return shares
