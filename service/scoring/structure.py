"""Score poses by depth structure: depth edges, surfaces above traffic, and how well a shifted image of the map would fit.

The share of inliers does not identify a street: ground and a wall on each side fit at many places. The depth edges of poles, trunks,
corners and eaves fit at the right place only. So does the fit itself: at a right pose it becomes worse if the map's image shifts by a few
degrees. Right and wrong answers have about the same numbers in simulated cities and on KITTI drive 0005 (decision 0159). Between rigs the
numbers differ: noisy depth has less contrast, and a narrow view has fewer edges.
"""

from dataclasses import astuple, dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Rotation, transform_from
from service.registration.kernel import render
from service.registration.points import GROUND_M, MOVABLE_M, DepthBlocks
from service.registration.register import Registered
from service.registration.surfel_tiles import Cloud
from service.scoring.measured import MeasuredFrame
from service.scoring.rendered_depth import REACH_M, SURFEL_M
from service.scoring.scorer import Scores

#: Camera of the comparison, the same for all rigs: 40 px per radian at the centre, 109 by 70 degrees.
CAMERA = PinholeCamera(112, 56, 40.0, 40.0, 55.5, 27.5)
#: Points higher than this above the ground (m) are no vehicles or people.
UPPER_M = MOVABLE_M
#: Relative difference of the depths of two neighbouring pixels at a depth edge.
JUMP = 0.25
#: Standard deviation of the surfaces of the map and of a pixel's place on them, m. It adds to that of the depth.
SURFACE_M = 0.1
#: A point agrees with the map within INLIER_SIGMAS. The residual of the contrast is limited to MOST_SIGMAS.
INLIER_SIGMAS, MOST_SIGMAS = 2.0, 3.0
#: Shifts of the map's image for the contrast, pixels: 5.7 and 8.6 degrees at the centre, to each side.
SHIFTS_PX = (-6, -4, 4, 6)
#: Pixels, or edges, at which a number counts half. With fewer, inliers tend to 0.5, and contrast and shared edges to 0.
HALF_PIXELS, _HALF_EDGES = 20.0, 10.0
#: Smallest divisor of a depth that is corrected by a disparity offset.
LEAST_STRETCH = 0.05


@dataclass(frozen=True, slots=True)
class Structure:
    """Agreement of a query's depth structure with the map at a pose.

    Attributes:
        shared_edges: share of the depth edges of either image that the other one has too, within a pixel and in the same direction.
        upper_inliers: share of the pixels higher than ``UPPER_M`` that lie on the map's surfaces; 0.5 without such pixels.
        contrast: increase of the mean residual (0 to 1) if the map's image shifts by ``SHIFTS_PX``: the smallest of all shifts.
    """

    shared_edges: float
    upper_inliers: float
    contrast: float


@dataclass(frozen=True, slots=True, kw_only=True)
class StructureWeights:
    """Weights of the numbers of ``Structure`` in the support, nats.

    Fitted by a conditional logit over the candidates of queries of 18 random rigs in as many training cities (decision 0159).

    Attributes:
        shared_edges: weight of the shared depth edges.
        upper_inliers: weight of the inliers above traffic.
        contrast: weight of the contrast.
    """

    shared_edges: float = 17.8
    upper_inliers: float = 7.7
    contrast: float = 6.5


@dataclass(frozen=True, slots=True, eq=False)
class DepthEdges:
    """Depth edges between horizontal neighbours.

    Attributes:
        known: pairs of pixels that both have a depth (H, W - 1).
        rising: pairs whose right pixel is farther, and pairs whose left pixel is farther (2, H, W - 1).
        near: the same, extended by a pixel to the left and to the right.
    """

    known: Bool[NDArray[np.bool_], "H pairs"]
    rising: Bool[NDArray[np.bool_], "2 H pairs"]
    near: Bool[NDArray[np.bool_], "2 H pairs"]


@dataclass(frozen=True, slots=True, eq=False)
class StructureImage:
    """Depth of a query, seen by ``CAMERA``; the same for every pose.

    Attributes:
        z_m: depth, m; 0 where nothing was measured.
        sigma_m: standard deviation of ``z_m`` and of the map's surface, m.
        per_offset: relative change of the depth for a disparity offset of a pixel, 1/px.
        raised: measured pixels that are no ground.
        upper: measured pixels that are neither ground nor vehicles or people.
        edges: depth edges of ``z_m``, as from ``depth_edges``.
    """

    z_m: Float32[NDArray[np.float32], "H W"]
    sigma_m: Float32[NDArray[np.float32], "H W"]
    per_offset: Float32[NDArray[np.float32], "H W"]
    raised: Bool[NDArray[np.bool_], "H W"]
    upper: Bool[NDArray[np.bool_], "H W"]
    edges: DepthEdges


def rendered(
    cloud: Cloud, R_map_camera: Rotation, camera_m: Float64[NDArray[np.float64], " 3"]
) -> Float32[NDArray[np.float32], "H W"]:
    """Return the depth of the map, seen by ``CAMERA``, m; 0 where nothing is mapped.

    Args:
        cloud: cloud of the map.
        R_map_camera: rotation from the camera's optical frame to the map frame.
        camera_m: position of the camera, map frame, m.
    """
    surfels = cloud.at(camera_m)
    return render(
        surfels.pieces,
        T_map_camera=transform_from(R_map_camera, camera_m - surfels.origin_m),
        camera=CAMERA,
        size_m=SURFEL_M,
        reach_m=REACH_M,
    )


def depth_edges(z_m: Float32[NDArray[np.float32], "H W"]) -> DepthEdges:
    """Find the depth edges of an image.

    Args:
        z_m: depth, m; 0 where unknown.
    """
    left, right = z_m[:, :-1], z_m[:, 1:]
    known = (left > 0) & (right > 0)
    rising = np.stack([right > (1 + JUMP) * left, left > (1 + JUMP) * right]) & known
    return DepthEdges(known, rising, near_edges(rising))


def near_edges(rising: Bool[NDArray[np.bool_], "2 H pairs"]) -> Bool[NDArray[np.bool_], "2 H pairs"]:
    """Extend depth edges by a pixel to the left and to the right.

    Args:
        rising: edges, as in ``DepthEdges``.
    """
    near = rising.copy()
    near[:, :, 1:] |= rising[:, :, :-1]
    near[:, :, :-1] |= rising[:, :, 1:]
    return near


def structure_image(
    blocks: DepthBlocks, R_level_camera: Rotation, height_m: float, *, noise: float, focal_baseline_px_m: float | None
) -> StructureImage:
    """Prepare the depth of a query.

    Args:
        blocks: blocks of the depth image.
        R_level_camera: rotation from the camera's optical frame to the level frame.
        height_m: height of the camera above the ground, m.
        noise: standard deviation of an inverse depth, 1/m.
        focal_baseline_px_m: focal length (px) times baseline (m) of the stereo rig; None if the depth has no disparity.
    """
    x = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    y = (np.arange(CAMERA.height) - CAMERA.cy) / CAMERA.fy
    own = blocks.camera
    column = np.rint(x * own.fx + own.cx).astype(np.intp)
    row = np.rint(y * own.fy + own.cy).astype(np.intp)
    columns = np.flatnonzero((column >= 0) & (column < own.width))
    rows = np.flatnonzero((row >= 0) & (row < own.height))
    z = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    z[np.ix_(rows, columns)] = blocks.z_m[np.ix_(row[rows], column[columns])]
    up = R_level_camera[2]
    above_m = z * (up[0] * x[None] + up[1] * y[:, None] + up[2]) + height_m
    known = z > 0
    return StructureImage(
        z_m=z,
        sigma_m=np.asarray(noise * z * z + SURFACE_M, np.float32),
        per_offset=np.zeros_like(z) if focal_baseline_px_m is None else np.asarray(z / focal_baseline_px_m, np.float32),
        raised=known & (above_m > GROUND_M),
        upper=known & (above_m > UPPER_M),
        edges=depth_edges(z),
    )


def compare(
    image: StructureImage, rendered_m: Float32[NDArray[np.float32], "H W"], *, scale: float = 1.0, offset: float = 0.0
) -> Structure:
    """Compare the depth structure of a query with the map rendered at a pose.

    Scale and offset correct the depth. They do not change its edges, which are relative differences.

    Args:
        image: depth of the query.
        rendered_m: depth of the map, seen by ``CAMERA``, m; 0 where nothing is mapped.
        scale: factor from measured to true depth.
        offset: disparity offset, px.
    """
    z = corrected(image, scale=scale, offset=offset)
    sigmas = residual_sigmas(image, z, rendered_m)
    upper = image.upper & (rendered_m > 0)
    inliers = float((np.abs(sigmas[upper]) < INLIER_SIGMAS).sum())
    return Structure(
        shared_edges=shared_edges(image.edges, depth_edges(rendered_m)),
        upper_inliers=(inliers + 0.5 * HALF_PIXELS) / (float(upper.sum()) + HALF_PIXELS),
        contrast=contrast(image, z, rendered_m),
    )


def corrected(image: StructureImage, *, scale: float, offset: float) -> Float32[NDArray[np.float32], "H W"]:
    """Return the depth of a query with the scale and the disparity offset of its registration, m.

    Args:
        image: depth of the query.
        scale: factor from measured to true depth.
        offset: disparity offset, px.
    """
    # A large negative offset puts a far point behind infinity. The limit keeps the depth finite; such a point is no inlier.
    stretch = np.maximum(1 + np.float32(offset) * image.per_offset, np.float32(LEAST_STRETCH))
    z_m: Float32[NDArray[np.float32], "H W"] = image.z_m * np.float32(scale) / stretch
    return z_m


def residual_sigmas(
    image: StructureImage, z_m: Float32[NDArray[np.float32], "H W"], rendered_m: Float32[NDArray[np.float32], "H W"]
) -> Float32[NDArray[np.float32], "H W"]:
    """Return the residual of each pixel, in standard deviations; negative in front of the map's surface.

    Args:
        image: depth of the query.
        z_m: its corrected depth, m.
        rendered_m: depth of the map, m; 0 where nothing is mapped. The residual has no meaning there.
    """
    sigmas: Float32[NDArray[np.float32], "H W"] = (z_m - rendered_m) / image.sigma_m
    return sigmas


def mean_residual(
    image: StructureImage, z_m: Float32[NDArray[np.float32], "H W"], rendered_m: Float32[NDArray[np.float32], "H W"]
) -> tuple[float, float]:
    """Return the mean residual of the pixels that are no ground, and their number.

    A pixel on the map's surface counts 0, and one that is ``MOST_SIGMAS`` or more away counts 1. The mean is 1 without such pixels.

    Args:
        image: depth of the query.
        z_m: its corrected depth, m.
        rendered_m: depth of the map, m; 0 where nothing is mapped.
    """
    at = image.raised & (rendered_m > 0)
    count = float(at.sum())
    if not count:
        return 1.0, 0.0
    sigmas = np.abs(residual_sigmas(image, z_m, rendered_m)[at])
    return float(np.minimum(sigmas / np.float32(MOST_SIGMAS), np.float32(1)).mean()), count


def contrast(
    image: StructureImage, z_m: Float32[NDArray[np.float32], "H W"], rendered_m: Float32[NDArray[np.float32], "H W"]
) -> float:
    """Return by how much the mean residual increases if the map's image shifts by ``SHIFTS_PX``: the smallest of all shifts.

    Args:
        image: depth of the query.
        z_m: its corrected depth, m.
        rendered_m: depth of the map, m; 0 where nothing is mapped.
    """
    own, count = mean_residual(image, z_m, rendered_m)
    shifted = min(mean_residual(image, z_m, _shifted(rendered_m, by))[0] for by in SHIFTS_PX)
    return (shifted - own) * count / (count + HALF_PIXELS)


def _shifted(image: Float32[NDArray[np.float32], "H W"], by: int) -> Float32[NDArray[np.float32], "H W"]:
    """Shift an image by some pixels to the right; 0 where nothing of it is in view then."""
    shifted = np.zeros_like(image)
    if by > 0:
        shifted[:, by:] = image[:, :-by]
    else:
        shifted[:, :by] = image[:, -by:]
    return shifted


def shared_edges(one: DepthEdges, other: DepthEdges) -> float:
    """Return the share of the edges of two images that the other image has too, where both have a depth.

    Args:
        one: edges of an image.
        other: edges of another image.
    """
    both = one.known & other.known
    edges, other_edges = one.rising & both, other.rising & both
    shared = (edges & other.near).sum() + (other_edges & one.near).sum()
    return float(shared) / (float(edges.sum() + other_edges.sum()) + _HALF_EDGES)


class StructureScorer:
    """Scorer by depth structure. Its score is in nats: the sum of the three numbers of ``Structure`` with their weights.

    Args:
        cloud: cloud of the map.
        measured: frames of the query, the reference first.
        weights: weights of the numbers.

    Attributes:
        measured: the frames that have points.
        images: depth of each of these frames.
    """

    name = "structure"

    def __init__(self, cloud: Cloud, measured: tuple[MeasuredFrame, ...], weights: StructureWeights) -> None:
        self._cloud, self._weights = cloud, weights
        self.measured = tuple(each for each in measured if len(each.points))
        self.images = tuple(
            structure_image(
                each.blocks,
                each.frame.R_level_camera,
                each.frame.views.height_m,
                noise=each.frame.noise,
                focal_baseline_px_m=each.picture.focal_baseline_px_m,
            )
            for each in self.measured
        )

    def score(self, poses: tuple[Registered, ...]) -> Scores:
        """Return the score of each pose; details are the numbers of ``Structure``, means over the frames that have points.

        Args:
            poses: registered poses of the reference's level frame.
        """
        found = np.array([self._structure(pose) for pose in poses], np.float64).reshape(len(poses), 3)
        return Scores(found @ np.array(astuple(self._weights)), dict(zip(Structure.__slots__, found.T, strict=True)))

    def _structure(self, pose: Registered) -> NDArray[np.float64]:
        found = []
        for image, each in zip(self.images, self.measured, strict=True):
            own = each.pose(pose)
            T = each.frame.pose_of_camera(own.T_map_level)
            rendered_m = rendered(self._cloud, T[:3, :3], T[:3, 3])
            found.append(astuple(compare(image, rendered_m, scale=own.scale, offset=own.offset)))
        return np.asarray(np.mean(found, axis=0), np.float64)
