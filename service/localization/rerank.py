"""Geometric verification of the retrieved places: places at registered poses come first.

Place recognition methods re-rank the nearest neighbours of a global descriptor by registration before they report recall. Sources:
Hausler et al., Patch-NetVLAD, CVPR 2021; Vidanapathirana et al., Spectral Geometric Verification, RA-L 2023. See decision 0128.
"""

import numpy as np

from service.localization.scoring import Candidate
from service.localization.search import Neighbour

#: Largest distance at which a registered pose verifies a place.
VERIFIED_M = 5.0


def reranked(neighbours: tuple[Neighbour, ...], candidates: tuple[Candidate, ...]) -> tuple[Neighbour, ...]:
    """Sort places: first the place nearest to each registered pose, then the others by similarity.

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
