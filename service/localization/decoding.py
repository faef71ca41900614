"""From a pair of encoded pictures to a query: the one way of it, for the service and for whoever measures what it serves."""

from dataclasses import dataclass

from service.geometry.camera import PinholeCamera
from service.imaging.decode import DepthEncoding, DepthKind, ImageLimits, decode_depth, decode_rgb, require_sizes
from service.imaging.gather import finest_rad
from service.imaging.picture_headers import DEFAULT_LIMITS
from service.imaging.view_grid import ViewGrid
from service.localization.query import Query


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthFormat:
    """How a depth picture's numbers become metres; as ``service.imaging.decode.decode_depth`` has them.

    Attributes:
        encoding: of the file; auto tells by its first bytes.
        kind: what is stored.
        scale_m: metres (disparity: pixels) for each stored unit; None lets the format decide.
        baseline_m: of the stereo rig that measured the depth, metres. Disparity needs it; with the other kinds it says that the
            rig's disparity offset is to be estimated.
        max_range_m: what lies beyond is no measurement.
    """

    encoding: DepthEncoding | None = None
    kind: DepthKind = "z"
    scale_m: float | None = None
    baseline_m: float | None = None
    max_range_m: float | None = None


def decoded_query(
    rgb: bytes, depth: bytes, camera: PinholeCamera, depth_format: DepthFormat, *, grid: ViewGrid, limits: ImageLimits = DEFAULT_LIMITS
) -> Query:  # fmt: skip
    """Decode a pair; all options of the query are at their defaults.

    Args:
        rgb: encoded colour picture.
        depth: encoded depth picture.
        camera: of both, at any uniform scale.
        depth_format: what the depth picture's numbers mean.
        grid: of the map that will be asked: colour finer than it needs is decoded at a part of its size.
        limits: what each picture may cost.

    Raises:
        StreetfixError: as ``decode_rgb``, ``decode_depth`` and ``require_sizes``.
    """
    colour = decode_rgb(rgb, limits=limits, camera=camera, finest_rad=finest_rad(grid))
    depth_m = decode_depth(
        depth, camera=camera, encoding=depth_format.encoding, scale_m=depth_format.scale_m, kind=depth_format.kind,
        baseline_m=depth_format.baseline_m, max_range_m=depth_format.max_range_m, limits=limits,
    )  # fmt: skip
    require_sizes(colour, depth_m, camera)
    return Query(rgb=colour, depth_m=depth_m, camera=camera, baseline_m=depth_format.baseline_m)
