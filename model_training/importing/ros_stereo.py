"""Match the stereo pairs of a bag: rectify raw images, align their rows, and compute depth."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from model_training.importing.ros_frames import stamp_of
from model_training.importing.ros_pairs import Pair, Pairing
from model_training.importing.ros_picture import colour_of
from model_training.importing.ros_reader import BagReader, Message
from model_training.importing.row_alignment import PAIRS, RowAlignment, row_alignment
from model_training.importing.stereo import depth_from_stereo
from service.bridge.pictures import LENSES
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera

Rgb = UInt8[NDArray[np.uint8], "H W 3"]
#: Columns, then rows, in the raw image of the pixels of the rectified image, pixels.
Lookup = Float32[NDArray[np.float32], "2 H W"]

#: Greatest time between the images of a pair, seconds. The cameras of a stereo rig fire together. At 10 m/s the vehicle drives 5 cm in it.
STEREO_TOLERANCE_S = 0.005
#: Greatest difference of fx, cx and cy of two rectified cameras, pixels. A larger one would shift every disparity.
_MOST_DIFFERENCE_PX = 0.5
#: Numbers of coefficients of a lens, and the number of a fisheye lens, that OpenCV rectifies.
_OF_LENS, _OF_FISHEYE = (4, 5, 8, 12, 14), 4


@dataclass(frozen=True, slots=True)
class StereoRig:
    """A stereo rig whose images lie in a bag.

    Attributes:
        camera: of the rectified left images.
        baseline_m: distance of the cameras, metres.
        lookups: of the left and of the right images; None if they are rectified already.
        rows: how far the rows of a rectified pair are apart; None if it is not known.
    """

    camera: PinholeCamera
    baseline_m: float
    lookups: tuple[Lookup, Lookup] | None = None
    rows: RowAlignment | None = None

    def rectified(self, pair: Pair) -> tuple[Rgb, Rgb] | str:
        """Decode and rectify both images of a pair, or say why that fails.

        Args:
            pair: messages of the left and of the right image.
        """
        left, right = colour_of(pair.color), colour_of(pair.partner)
        if isinstance(left, str):
            return left
        if isinstance(right, str):
            return f"right image: {right}"
        size = (self.camera.height, self.camera.width)
        if left.shape[:2] != size or right.shape[:2] != size:
            return f"sizes differ: left {left.shape[:2]}, right {right.shape[:2]}, camera {size}"
        if self.lookups is None:
            return left, right
        return _looked_up(left, self.lookups[0]), _looked_up(right, self.lookups[1])

    def depth(self, left: Rgb, right: Rgb) -> Float32[NDArray[np.float32], "H W"]:
        """Match a rectified pair.

        Args:
            left: sRGB.
            right: sRGB.

        Returns:
            z of the left camera, metres; 0 where nothing was matched, and where the raw left image ends.
        """
        if self.rows is not None:
            right = self.rows.aligned(right, self.camera)
        depth_m = depth_from_stereo(left, right, focal_baseline_px_m=self.camera.fx * self.baseline_m)
        if self.lookups is not None:
            columns, rows = self.lookups[0]
            inside = (
                (columns >= 0) & (columns <= self.camera.width - 1) & (rows >= 0) & (rows <= self.camera.height - 1)
            )
            depth_m[~inside] = 0
        return depth_m

    def with_aligned_rows(self, pairs: Iterable[Pair]) -> "StereoRig":
        """Return the rig with the alignment of its rows.

        Args:
            pairs: some pairs of the drive. Those that cannot be read are omitted.
        """
        images = [images for pair in pairs if not isinstance(images := self.rectified(pair), str)]
        return replace(self, rows=row_alignment(images, self.camera))


def lookups_of(left: Any, right: Any, *, source: str) -> tuple[Lookup, Lookup]:
    """Return where the pixels of rectified images lie in raw images (K, D, R and P of sensor_msgs/CameraInfo).

    Both rectified images get the left camera's projection, so that a point at infinity has a disparity of 0.

    Args:
        left: CameraInfo of the left camera.
        right: CameraInfo of the right camera.
        source: name of the bag, for errors.

    Raises:
        DatasetError: a camera is not calibrated as part of a stereo rig, or the sizes of both differ.
    """
    of_left, of_right = ((int(each.width), int(each.height)) for each in (left, right))
    if of_left != of_right or min(of_left) < 1:
        raise DatasetError(
            f"{source}: the CameraInfos say that the left images have {of_left[0]}x{of_left[1]} pixels and the right ones "
            f"{of_right[0]}x{of_right[1]}; give the CameraInfos of two cameras of one size, or record rectified images",
            field="right_info",
        )
    projection = _matrix(left, "p", (3, 4))[:, :3]
    return _lookup(left, projection, f"{source}, left camera"), _lookup(right, projection, f"{source}, right camera")


def offset_m(message: Any) -> float:
    """Return how far the origin of the rig lies to the right of a camera, metres: P[0, 3] over fx (sensor_msgs/CameraInfo).

    It is 0 if the rig counts from its left camera. Bags of KITTI's colour cameras count from a grey one, 0.06 m to the right.

    Args:
        message: CameraInfo of the left camera.
    """
    P = _matrix(message, "p", (3, 4))
    return float(P[0, 3] / P[0, 0]) if P[0, 0] > 0 and np.isfinite(P[0, 3]) else 0.0


def require_same_projection(left: Any, right: Any, *, source: str) -> None:
    """Refuse rectified cameras whose projections differ. A right camera that is not calibrated (all zeros) says nothing.

    Args:
        left: CameraInfo of the left camera.
        right: CameraInfo of the right camera.
        source: name of the bag, for errors.

    Raises:
        DatasetError: fx, cx or cy differs.
    """
    of_left, of_right = (_matrix(each, "p", (3, 4)) for each in (left, right))
    if not of_right.any():
        return
    for name, at in (("fx", (0, 0)), ("cx", (0, 2)), ("cy", (1, 2))):
        if not abs(of_left[at] - of_right[at]) <= _MOST_DIFFERENCE_PX:  # true for NaN too
            raise DatasetError(
                f"{source}: the rectified cameras have another {name} in their P: {of_left[at]:g} and {of_right[at]:g} px; "
                "record the raw images and import them with --no-rectified, or rectify both with one projection",
                field="right_info",
            )


def spread_pairs(bag: BagReader, color: str, right: str) -> Iterator[Pair]:
    """Yield up to ``PAIRS`` pairs at times that are spread evenly over a bag.

    Args:
        bag: opened.
        color: topic of the left images.
        right: topic of the right images.
    """
    begin_ns, end_ns = bag.span_ns
    seen: set[float] = set()
    for k in range(PAIRS):
        pairing = Pairing(STEREO_TOLERANCE_S)
        for found in bag.messages([color, right], from_ns=begin_ns + (end_ns - begin_ns) * k // PAIRS):
            if not isinstance(found, Message):
                continue
            role = "color" if found.topic == color else "partner"
            pairs = [
                each
                for each in pairing.add(role, stamp_of(found.content.header), found.content)
                if isinstance(each, Pair)
            ]
            if pairs:
                if pairs[0].stamp_s not in seen:
                    seen.add(pairs[0].stamp_s)
                    yield pairs[0]
                break
        else:  # no pair follows, so a later begin finds none either
            return


def _looked_up(image: Rgb, lookup: Lookup) -> Rgb:
    found: Rgb = cv2.remap(image, lookup[0], lookup[1], cv2.INTER_LINEAR).astype(np.uint8)
    return found


def _lookup(message: Any, projection: NDArray[np.float64], named: str) -> Lookup:
    K, R = _matrix(message, "k", (3, 3)), _matrix(message, "r", (3, 3))
    D = np.asarray(message.D if hasattr(message, "D") else message.d, np.float64)
    P = _matrix(message, "p", (3, 4))
    whole = all(np.isfinite(each).all() for each in (K, R, P, D))
    if not (whole and K[0, 0] > 0 and K[1, 1] > 0 and P[0, 0] > 0 and abs(np.linalg.det(R) - 1) < 1e-3):
        raise DatasetError(
            f"{named}: its CameraInfo has no stereo calibration (K, R and P), so its raw images cannot be rectified; record "
            "rectified images, or calibrate the rig",
            field="info",
        )
    lens = LENSES.get(message.distortion_model)
    if lens is None and D.any():
        raise DatasetError(
            f"{named}: unknown distortion_model {message.distortion_model[:40]!r} (known: {', '.join(filter(None, LENSES))}); "
            "record rectified images",
            field="info",
        )
    size = (int(message.width), int(message.height))
    is_fisheye = lens == "kannala_brandt" and D.size > 0
    if (is_fisheye and D.size < _OF_FISHEYE) or (not is_fisheye and D.any() and D.size not in _OF_LENS):
        wanted = f"{_OF_FISHEYE} or more" if is_fisheye else ", ".join(map(str, _OF_LENS))
        raise DatasetError(
            f"{named}: distortion_model {message.distortion_model[:40]!r} has {D.size} coefficients (valid: {wanted}); calibrate the "
            "camera, or record rectified images",
            field="info",
        )
    if is_fisheye:
        columns, rows = cv2.fisheye.initUndistortRectifyMap(K, D[:_OF_FISHEYE], R, projection, size, cv2.CV_32FC1)
    else:
        columns, rows = cv2.initUndistortRectifyMap(K, D if D.any() else np.zeros(5), R, projection, size, cv2.CV_32FC1)
    lookup: Lookup = np.stack([columns, rows]).astype(np.float32)
    return lookup


def _matrix(message: Any, name: str, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return a matrix of a CameraInfo. ROS 1 writes its name in capitals."""
    values = getattr(message, name.upper()) if hasattr(message, name.upper()) else getattr(message, name)
    return np.asarray(values, np.float64).reshape(shape)
