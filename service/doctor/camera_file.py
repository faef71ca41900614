"""Checks of the camera file: the JSON part of a request."""

import json
import math
from pathlib import Path

from service.contract.convert import camera_of, parsed
from service.contract.schema import Camera, LocalizeRequest
from service.doctor.finding import Finding
from service.errors import StreetfixError
from service.geometry.camera import PinholeCamera
from service.imaging.rectify import rectification_of

#: Largest distance of the principal point from the centre, as a share of the side.
OFF_CENTRE = 0.1
#: Plausible horizontal field of view, degrees.
LEAST_VIEW_DEG, MOST_VIEW_DEG = 30.0, 150.0
#: Largest relative difference of fx and fy.
FOCAL_DIFFERENCE = 0.2
_CALIBRATION = "compare with the calibration of the camera at the size of the images that you send"


def check_camera_file(path: Path) -> tuple[Finding, LocalizeRequest | None]:
    """Check that the file is the JSON part of a request.

    Args:
        path: of the file.

    Returns:
        The finding, and the request if the file is one.
    """
    try:
        document = path.read_bytes()
    except OSError as error:
        return Finding("camera file", "problem", f"{path}: cannot be read ({error.strerror})", "check --camera"), None
    try:
        request = parsed(document, LocalizeRequest)
    except StreetfixError as error:
        remedy = ""
        if _is_bare_camera(document):
            remedy = 'put the intrinsics under "camera": {"camera": {"width": 640, ...}}'
        return Finding.of_error("camera file", error, where=str(path), remedy=remedy), None
    camera = request.camera
    return Finding("camera file", "ok", f"{path}: a request with a camera of {camera.width}x{camera.height}"), request


def _is_bare_camera(document: bytes) -> bool:
    try:
        content = json.loads(document)
    except (ValueError, RecursionError):  # then the first message says that it is no JSON
        return False
    return isinstance(content, dict) and "camera" not in content and "fx" in content


def check_principal_point(camera: Camera) -> Finding:
    """Check that the principal point is near the centre of the image.

    Args:
        camera: intrinsics of the request.
    """
    x, y = (camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height
    text = (
        f"({camera.cx:g}, {camera.cy:g}) is {abs(x - 0.5):.0%} of the width and {abs(y - 0.5):.0%} of the height from the centre "
        f"of {camera.width}x{camera.height}"
    )
    if max(abs(x - 0.5), abs(y - 0.5)) <= OFF_CENTRE:
        return Finding("principal point", "ok", text)
    if min(x, y) > 0 and abs(x - y) <= OFF_CENTRE * max(x, y):
        size = f"{2 * x * camera.width:.0f}x{2 * y * camera.height:.0f}"
        return Finding(
            "principal point",
            "warning",
            f"{text}: the intrinsics look like those of an image of about {size} px",
            f"scale fx, fy, cx and cy by {0.5 / x:.3g}, or correct width and height",
        )
    return Finding("principal point", "warning", text, f"{_CALIBRATION}; a cropped image needs cx and cy of the crop")


def check_field_of_view(camera: Camera) -> Finding:
    """Check that the horizontal field of view is that of a usual camera, and name the part that the service keeps.

    Args:
        camera: intrinsics of the request.
    """
    lens = camera_of(camera)
    if lens.is_distorted:
        return _field_of_lens(lens)
    across, down = (
        2 * math.degrees(math.atan(0.5 * side / focal))
        for side, focal in ((camera.width, camera.fx), (camera.height, camera.fy))
    )
    text = f"{across:.0f} degrees across and {down:.0f} degrees down"
    if LEAST_VIEW_DEG <= across <= MOST_VIEW_DEG:
        return Finding("field of view", "ok", text)
    remedy = f"usual values are {LEAST_VIEW_DEG:g} to {MOST_VIEW_DEG:g} degrees across; {_CALIBRATION}"
    return Finding("field of view", "warning", text, remedy)


def _field_of_lens(camera: PinholeCamera) -> Finding:
    """Check the field of the rectified image, which the service uses."""
    try:
        pinhole = rectification_of(camera).camera
    except StreetfixError:  # the check of the distortion names the error
        text = "unknown, because the images cannot be rectified"
        return Finding("field of view", "warning", text, "correct camera.distortion first")
    x, y = (-0.5 - pinhole.cx) / pinhole.fx, (-0.5 - pinhole.cy) / pinhole.fy
    right, bottom = (pinhole.width - 0.5 - pinhole.cx) / pinhole.fx, (pinhole.height - 0.5 - pinhole.cy) / pinhole.fy
    across, down = (math.degrees(math.atan(end) - math.atan(begin)) for begin, end in ((x, right), (y, bottom)))
    text = f"{across:.0f} degrees across and {down:.0f} degrees down in the rectified image of {pinhole.width}x{pinhole.height}"
    if across >= LEAST_VIEW_DEG:
        return Finding("field of view", "ok", text)
    remedy = f"usual values are {LEAST_VIEW_DEG:g} degrees or more across; {_CALIBRATION}"
    return Finding("field of view", "warning", text, remedy)


def check_focal_lengths(camera: Camera) -> Finding:
    """Check that fx and fy are nearly equal, as pixels are nearly square.

    Args:
        camera: intrinsics of the request.
    """
    text = f"fx {camera.fx:g} px, fy {camera.fy:g} px"
    if abs(camera.fx - camera.fy) <= FOCAL_DIFFERENCE * max(camera.fx, camera.fy):
        return Finding("focal lengths", "ok", text)
    remedy = (
        f"pixels are nearly square, so fx and fy differ little: {_CALIBRATION}, and check that no side was stretched"
    )
    return Finding("focal lengths", "warning", text, remedy)


def check_distortion(camera: Camera) -> Finding:
    """Check that the service can rectify the images.

    Args:
        camera: intrinsics of the request.
    """
    lens = camera_of(camera)
    if not lens.is_distorted:
        return Finding(
            "distortion",
            "ok",
            "none given, so both images must be rectified; the command cannot check this",
            "hold a ruler against a straight roof edge, kerb or door frame near the border of an image: if it looks curved, send "
            "camera.distortion and camera.distortion_model",
        )
    try:
        rectification_of(lens)
    except StreetfixError as error:
        return Finding.of_error("distortion", error)
    return Finding(
        "distortion",
        "ok",
        f"{lens.distortion_model} {[round(each, 4) for each in lens.distortion]}: the service rectifies both images",
        "both images must have this lens: depth is registered to the distorted colour image, not to a rectified one",
    )
