"""Build the answer from the results of the stages."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.confidence.decision import Decision, calibration_for, outcome_of
from service.confidence.spread import Extent
from service.geometry.rigid import Transform, inverse, transform_from
from service.localization.answer import Answer, Timings, require_finite
from service.maps.map import Map
from service.retrieval.hypotheses import Hypothesis
from service.retrieval.knn import Neighbour
from service.retrieval.retrieve import EncodedFrame, Retrieved
from service.scoring.candidates import Candidate, Refined
from service.timing import durations_ms, stage

#: Largest distance at which a registered pose verifies a place.
VERIFIED_M = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class QueryResult:
    """Results of the stages of a query, from which its answer is built.

    Attributes:
        retrieved: places, clusters and street vote of the reference.
        refined: registered candidates; None if nothing was registered.
        evidence: confidence features; None without ``refined``.
        decision: status and confidence; None if the query requested no registration, or the map has no cloud or no calibration.
    """

    retrieved: Retrieved
    refined: Refined | None
    evidence: Float64[NDArray[np.float64], " F"] | None
    decision: Decision | None


def compose(bundle: Map, frames: tuple[EncodedFrame, ...], found: QueryResult, extent: Extent) -> Answer:
    """Build an answer from the results of all stages.

    Args:
        bundle: the map.
        frames: image pairs, the reference first.
        found: places, registered candidates, confidence features and decision.
        extent: extent of the map.

    Raises:
        NotFiniteError: a number of the answer is not finite, because of a defect of this program or of the map.
    """
    retrieved, refined, evidence, decision = found.retrieved, found.refined, found.evidence, found.decision
    with stage("register"):  # reasons and spread count as registration
        queries = (frame.query for frame in frames)
        calibration = None if decision is None else calibration_for(bundle.calibration, queries)
        outcome = outcome_of(
            calibration, frames[0].query, refined, evidence, decision, frames=len(frames), extent=extent
        )
    query, views, heaviest = frames[0].query, frames[0].views, retrieved.hypotheses[0]
    T_map_camera = _pose_of(bundle, heaviest, frames[0]) if refined is None else refined.best.T_map_camera
    count = max(query.neighbours, query.ranked)
    answer = Answer(
        status=outcome.status,
        confidence=outcome.confidence,
        street=_street_of(bundle, T_map_camera, heaviest, registered=refined is not None),
        vote=retrieved.vote,
        T_map_camera_guess=T_map_camera,
        covariance=None if refined is None else refined.covariance,
        candidates=outcome.candidates,
        spread=outcome.spread,
        reasons=outcome.reasons,
        extrapolated=outcome.extrapolated,
        threshold=outcome.threshold,
        rig_correction=outcome.rig_correction,
        frames=len(frames),
        evidence=evidence,
        T_map_vehicle_guess=None if query.T_vehicle_camera is None else T_map_camera @ inverse(query.T_vehicle_camera),
        neighbours=reranked(retrieved.neighbours, outcome.candidates or ())[:count],
        hypotheses=retrieved.hypotheses,
        measured_share=views.measured_share,
        height_m=views.height_m,
        height_origin=views.height_origin,
        timings=_timings(registered=refined is not None),
    )
    require_finite(answer)
    return answer


def _timings(*, registered: bool) -> Timings:
    ms = durations_ms()
    return Timings(
        decode_ms=ms["decode"],
        fuse_ms=ms["fuse"],
        encode_ms=ms["encode"],
        search_ms=ms["search"],
        register_ms=ms["register"] if registered else 0.0,
        total_ms=sum(ms.values()),
    )


def _street_of(bundle: Map, T_map_camera: Transform, heaviest: Hypothesis, *, registered: bool) -> int:
    """Return the street under a registered position, else the street of the heaviest cluster; -1 for none.

    A cluster never spans two streets. The vote of the nearest places crosses street borders more often (decision 0084).
    """
    if bundle.streets is None:
        return -1
    return bundle.streets.index_at(T_map_camera[:2, 3]) if registered else heaviest.street


def _pose_of(bundle: Map, hypothesis: Hypothesis, frame: EncodedFrame) -> Transform:
    """Return T_map_camera at a hypothesis. The position of a hypothesis is at LiDAR height, so it is moved to camera height."""
    above_lidar_m = frame.views.height_m - bundle.manifest.lidar_height_m
    position_m = hypothesis.position_m + np.array([0.0, 0.0, above_lidar_m])
    return frame.pose_of_camera(transform_from(hypothesis.R_map_level, position_m))


def reranked(neighbours: tuple[Neighbour, ...], candidates: tuple[Candidate, ...]) -> tuple[Neighbour, ...]:
    """Sort places: first the place nearest to each registered pose, then the others by similarity.

    Place recognition methods verify the nearest neighbours of a global descriptor by registration before they report recall.
    Sources: Hausler et al., Patch-NetVLAD, CVPR 2021; Vidanapathirana et al., Spectral Geometric Verification, RA-L 2023
    (decision 0128).

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
