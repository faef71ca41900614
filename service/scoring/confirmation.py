"""Confirm the final pose: compare it with poses a little further along the street, and look for objects where the map shows none.

A wrong pose in a street also fits the ground and the walls on both sides. It fits just as well 2 m further. A right pose does not, because
poles, corners and trees no longer fit. Something in front of the map's surfaces is plausible near the ground, where vehicles and people
are. Above them it is not (decision 0165).
"""

from dataclasses import astuple, dataclass

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from service.geometry.rigid import Rotation
from service.registration.register import Registered
from service.registration.surfel_tiles import Cloud
from service.scoring.structure import (
    HALF_PIXELS,
    MOST_SIGMAS,
    StructureImage,
    StructureScorer,
    contrast,
    corrected,
    depth_edges,
    mean_residual,
    rendered,
    residual_sigmas,
    shared_edges,
)

#: Distance to the poses of the comparison, along the optical axis, m.
ALONG_M = 2.0
#: Added to the mean residual, so that a perfect fit has a finite ratio.
_LEAST_RESIDUAL = 0.05


@dataclass(frozen=True, slots=True)
class Confirmation:
    """Numbers of the final pose that only the confidence uses; means over the frames.

    Attributes:
        upper_front: share of the pixels above vehicles and people that lie in front of the map's surfaces.
        contrast: as in ``Structure``, at the final pose.
        along_residual: how many times larger the mean residual is ``ALONG_M`` forward or back: the smaller of both.
        along_edges: decrease of the shared depth edges ``ALONG_M`` forward or back: the smaller of both.
    """

    upper_front: float
    contrast: float
    along_residual: float
    along_edges: float


def confirm(cloud: Cloud, structure: StructureScorer, pose: Registered) -> Confirmation:
    """Compute the numbers of a pose.

    Args:
        cloud: cloud of the map.
        structure: holds the frames of the query that have points, at least one, and their depth.
        pose: registered pose of the reference's level frame.
    """
    found = []
    for image, each in zip(structure.images, structure.measured, strict=True):
        own = each.pose(pose)
        T = each.frame.pose_of_camera(own.T_map_level)
        step = ALONG_M * forward(T[:3, :3])
        here, ahead, behind = (rendered(cloud, T[:3, :3], T[:3, 3] + sign * step) for sign in (0, 1, -1))
        found.append(confirmation_of(image, here, (ahead, behind), scale=own.scale, offset=own.offset))
    return Confirmation(*np.mean([astuple(each) for each in found], axis=0).tolist())


def confirmation_of(
    image: StructureImage,
    here_m: Float32[NDArray[np.float32], "H W"],
    along_m: tuple[Float32[NDArray[np.float32], "H W"], ...],
    *,
    scale: float = 1.0,
    offset: float = 0.0,
) -> Confirmation:
    """Compute the numbers of one image from what the map shows.

    Args:
        image: depth of the query.
        here_m: depth of the map at the pose, seen by ``CAMERA``, m; 0 where nothing is mapped.
        along_m: the same at poses further along the street, m.
        scale: factor from measured to true depth.
        offset: disparity offset, px.
    """
    z_m = corrected(image, scale=scale, offset=offset)
    upper = image.upper & (here_m > 0)
    front = float((residual_sigmas(image, z_m, here_m)[upper] < -MOST_SIGMAS).sum())
    residual = mean_residual(image, z_m, here_m)[0]
    edges = shared_edges(image.edges, depth_edges(here_m))
    return Confirmation(
        upper_front=front / (float(upper.sum()) + HALF_PIXELS),
        contrast=contrast(image, z_m, here_m),
        along_residual=min(mean_residual(image, z_m, other)[0] for other in along_m) / (residual + _LEAST_RESIDUAL),
        along_edges=edges - max(shared_edges(image.edges, depth_edges(other)) for other in along_m),
    )


def forward(R_map_camera: Rotation) -> Float64[NDArray[np.float64], " 3"]:
    """Return the horizontal unit vector of the viewing direction, map frame; (1, 0, 0) for a camera that looks straight up or down.

    Args:
        R_map_camera: rotation from the camera's optical frame to the map frame.
    """
    horizontal = np.array([R_map_camera[0, 2], R_map_camera[1, 2], 0.0])
    length = float(np.hypot(horizontal[0], horizontal[1]))
    return horizontal / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
