"""Geometric verification of the retrieved places: those where the cloud fits come first.

Re-ranking the nearest neighbours of a global descriptor by registration is how place recognition reports its final recall (Hausler et
al., Patch-NetVLAD, CVPR 2021; Vidanapathirana et al., Spectral Geometric Verification, RA-L 2023).
"""

import numpy as np

from service.localization.judge import Candidate
from service.localization.search import Neighbour

#: A place further than this from a registered pose is not verified by it.
VERIFIED_M = 5.0


def reranked(neighbours: tuple[Neighbour, ...], candidates: tuple[Candidate, ...]) -> tuple[Neighbour, ...]:
    """The place nearest to each registered pose first, then the others by similarity.

    Args:
        neighbours: distinct places, the most similar first.
        candidates: registered poses, the best supported first.
    """
    rest, verified = list(neighbours), list[Neighbour]()
    for candidate in candidates:
        if not rest:
            break
        away = [float(np.hypot(*(place.position_m[:2] - candidate.T_map_camera[:2, 3]))) for place in rest]
        nearest = int(np.argmin(away))
        if away[nearest] <= VERIFIED_M:
            verified.append(rest.pop(nearest))
    return (*verified, *rest)
