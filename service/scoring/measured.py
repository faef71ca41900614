"""The depth of each frame, prepared once for registration and for all scorers."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import Transform
from service.registration.kernel import QueryPoints
from service.registration.points import DepthBlocks, PointSettings, below, blocks_of, movable_of, points_from
from service.registration.rays import RayPicture, picture_of
from service.registration.register import Registered
from service.retrieval.retrieve import EncodedFrame


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredFrame:
    """One frame of a query with its depth in the forms that registration and the scorers read.

    Attributes:
        frame: image pair after retrieval.
        is_reference: whether it is the reference of the query.
        T_reference_level: pose of its level frame in the level frame of the reference.
        blocks: blocks of its depth image.
        points: points of its depth image, in its own level frame.
        picture: inverse depth image, with its pose in the level frame of the reference.
    """

    frame: EncodedFrame
    is_reference: bool
    T_reference_level: Transform
    blocks: DepthBlocks
    points: QueryPoints
    picture: RayPicture

    def pose(self, reference: Registered) -> Registered:
        """Return the pose of this frame's level frame.

        Args:
            reference: pose of the reference's level frame.
        """
        return reference if self.is_reference else reference.of_frame(self.T_reference_level)

    def poses(self, T_map_reference: Float64[NDArray[np.float64], "n 4 4"]) -> Float64[NDArray[np.float64], "n 4 4"]:
        """Return poses of this frame's level frame.

        Args:
            T_map_reference: poses of the reference's level frame.
        """
        return T_map_reference if self.is_reference else T_map_reference @ self.T_reference_level


def measure(
    frames: tuple[EncodedFrame, ...],
    settings: PointSettings,
    *,
    focal_baseline_px_m: float,
    is_rig: bool,
    surveyed_height_m: float | None = None,
) -> tuple[MeasuredFrame, ...]:
    """Prepare the depth of all frames.

    Args:
        frames: image pairs, the reference first.
        settings: settings of the thinning of a depth image to points.
        focal_baseline_px_m: focal length (px) times baseline (m) of the stereo rig, or an assumed one.
        is_rig: whether the stereo rig is known. Its disparity offset is then an unknown of the ray adjustment.
        surveyed_height_m: the map has no surfaces higher than this above the ground, m, so depth above it is omitted; None if unknown.
    """
    measured = []
    for frame in frames:
        blocks = blocks_of(frame.query.depth_m, frame.query.camera, settings, noise=frame.noise)
        if surveyed_height_m is not None:
            blocks = below(blocks, frame.R_level_camera, frame.views.height_m, surveyed_height_m)
        points = points_from(
            blocks,
            frame.R_level_camera,
            frame.views.height_m,
            settings,
            noise=frame.noise,
            focal_baseline_px_m=focal_baseline_px_m,
        )
        T_reference_level = frame.T_reference_level(frames[0])
        picture = picture_of(
            blocks,
            frame.pose_of_camera(T_reference_level),
            noise=frame.noise,
            focal_baseline_px_m=focal_baseline_px_m if is_rig else None,
            movable=movable_of(blocks, frame.R_level_camera, frame.views.height_m, settings),
        )
        measured.append(MeasuredFrame(frame, frame is frames[0], T_reference_level, blocks, points, picture))
    return tuple(measured)


def merged_points(measured: tuple[MeasuredFrame, ...]) -> QueryPoints:
    """Join the points of all frames in the level frame of the reference.

    Args:
        measured: frames, the reference first.
    """
    if len(measured) == 1:
        return measured[0].points
    xyz, ray = [], []
    for each in measured:
        T = each.T_reference_level.astype(np.float32)
        xyz.append(each.points.xyz @ T[:3, :3].T + T[:3, 3])
        ray.append(each.points.ray @ T[:3, :3].T)
    rest = (np.concatenate([getattr(each.points, name) for each in measured]) for name in ("sigma", "weight", "q"))
    return QueryPoints(np.concatenate(xyz), np.concatenate(ray), *rest)
