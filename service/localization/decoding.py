"""Decode an encoded image pair to a query. The service and its measurements share this code."""

from dataclasses import dataclass

from service.geometry.camera import PinholeCamera
from service.imaging.decode import DepthEncoding, DepthKind, ImageLimits, decode_depth, decode_rgb, require_sizes
from service.imaging.gather import finest_rad
from service.imaging.picture_headers import DEFAULT_LIMITS
from service.imaging.view_grid import ViewGrid
from service.localization.query import Query


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthFormat:
    """Conversion of the stored numbers of a depth image to metres; see ``service.imaging.decode.decode_depth``.

    Attributes:
        encoding: file encoding; None detects it from the first bytes.
        kind: stored quantity: z, range along the ray, or disparity.
        scale_m: metres per stored unit (disparity: pixels per stored unit); None takes the default of the format.
        baseline_m: baseline of the stereo rig that measured the depth. Disparity needs it. With the other kinds, registration then
            also estimates the disparity offset of the rig.
        max_range_m: depths beyond this range count as not measured; None sets no limit.
    """

    encoding: DepthEncoding | None = None
    kind: DepthKind = "z"
    scale_m: float | None = None
    baseline_m: float | None = None
    max_range_m: float | None = None


def decoded_query(
    rgb: bytes, depth: bytes, camera: PinholeCamera, depth_format: DepthFormat, *, grid: ViewGrid, limits: ImageLimits = DEFAULT_LIMITS
) -> Query:  # fmt: skip
    """Decode an image pair to a query that has the default options.

    Args:
        rgb: encoded colour image.
        depth: encoded depth image.
        camera: intrinsics of both images; each image may be scaled uniformly.
        depth_format: meaning of the stored depth numbers.
        grid: view grid of the map. Colour finer than the grid needs is decoded at a fraction of its size.
        limits: largest size of each image.

    Raises:
        StreetfixError: as in ``decode_rgb``, ``decode_depth`` and ``require_sizes``.
    """
    colour = decode_rgb(rgb, limits=limits, camera=camera, finest_rad=finest_rad(grid))
    depth_m = decode_depth(
        depth, camera=camera, encoding=depth_format.encoding, scale_m=depth_format.scale_m, kind=depth_format.kind,
        baseline_m=depth_format.baseline_m, max_range_m=depth_format.max_range_m, limits=limits,
    )  # fmt: skip
    require_sizes(colour, depth_m, camera)
    return Query(rgb=colour, depth_m=depth_m, camera=camera, baseline_m=depth_format.baseline_m)
