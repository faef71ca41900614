"""What an answer's confidence rests on, as one row of numbers with names."""

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.imaging.shape import shape_of
from service.imaging.view_grid import ViewGrid
from service.localization.frames import Frame
from service.localization.hypotheses import Hypothesis
from service.localization.refine import Refined
from service.localization.rivals import behind, distinct_candidates, log_shares
from service.localization.search import Neighbour
from service.maps.calibration import FEATURES

#: Another place, for the margin of similarity; votes within VOTE_M of the answer count for it.
OTHER_PLACE_M, VOTE_M, VOTERS = 10.0, 5.0, 20
_NEAREST = 5  # neighbours whose poses are to agree
_MOST_MARGIN = 12.0  # nats; where there is no rival at all, too
_MOST_PLACE_M = 10.0


def evidence_of(
    frames: tuple[Frame, ...],
    refined: Refined,
    neighbours: tuple[Neighbour, ...],
    hypotheses: tuple[Hypothesis, ...],
    places_m: Float64[NDArray[np.float64], "P 2"],
    grid: ViewGrid,
) -> Float64[NDArray[np.float64], " F"]:
    """One number for each of ``service.maps.calibration.FEATURES``.

    Args:
        frames: the reference first.
        refined: its candidates.
        neighbours: distinct places, the most similar first; those of the reference.
        hypotheses: clusters of the reference's most similar views.
        places_m: x, y of all places of the map.
        grid: the map's view grid.
    """
    best, reference = refined.best, frames[0]
    ahead = int(np.argmin(np.abs(reference.views.turns_rad)))
    shape = shape_of(reference.views.planes[ahead, 0], grid)
    xy = best.T_map_camera[:2, 3]
    away = np.array([np.hypot(*(place.position_m[:2] - xy)) for place in neighbours])
    similarities = np.array([place.similarity for place in neighbours])
    elsewhere = similarities[away > OTHER_PLACE_M]
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(refined.covariance[:2, :2])[-1]))
    # Of the places that are there: a sparse survey has fewer of them, but no less to say.
    there = float(np.clip((np.hypot(*(places_m - xy).T) < VOTE_M).sum(), 1, VOTERS))
    several = float(np.sqrt(len(frames)))
    weights = np.array([hypothesis.weight for hypothesis in hypotheses])
    less = behind(distinct_candidates(refined.candidates), len(frames))
    found = {
        "margin": float(less[1:].min(initial=_MOST_MARGIN)),
        "log_share": float(log_shares(less)[0]),
        "inliers": best.registered.inliers,
        "similarity": best.similarity,
        "similarity_margin": several * (best.similarity - (float(elsewhere.max()) if len(elsewhere) else 0.5)),
        "likelihood": best.agreement.likelihood,
        "through": best.agreement.through,
        "front": best.agreement.front,
        "unmapped": best.agreement.unmapped,
        "log_sigma": float(np.log(sigma_m)),
        "scale": abs(float(np.log(best.registered.scale))) / 0.01,
        "residual": float(np.log(refined.disagreement)),
        "votes": float((away[:VOTERS] < VOTE_M).sum()) / there,
        "pose_spread": _spread(neighbours[:_NEAREST]),
        "entropy": float(-(weights * np.log(np.maximum(weights, 1e-12))).sum()),
        "log_noise": float(np.log(np.median([frame.noise for frame in frames]))),
        "points": refined.points / 3000.0 / len(frames),
        "measured": reference.views.measured_share,
        "place_m": min(best.place_m, _MOST_PLACE_M),
        "facings": shape.facings,
        "far": shape.far,
        "edges": shape.edges,
    }
    return np.array([found[name] for name in FEATURES])


def _spread(neighbours: tuple[Neighbour, ...]) -> float:
    """How far the most similar places stand from their middle: logarithm of the root mean square (m), of 0.1 m at least."""
    xy = np.array([place.position_m[:2] for place in neighbours])
    return float(np.log(np.sqrt(xy.var(axis=0).sum()) + 0.1))
