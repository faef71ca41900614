"""Which candidates exclude each other, and how the support is shared among them."""

import math

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.localization.judge import Candidate

#: A rival stands further away than this, or looks another way: the next frame of the same street is none.
RIVAL_M, RIVAL_RAD = 3.0, float(np.deg2rad(30.0))


def is_rival(one: Candidate, other: Candidate) -> bool:
    """Whether two candidates are answers that exclude each other."""
    apart = math.dist(one.T_map_camera[:3, 3], other.T_map_camera[:3, 3])
    trace = (one.T_map_camera[:3, :3] * other.T_map_camera[:3, :3]).sum()  # of the rotation between both
    return bool(apart > RIVAL_M or trace < 1 + 2 * np.cos(RIVAL_RAD))


def distinct_candidates(candidates: tuple[Candidate, ...]) -> tuple[Candidate, ...]:
    """Those that exclude each other, the best supported of each place."""
    kept: list[Candidate] = []
    for candidate in candidates:
        if all(is_rival(other, candidate) for other in kept):
            kept.append(candidate)
    return tuple(kept)


def behind(distinct: tuple[Candidate, ...], frames: int) -> Float64[NDArray[np.float64], " C"]:
    """By how much each candidate's support is less than the best one's, nats.

    What several frames agree on is surer than one frame's: the noise of their mean falls with the root of their number.

    Args:
        distinct: candidates that exclude each other, the best supported first.
        frames: that were asked together.
    """
    support = np.array([candidate.support for candidate in distinct])
    less: Float64[NDArray[np.float64], " C"] = np.sqrt(frames) * (support[0] - support)
    return less


def log_shares(less: Float64[NDArray[np.float64], " C"]) -> Float64[NDArray[np.float64], " C"]:
    """Logarithm of each one's share, were support the log odds of a place: a half for two that are alike, a sixth for six.

    Args:
        less: as in ``behind``.
    """
    shares: Float64[NDArray[np.float64], " C"] = -less - np.log(np.exp(-less).sum())
    return shares


def shares_of(distinct: tuple[Candidate, ...], frames: int) -> Float64[NDArray[np.float64], " C"]:
    """Each one's share of the support of all, 0 to 1.

    Args:
        distinct: candidates that exclude each other, the best supported first; may be empty.
        frames: that were asked together.
    """
    if not distinct:
        return np.zeros(0)
    shares: Float64[NDArray[np.float64], " C"] = np.exp(log_shares(behind(distinct, frames)))
    return shares
