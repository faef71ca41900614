"""The query: one RGB image, one depth image, their camera and the options; and how to decode it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy.typing import NDArray

from service.errors import RequestError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Transform
from service.imaging.decode import (
    DepthEncoding,
    DepthKind,
    ImageLimits,
    decode_depth,
    decode_rgb,
    require_sizes,
    stored_size,
)
from service.imaging.level import GivenHeight
from service.imaging.picture_headers import DEFAULT_LIMITS
from service.imaging.rectify import rectification_of, rectified_pair
from service.imaging.resample import finest_rad
from service.imaging.view_grid import ViewGrid
from service.maps.rig_key import RigKey
from service.option_limits import FALSE_ACCEPT_RATE, NEIGHBOURS
from service.retrieval.prior import Prior


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Query:
    """A checked image pair and its options.

    Attributes:
        rgb: colour image, sRGB.
        depth_m: depth image, z in metres; 0 where nothing was measured.
        camera: intrinsics of the rectified camera.
        down_camera: direction of gravity in the camera frame, from an IMU; None if unknown.
        camera_height: height of the camera above the ground; None: it is found in the depth image.
        T_vehicle_camera: pose of the camera on the vehicle; None if the vehicle pose is not wanted.
        neighbours: k, the number of distinct places that vote and that the answer lists.
        refine: whether to register the images on the map cloud, if the map has one.
        ranked: smallest number of places in the answer, beyond the k that vote. Evaluation needs more places for R@10.
        prior: prior of the camera pose; None if nothing is known.
        baseline_m: baseline of the stereo rig that measured the depth; None if no rig is known. With a baseline, registration also
            estimates the disparity offset, and the depth noise is at least that of stereo matching.
        max_range_m: range limit of the depth, metres; None: none is stated. The depth image has no larger depths.
        false_accept_rate: largest tolerated share of out-of-map queries that become LOCALIZED, 0 to 1.
        rate_is_named: whether the request names this rate; False: it is the default of the service. A named rate is refused if the
            recording of the query's rig does not support it.
        observed: pixels of the depth image that the lens saw; None: all. A rectified image has others.
    """

    rgb: UInt8[NDArray[np.uint8], "H W 3"]
    depth_m: Float32[NDArray[np.float32], "h w"]
    camera: PinholeCamera
    down_camera: Float64[NDArray[np.float64], "3"] | None = None
    camera_height: GivenHeight | None = None
    T_vehicle_camera: Transform | None = None
    neighbours: int = NEIGHBOURS
    refine: bool = True
    ranked: int = 0
    prior: Prior | None = None
    baseline_m: float | None = None
    max_range_m: float | None = None
    false_accept_rate: float = FALSE_ACCEPT_RATE
    rate_is_named: bool = False
    observed: Bool[NDArray[np.bool_], "h w"] | None = None

    def __post_init__(self) -> None:
        """Refuse images that are not rectified.

        Raises:
            RequestError: the camera has distortion.
        """
        if self.camera.is_distorted:
            raise RequestError(
                "camera.distortion: a Query has the images of a pinhole camera, but this camera has distortion; make the query by "
                "Query.of_images, which rectifies both images",
                field="camera.distortion",
            )

    @classmethod
    def of_images(
        cls,
        rgb: UInt8[NDArray[np.uint8], "H W 3"],
        depth_m: Float32[NDArray[np.float32], "h w"],
        camera: PinholeCamera,
        *,
        baseline_m: float | None = None,
        max_range_m: float | None = None,
    ) -> "Query":
        """Rectify an image pair, and build the query that has the default options.

        Args:
            rgb: sRGB image with the aspect ratio of the camera.
            depth_m: z of each pixel of the sent image, metres, 0 where nothing was measured. It has the aspect ratio of the camera.
            camera: intrinsics and distortion of both images.
            baseline_m: baseline of the stereo rig that measured the depth, metres; None if no rig is known.
            max_range_m: range limit of the depth, metres; None if none is stated. The depth image must not exceed it.

        Raises:
            RequestError: the distortion is not invertible over the image, or the rectified image would be empty.
            TooLargeError: a side of a distorted image is too long.
        """
        pair = rectified_pair(rgb, depth_m, camera)
        return cls(
            rgb=pair.rgb,
            depth_m=pair.depth_m,
            camera=pair.camera,
            observed=pair.observed,
            baseline_m=baseline_m,
            max_range_m=max_range_m,
        )

    @property
    def rig(self) -> RigKey:
        """The rig of the query: the rectified camera and what the query states about the depth sensor."""
        return RigKey.of(self.camera, baseline_m=self.baseline_m, max_range_m=self.max_range_m)

    @property
    def focal_baseline_px_m(self) -> float | None:
        """Horizontal focal length of the depth image (px) times the baseline (m); None if no stereo rig is known."""
        if self.baseline_m is None:
            return None
        return float(self.camera.fx * self.depth_m.shape[1] / self.camera.width * self.baseline_m)


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
    rgb: bytes,
    depth: bytes,
    camera: PinholeCamera,
    depth_format: DepthFormat,
    *,
    grid: ViewGrid,
    limits: ImageLimits = DEFAULT_LIMITS,
) -> Query:
    """Decode and rectify an image pair to a query that has the default options.

    Args:
        rgb: encoded colour image.
        depth: encoded depth image.
        camera: intrinsics and distortion of both images; each image may be scaled uniformly.
        depth_format: meaning of the stored depth numbers.
        grid: view grid of the map. Colour finer than the grid needs is decoded at a fraction of its size.
        limits: largest size of each image.

    Raises:
        StreetfixError: as in ``decode_rgb``, ``decode_depth``, ``require_sizes`` and ``rectified_pair``.
    """
    if camera.is_distorted:
        rectification_of(camera)  # refuses a wrong model before the images cost time
    colour = decode_rgb(rgb, limits=limits, camera=camera, finest_rad=finest_rad(grid))
    depth_m = decode_depth(
        depth,
        camera=camera,
        encoding=depth_format.encoding,
        scale_m=depth_format.scale_m,
        kind=depth_format.kind,
        baseline_m=depth_format.baseline_m,
        max_range_m=depth_format.max_range_m,
        limits=limits,
    )
    require_sizes(colour, depth_m, camera, rgb_size=stored_size(rgb))
    return Query.of_images(
        colour, depth_m, camera, baseline_m=depth_format.baseline_m, max_range_m=depth_format.max_range_m
    )
