"""Compare registered poses with the map along the rays of the depth image, and leave out what a moved vehicle explains.

A parked vehicle may have left since the survey, or a new one may stand there. Then much of the image differs from the map at a right pose.
The height tells such a difference from a wrong pose: a vehicle or a person is at most ``MOVABLE_M`` high. A house, a tree or a pole is
higher, and it is still there. Rays also resolve more than the image of ``structure``: depth edges of poles and corners stay sharp.
Right and wrong answers have the same numbers in simulated cities and on KITTI drive 0005 (decision 0201).
"""

from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy.typing import NDArray

from service.registration.points import GROUND_M, MOVABLE_M
from service.registration.rays import RaySettings, adjust
from service.registration.register import Registered
from service.registration.visibility import Raycasters, SurfelRaycaster
from service.scoring.comparison import Comparison, FrameCells, comparison_of
from service.scoring.measured import MeasuredFrame
from service.scoring.photometry import PhotometrySettings
from service.scoring.ray_image import RayImage, inverse_of, ray_image_of
from service.scoring.scorer import Scores
from service.scoring.structure import HALF_PIXELS, INLIER_SIGMAS, MOST_SIGMAS, near_edges
from service.scoring.verifier import PoseVerifier

#: A depth edge between two horizontal neighbours: the farther one is farther by more than EDGE_M plus EDGE_SHARE of the nearer depth, m.
EDGE_M, EDGE_SHARE = 1.0, 0.05


@dataclass(frozen=True, slots=True)
class RayEvidence:
    """Numbers of a pose that was adjusted along the rays; means over the frames.

    The confidence uses those of the final pose. The support of a candidate contains two of them, with the weights of ``RayWeights``.

    Few pixels or edges make a weak share: ``HALF_PIXELS`` of them count half (``static_inliers`` then tends to 0.5, the others to 0).

    Attributes:
        static_inliers: share of the pixels above the ground that lie on the map's surfaces, without what a moved vehicle explains.
        upper_through: share of the pixels on surfaces of the map above ``MOVABLE_M`` that lie behind these surfaces.
        occlusion_edges: share of the depth edges of image and map that the other one has too, without what a moved vehicle explains.
        upper_occlusion_edges: the same for edges whose nearer side is higher than ``MOVABLE_M``.
    """

    static_inliers: float
    upper_through: float
    occlusion_edges: float
    upper_occlusion_edges: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RayWeights:
    """Weights of the comparison along the rays in the support, nats per unit.

    Fitted by a conditional logit over the candidates of queries in training cities (decisions 0202 and 0204).

    Attributes:
        static_inliers: weight of the inliers without what a moved vehicle explains.
        occlusion_edges: weight of the shared depth edges of more than a metre.
        verified: weight of the log odds of the verifier.
    """

    static_inliers: float = 12.0
    occlusion_edges: float = 13.0
    verified: float = 0.6


def mean_evidence(frames: Sequence[RayEvidence]) -> RayEvidence:
    """Compute the numbers of a pose from those of its frames.

    Args:
        frames: numbers of each frame, at least one.
    """
    return RayEvidence(*np.mean([astuple(each) for each in frames], axis=0).tolist())


def ray_evidence_of(image: RayImage) -> RayEvidence:
    """Compute the numbers of one image.

    Args:
        image: depth of the query and of the map along the same rays.
    """
    known, hit = image.z_m > 0, image.mapped_m > 0
    both = known & hit
    height_m, mapped_height_m = (z * image.climb + image.camera_m for z in (image.z_m, image.mapped_m))
    sigmas = np.where(both, (inverse_of(image.z_m) - inverse_of(image.mapped_m)) / image.sigma, 0.0)
    through, front = sigmas < -MOST_SIGMAS, sigmas > MOST_SIGMAS
    raised, upper, mapped_upper = height_m > GROUND_M, height_m > MOVABLE_M, mapped_height_m >= MOVABLE_M
    left = through & (mapped_height_m > GROUND_M) & ~mapped_upper
    moved = left | front & raised & ~upper
    static = both & raised & ~moved
    inliers = float((static & (np.abs(sigmas) < INLIER_SIGMAS)).sum())
    kept = ~(moved[:, 1:] | moved[:, :-1])
    edges, edges_of_map = (
        _Edges.of(z, height) for z, height in ((image.z_m, height_m), (image.mapped_m, mapped_height_m))
    )
    return RayEvidence(
        static_inliers=(inliers + 0.5 * HALF_PIXELS) / (float(static.sum()) + HALF_PIXELS),
        upper_through=float((through & mapped_upper).sum()) / (float((both & mapped_upper).sum()) + HALF_PIXELS),
        occlusion_edges=_shared(edges.rising, edges_of_map.rising, edges.known & edges_of_map.known & kept),
        upper_occlusion_edges=_shared(
            edges.rising & edges.upper,
            edges_of_map.rising & edges_of_map.upper,
            edges.known & edges_of_map.known & kept,
        ),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Edges:
    """Depth edges between horizontal neighbours.

    Attributes:
        known: pairs of pixels that both have a depth (H, W - 1).
        rising: pairs whose right pixel is farther, and pairs whose left pixel is farther (2, H, W - 1).
        upper: pairs whose nearer pixel is higher than ``MOVABLE_M`` (H, W - 1).
    """

    known: Bool[NDArray[np.bool_], "H pairs"]
    rising: Bool[NDArray[np.bool_], "2 H pairs"]
    upper: Bool[NDArray[np.bool_], "H pairs"]

    @classmethod
    def of(cls, z_m: Float64[NDArray[np.float64], "H W"], height_m: Float64[NDArray[np.float64], "H W"]) -> "_Edges":
        """Find the edges of a depth image.

        Args:
            z_m: depth, m; 0 where unknown.
            height_m: height above the ground, m.
        """
        left, right = z_m[:, :-1], z_m[:, 1:]
        known = (left > 0) & (right > 0)
        step = 1 + EDGE_SHARE
        rising = np.stack([right > step * left + EDGE_M, left > step * right + EDGE_M]) & known
        return cls(known, rising, np.where(left < right, height_m[:, :-1], height_m[:, 1:]) >= MOVABLE_M)


def _shared(
    one: Bool[NDArray[np.bool_], "2 H pairs"],
    other: Bool[NDArray[np.bool_], "2 H pairs"],
    compared: Bool[NDArray[np.bool_], "H pairs"],
) -> float:
    """Return the share of the compared edges of two images that the other image has too, within a pixel and in the same direction.

    The edge in the other image may lie beside a hole or a moved vehicle, where nothing is compared.
    """
    edges, others = one & compared, other & compared
    shared = (edges & near_edges(other)).sum() + (others & near_edges(one)).sum()
    return float(shared) / (float(edges.sum() + others.sum()) + HALF_PIXELS)


@dataclass(frozen=True, slots=True, eq=False)
class RayPose:
    """A registered pose after its adjustment along the rays.

    Attributes:
        pose: the adjusted pose, or the registered one if too few rays meet the map.
        scatter: scatter of the patches' gradients there, as ``adjust`` returns it; None if the pose was not adjusted.
        evidence: comparison with the map along the rays of this pose.
        verified: mean log odds of the frames, by the verifier, that the pose is right.
    """

    pose: Registered
    scatter: Float64[NDArray[np.float64], "8 8"] | None
    evidence: RayEvidence
    verified: float


class RayScorer:
    """Scorer by the comparison along the rays, after an adjustment of each pose. Its score is in nats.

    It keeps the adjusted poses, because the best candidate needs its own again.

    Args:
        raycasters: ray casting on the map, for any position.
        measured: frames of the query, the reference first.
        settings: settings of the ray adjustment.
        weights: weights of the numbers.
        photometry: settings of the brightness, for the verifier.
        verifier: the verifier.
    """

    name = "rays"

    def __init__(
        self,
        raycasters: Raycasters,
        measured: tuple[MeasuredFrame, ...],
        settings: RaySettings,
        weights: RayWeights,
        photometry: PhotometrySettings,
        verifier: PoseVerifier,
    ) -> None:
        self._raycasters, self._settings, self._weights = raycasters, settings, weights
        self._photometry, self._verifier = photometry, verifier
        self._pictures = [each.picture for each in measured]
        self._measured = tuple(each for each in measured if len(each.points))
        self._cells = tuple(FrameCells.of(each, photometry) for each in self._measured)
        self._known: list[tuple[Registered, RayPose]] = []

    @property
    def compared(self) -> tuple[RayPose, ...]:
        """All poses that were compared so far."""
        return tuple(found for _, found in self._known)

    def at(self, pose: Registered) -> RayPose:
        """Adjust a pose along the rays, and compare it with the map there. A pose that was adjusted before is not adjusted again.

        Args:
            pose: registered pose of the reference's level frame.
        """
        for known, found in self._known:
            if known is pose:
                return found
        raycaster = self._raycasters.at(pose.camera_m)
        adjusted, scatter = adjust(raycaster, self._pictures, pose, self._settings) or (pose, None)
        evidence, odds = [], []
        for image, comparison in self._compared_at(raycaster, adjusted):
            evidence.append(ray_evidence_of(image))
            odds.append(self._verifier.log_odds([comparison]))
        found = RayPose(adjusted, scatter, mean_evidence(evidence), float(np.concatenate(odds).mean()))
        self._known.append((pose, found))
        return found

    def comparisons(self, pose: Registered) -> tuple[Comparison, ...]:
        """Compare a pose with the map as it is, and return what the verifier sees of each frame.

        The training of the verifier needs these arrays, and no answer does. So they are computed again instead of kept.

        Args:
            pose: pose of the reference's level frame, for example an adjusted one.
        """
        raycaster = self._raycasters.at(pose.camera_m)
        return tuple(comparison for _, comparison in self._compared_at(raycaster, pose))

    def _compared_at(self, raycaster: SurfelRaycaster, pose: Registered) -> Iterator[tuple[RayImage, Comparison]]:
        """Yield the depth along the rays of each frame, and the comparison for the verifier. Only one frame at a time is in memory."""
        surfels = raycaster.cloud if self._raycasters.have_brightness else None
        for cells, each in zip(self._cells, self._measured, strict=True):
            image = ray_image_of(raycaster, each, each.pose(pose))
            yield image, comparison_of(cells, image, surfels, self._photometry)

    def score(self, poses: tuple[Registered, ...]) -> Scores:
        """Return the score of each pose: inliers, shared edges and the verifier with their weights. It has no details.

        Args:
            poses: registered poses of the reference's level frame.
        """
        weights = self._weights
        return Scores(
            np.array(
                [
                    weights.static_inliers * found.evidence.static_inliers
                    + weights.occlusion_edges * found.evidence.occlusion_edges
                    + weights.verified * found.verified
                    for found in map(self.at, poses)
                ],
                np.float64,
            )
        )
