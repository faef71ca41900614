"""Compute the intermediate images of an answer, with the functions that compute the answer."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from service.console.pictures import depth_picture, enlarged, png_of
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, Transform, rotation_z, transform_from, transform_points
from service.imaging.fusion import picture_of
from service.imaging.resample import resample
from service.imaging.view_grid import ViewGrid
from service.localization.refine import RefineSettings
from service.maps.map import Map
from service.registration.kernel import render
from service.registration.register import Registered
from service.registration.surfel_tiles import Surfels
from service.retrieval.query import Query
from service.retrieval.retrieve import EncodedFrame
from service.runtime.engine import EncodedQuery, Engine, Located
from service.runtime.memory import EXPLAIN_PEAK
from service.scoring.rendered_depth import REACH_M, SURFEL_M
from service.timing import timed_request

_WIDTH, _MAP_WIDTH = 320, 160  # width of depth images, px; in a larger one the gaps between surfels would be visible
_POINTS_ACROSS = 160  # columns of the query's points in the map
_CELL_PIXELS = 4
_POINT = np.dtype([("xyz", "<f4", (3,)), ("rgb", "u1", (3,)), ("pad", "u1")])
POINT_BYTES = _POINT.itemsize


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """An answer with its intermediate images.

    Attributes:
        located: the same answer as without explanation.
        pictures: PNG images by name. A map without a cloud has no ``view`` and no ``map_depth``.
        points: points of the query at the best pose, which only a LOCALIZED answer confirms. Each has x, y, z (float32, metres from
            ``origin_m``), red, green, blue and one byte of padding.
        origin_m: origin of ``points``, map frame.
    """

    located: Located
    pictures: dict[str, bytes]
    points: bytes
    origin_m: Float64[NDArray[np.float64], "3"]


@timed_request()
def explain(engine: Engine, encoded: EncodedQuery) -> Explanation:
    """Localize a query and draw the intermediate images, in the thread of the caller.

    Args:
        engine: the engine of the service.
        encoded: the query with its encoded images.

    Raises:
        StreetfixError: as ``Engine.localize``.
    """
    localizer = engine.localizer_for(encoded)
    frame = engine.encode_and_search(localizer, encoded)
    located = engine.answer(localizer, (frame,))
    answer, bundle = located.answer, located.bundle
    T_map_camera = answer.T_map_camera_guess
    registered = answer.candidates[0].registered if answer.candidates else None
    with engine.memory.hold() as hold:
        hold.grow(EXPLAIN_PEAK * frame.query.depth_m.size)
        depth_m = mapped_depth(frame, registered, localizer.refining)
        hold.shrink_to(depth_m.nbytes)
        hold.leave_with(depth_m)
    drawn = {"depth": depth_picture(_small(depth_m)), "fused": _fused(frame, bundle.grid)}
    if bundle.cloud is not None:
        best = answer.neighbours[0]
        drawn["view"] = _map_view(bundle, bundle.cloud.at(best.position_m), best.position_m, best.heading_rad)
        drawn["map_depth"] = enlarged(
            depth_picture(_drawn_map(bundle.cloud.at(T_map_camera[:3, 3]), T_map_camera, _scaled(frame.query))),
            _WIDTH // _MAP_WIDTH,
        )
    origin_m = np.round(T_map_camera[:3, 3])
    return Explanation(
        located,
        {name: png_of(each) for name, each in drawn.items()},
        _points(frame.query, depth_m, T_map_camera, origin_m),
        origin_m,
    )


def mapped_depth(
    frame: EncodedFrame, registered: Registered | None, settings: RefineSettings
) -> Float32[NDArray[np.float32], "H W"]:
    """Return the depth image corrected by the scale and the disparity offset that registration estimated, m.

    Args:
        frame: frame of the query.
        registered: result of registration; None returns the depth image unchanged.
        settings: settings of registration. They give focal length x baseline if the query does not.
    """
    depth_m = frame.query.depth_m
    if registered is None:
        return depth_m
    unit = frame.query.focal_baseline_px_m or settings.focal_baseline_px_m
    return (depth_m * registered.scale / (1.0 + registered.offset * depth_m / unit)).astype(np.float32)


def _fused(frame: EncodedFrame, grid: ViewGrid) -> NDArray[np.uint8]:
    """Return an image of the query view at the turn closest to 0."""
    ahead = int(np.argmin(np.abs(frame.views.turns_rad)))
    return enlarged(picture_of(frame.views.planes[ahead, :3], grid.max_range_m), _CELL_PIXELS)


def _map_view(
    bundle: Map, cloud: Surfels, position_m: Float64[NDArray[np.float64], "3"], heading_rad: float
) -> NDArray[np.uint8]:
    """Return an image of the map on the view grid, rendered from the cloud at a position and heading."""
    T_map_camera = transform_from(rotation_z(heading_rad) @ R_BODY_OPTICAL, position_m)
    camera = camera_over(bundle.grid)
    depth_m = _drawn_map(cloud, T_map_camera, camera)
    grey = np.full((*depth_m.shape, 3), 128, np.uint8)
    ranges, _, _ = resample(grey, depth_m, camera, np.ascontiguousarray(R_BODY_OPTICAL.T), bundle.grid)
    ranges = np.where(ranges <= bundle.grid.max_range_m, ranges, 0) * bundle.rows_seen[:, None]
    colourless = np.zeros((2, *ranges.shape), np.float32)
    planes = np.concatenate([ranges[None], colourless]).astype(np.float32)
    return enlarged(picture_of(planes, bundle.grid.max_range_m), _CELL_PIXELS)


def camera_over(grid: ViewGrid) -> PinholeCamera:
    """Return a camera that sees a whole view, with about twice its columns. Views wider than 140 degrees are cropped.

    Args:
        grid: view grid of the map.
    """
    half = np.deg2rad(min(grid.azimuth_span_deg, 140.0) / 2)
    width = 2 * grid.columns
    focal = float((width - 1) / 2 / np.tan(half))
    steepest = np.deg2rad(max(abs(grid.elevation_top_deg), abs(grid.elevation_bottom_deg)))
    height = 2 * int(np.ceil(focal * np.tan(steepest) / np.cos(half))) + 2
    return PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _drawn_map(cloud: Surfels, T_map_camera: Transform, camera: PinholeCamera) -> Float32[NDArray[np.float32], "H W"]:
    T = transform_from(T_map_camera[:3, :3], T_map_camera[:3, 3] - cloud.origin_m)
    return render(cloud.pieces, T_map_camera=T, camera=camera, size_m=SURFEL_M, reach_m=REACH_M)


def _scaled(query: Query) -> PinholeCamera:
    camera = query.camera
    return camera.scaled_to(_MAP_WIDTH, max(1, round(_MAP_WIDTH * camera.height / camera.width)))


def _small(depth_m: Float32[NDArray[np.float32], "H W"], width: int = _WIDTH) -> Float32[NDArray[np.float32], "h w"]:
    """Return the depth image at a width, by the nearest pixel. A mean across a depth edge would be a wrong depth."""
    height = max(1, round(width * depth_m.shape[0] / depth_m.shape[1]))
    small: NDArray[np.float32] = cv2.resize(depth_m, (width, height), interpolation=cv2.INTER_NEAREST).astype(
        np.float32
    )
    return small


def _points(
    query: Query,
    depth_m: Float32[NDArray[np.float32], "H W"],
    T_map_camera: Transform,
    origin_m: Float64[NDArray[np.float64], "3"],
) -> bytes:
    z = _small(depth_m, _POINTS_ACROSS)
    camera = query.camera.scaled_to(z.shape[1], z.shape[0])
    colour = cv2.resize(query.rgb, (z.shape[1], z.shape[0]), interpolation=cv2.INTER_AREA)
    seen = (z > 0) & (z <= REACH_M)
    packed = np.zeros(int(seen.sum()), _POINT)
    points_map = transform_points(T_map_camera, (camera.rays_of_pixels() * z[..., None])[seen])
    packed["xyz"] = points_map - origin_m
    packed["rgb"] = colour[seen]
    return packed.tobytes()
