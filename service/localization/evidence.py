"""Confidence features of an answer: the inputs of the calibrated confidence, one number each."""

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

#: A neighbour further than OTHER_PLACE_M from the answer is another place (feature ``similarity_margin``).
#: Of the first VOTERS neighbours, those within VOTE_M of the answer vote for it (feature ``votes``).
OTHER_PLACE_M, VOTE_M, VOTERS = 10.0, 5.0, 20
_NEAREST = 5  # number of the most similar neighbours in ``pose_spread``
_MOST_MARGIN = 12.0  # nats; largest margin, also used if there is no rival
_MOST_PLACE_M = 10.0


def evidence_of(
    frames: tuple[Frame, ...],
    refined: Refined,
    neighbours: tuple[Neighbour, ...],
    hypotheses: tuple[Hypothesis, ...],
    places_m: Float64[NDArray[np.float64], "P 2"],
    grid: ViewGrid,
) -> Float64[NDArray[np.float64], " F"]:
    """Compute the confidence features, in the order of ``service.maps.calibration.FEATURES``.

    Args:
        frames: image pairs, the reference first.
        refined: registered candidates, the best supported first.
        neighbours: distinct places retrieved for the reference, the most similar first.
        hypotheses: clusters of the most similar views of the reference.
        places_m: x and y of all places, map frame, metres.
        grid: view grid of the map.
    """
    best, reference = refined.best, frames[0]
    ahead = int(np.argmin(np.abs(reference.views.turns_rad)))
    shape = shape_of(reference.views.planes[ahead, 0], grid)
    xy = best.T_map_camera[:2, 3]
    away = np.array([np.hypot(*(place.position_m[:2] - xy)) for place in neighbours])
    similarities = np.array([place.similarity for place in neighbours])
    elsewhere = similarities[away > OTHER_PLACE_M]
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(refined.covariance[:2, :2])[-1]))
    # Normalise by the places that exist near the answer. Otherwise a sparse survey would get fewer votes (decision 0033).
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
    """Return the log of the sum of 0.1 m and the RMS distance (m) of the places from their mean."""
    xy = np.array([place.position_m[:2] for place in neighbours])
    return float(np.log(np.sqrt(xy.var(axis=0).sum()) + 0.1))
