"""Checks of an image pair: files, sizes, depth unit and measured share."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from service.contract.convert import query_from
from service.contract.schema import LocalizeRequest
from service.doctor.finding import Finding
from service.errors import ImageSizeError, StreetfixError
from service.geometry.camera import PinholeCamera
from service.imaging.decode import ASPECT_TOLERANCE, decode_depth, decode_rgb, default_scale_m, require_sizes
from service.imaging.depth_formats import read_depth_values
from service.imaging.depth_unit_hint import FACTORS, USUAL_M
from service.imaging.picture_headers import DEFAULT_LIMITS
from service.imaging.rectify import RectifiedPair, rectification_of, rectified_pair
from service.runtime.engine import EncodedQuery

#: Smallest share of pixels with depth. Below it, the images rarely suffice.
LEAST_SHARE = 0.1

Rgb = UInt8[NDArray[np.uint8], "H W 3"]
Depth = Float32[NDArray[np.float32], "h w"]


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """A decoded image pair, as sent.

    Attributes:
        encoded: the query as a service gets it.
        rgb: colour image, sRGB.
        depth_m: z, metres, 0 where nothing was measured.
        is_float: whether the file stores the depth as floating-point numbers.
        scale_m: metres (disparity: pixels) per stored unit.
    """

    encoded: EncodedQuery
    rgb: Rgb
    depth_m: Depth
    is_float: bool
    scale_m: float

    def rectified(self) -> RectifiedPair:
        """Return the images as the service uses them: those of a pinhole camera.

        Raises:
            RequestError: the distortion is not invertible over the image, or the rectified image would be empty.
        """
        return rectified_pair(self.rgb, self.depth_m, self.encoded.camera)

    def with_scale(self, scale_m: float) -> "Pair":
        """Return the pair with another ``depth.scale_m``.

        Args:
            scale_m: metres (disparity: pixels) per stored unit.
        """
        encoded = replace(self.encoded, scale_m=scale_m)
        return replace(self, encoded=encoded, depth_m=_depth_of(encoded), scale_m=scale_m)


def encoded_of(request: LocalizeRequest, rgb: bytes, depth: bytes) -> EncodedQuery:
    """Build the query that a service would get. A wrong distortion is left out, because it has a check of its own.

    Args:
        request: the camera file.
        rgb: encoded colour image.
        depth: encoded depth image.

    Raises:
        StreetfixError: a field contradicts other fields.
    """
    encoded = query_from(request, rgb=rgb, depth=depth)
    if not encoded.camera.is_distorted:
        return encoded
    try:
        rectification_of(encoded.camera)
    except StreetfixError:  # the check of the distortion names the error
        return replace(encoded, camera=replace(encoded.camera, distortion=(), distortion_model="brown_conrady"))
    return encoded


def check_images(encoded: EncodedQuery) -> tuple[Finding, Pair | None]:
    """Check that both images decode and that their sizes fit the camera.

    Args:
        encoded: the query as a service gets it.

    Returns:
        The finding, and the decoded pair if there is one that fits.
    """
    check, camera = "images", encoded.camera
    try:
        rgb = decode_rgb(encoded.rgb)
        values = read_depth_values(encoded.depth, encoding=encoded.depth_encoding, limits=DEFAULT_LIMITS)
        depth_m = _depth_of(encoded)
    except StreetfixError as error:
        return Finding.of_error(check, error), None
    try:
        require_sizes(rgb, depth_m, camera)
    except ImageSizeError as error:
        return _size_finding(check, rgb, depth_m, camera) or Finding.of_error(check, error), None
    scale_m = default_scale_m(values.dtype, encoded.depth_encoding) if encoded.scale_m is None else encoded.scale_m
    pair = Pair(encoded, rgb, depth_m, bool(np.issubdtype(values.dtype, np.floating)), scale_m)
    text = f"colour {_size_of(rgb)}, depth {_size_of(depth_m)} of {values.dtype.name}"
    return Finding(check, "ok", f"{text}, camera {camera.width}x{camera.height}"), pair


def _depth_of(encoded: EncodedQuery) -> Depth:
    return decode_depth(
        encoded.depth,
        camera=encoded.camera,
        encoding=encoded.depth_encoding,
        scale_m=encoded.scale_m,
        kind=encoded.depth_kind,
        baseline_m=encoded.baseline_m,
        max_range_m=encoded.max_range_m,
    )


def _size_finding(check: str, rgb: Rgb, depth_m: Depth, camera: PinholeCamera) -> Finding | None:
    """Say whether width and height are swapped, and in which of the three; None if they are not."""
    swapped = [name for name, image in (("colour", rgb), ("depth", depth_m)) if _is_swapped(image, camera)]
    sizes = f"colour {_size_of(rgb)}, depth {_size_of(depth_m)}, camera {camera.width}x{camera.height}"
    if swapped == ["colour", "depth"]:
        return Finding(
            check,
            "problem",
            f"width and height of the camera file are swapped, or both images are rotated ({sizes})",
            "correct width and height, fx and fy, cx and cy; or rotate both images by 90 degrees",
        )
    if swapped:
        image = f"the {swapped[0]} image"
        text = f"width and height of {image} are swapped: it is rotated relative to the camera ({sizes})"
        return Finding(check, "problem", text, f"rotate {image} by 90 degrees")
    return None


def _size_of(image: Rgb | Depth) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _is_swapped(image: Rgb | Depth, camera: PinholeCamera) -> bool:
    height, width = image.shape[:2]
    off = abs(height * camera.height - width * camera.width)
    return camera.width != camera.height and off <= ASPECT_TOLERANCE * width * camera.width


def check_depth_unit(pair: Pair) -> tuple[Finding, Pair]:
    """Check that the depth is in metres. Where it is not, try a scale of a thousandth and of a thousand times.

    The check ignores ``depth.max_range_m``: with a wrong unit, that limit could remove every pixel.

    Args:
        pair: decoded images.

    Returns:
        The finding, and the pair: with another scale if only that one gives a plausible depth.
    """
    check, (least_m, most_m) = "depth unit", USUAL_M
    median_m = _median_m(pair)
    if median_m is None:
        return Finding(
            check, "problem", "no pixel has a depth", "check the depth file, depth.scale_m and depth.kind"
        ), pair
    if least_m <= median_m <= most_m:
        return Finding(check, "ok", f"the median depth is {_plain(median_m)} m (depth.scale_m {pair.scale_m:g})"), pair
    for factor in FACTORS:
        tried = pair.with_scale(pair.scale_m * factor)
        tried_m = _median_m(tried)
        if tried_m is not None and least_m <= tried_m <= most_m:
            unit = _unit_hint(pair, factor)
            return Finding(
                check,
                "problem",
                f"the median depth is {_plain(median_m)} m with depth.scale_m {pair.scale_m:g}{unit}",
                f"set depth.scale_m to {tried.scale_m:g}: the median is then {_plain(tried_m)} m, and the checks below use it",
            ), tried
    return Finding(
        check,
        "warning",
        f"the median depth is {_plain(median_m)} m, but usual values are {least_m:g} to {most_m:g} m",
        "check depth.scale_m and depth.kind (z, range or disparity)",
    ), pair


def _plain(number: float) -> str:
    """Three digits, never in powers of ten."""
    return np.format_float_positional(number, precision=3, fractional=False, trim="-")


def _unit_hint(pair: Pair, factor: float) -> str:
    if pair.encoded.depth_kind == "disparity":
        return ""
    if pair.is_float and factor < 1:
        return ": the floating-point depth looks like millimetres"
    return ": the stored depth looks like millimetres" if factor < 1 else ": the stored depth looks like metres"


def _median_m(pair: Pair) -> float | None:
    """Median of the measured depth without the limit of the range, metres; None if nothing was measured."""
    depth_m = _depth_of(replace(pair.encoded, max_range_m=None))
    measured = depth_m[depth_m > 0]
    return float(np.median(measured)) if len(measured) else None


def check_measured_share(pair: Pair) -> Finding:
    """Check that enough pixels have a depth.

    Args:
        pair: decoded images.
    """
    share = float(np.mean(pair.depth_m > 0))
    limit = pair.encoded.max_range_m
    text = f"{share:.0%} of the pixels have a depth" + ("" if limit is None else f" of at most {limit:g} m")
    if share >= LEAST_SHARE:
        return Finding("depth share", "ok", text)
    return Finding(
        "depth share",
        "warning" if share > 0 else "problem",
        text,
        "check the range of the sensor, depth.max_range_m, and whether the lens is covered or the sun blinds it",
    )
