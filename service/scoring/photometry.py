"""Score poses by brightness: the patch-wise squared correlation of LiDAR intensity and image grey level.

LiDAR intensity and grey level share neither scale nor sign. Leaves are bright in the infrared. A wall that looks darker than its
neighbour may be brighter to the laser. But both mostly change at the same edges: panes, frames, kerbs, doors, posters. The squared
correlation within a patch measures this and ignores the sign. The score does not use depth. So it distinguishes poses that depth
cannot distinguish.

Pandey et al., "Automatic Targetless Extrinsic Calibration", AAAI 2012, use mutual information of whole images. Patches were better
here (decision 0100).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8
from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera
from service.registration.rays import cast_rays
from service.registration.register import Registered
from service.registration.surfel_tiles import Surfels
from service.registration.visibility import Raycasters
from service.scoring.measured import MeasuredFrame
from service.scoring.scorer import Scores


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotometrySettings:
    """Settings of the brightness score, chosen on a validation city in November 2026 (decision 0100).

    Attributes:
        patch: edge of a patch, pixels of the small image.
        known: least share of a patch's pixels that show a surfel with a brightness.
        flat: standard deviation of the noise of a logarithmic brightness within a patch.
        dark_grey: added to grey levels (0 to 255) before the logarithm, which levels off below this value.
        dark_share: the same for the map's brightness, as a share of its mean over the pixels in view.
    """

    patch: int = 8
    known: float = 0.5
    flat: float = 0.05
    dark_grey: float = 8.0
    dark_share: float = 0.03


def grey_of(
    rgb: UInt8[NDArray[np.uint8], "h w 3"],
    camera: PinholeCamera,
    covered: tuple[float, float],
    settings: PhotometrySettings,
) -> Float32[NDArray[np.float32], "H W"]:
    """Compute the logarithm of an image's grey levels at the resolution of a small camera (area means).

    Args:
        rgb: image of any size.
        camera: intrinsics of the small image.
        covered: shares of the image's width and height that the small image covers, from the left and from the top.
        settings: of the score.
    """
    height, width = (max(1, round(side * share)) for side, share in zip(rgb.shape[:2], covered[::-1], strict=True))
    grey = cv2.cvtColor(rgb[:height, :width], cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    logarithm: Float32[NDArray[np.float32], "H W"] = np.log(small.astype(np.float32) + np.float32(settings.dark_grey))
    return logarithm


def seen_by_lens(
    observed: Bool[NDArray[np.bool_], "h w"], camera: PinholeCamera, covered: tuple[float, float]
) -> Bool[NDArray[np.bool_], "H W"]:
    """Mark the pixels of a small image that only show pixels that the lens saw.

    Args:
        observed: pixels of the depth image that the lens saw.
        camera: intrinsics of the small image.
        covered: shares of the image's width and height that the small image covers, from the left and from the top.
    """
    height, width = (max(1, round(side * share)) for side, share in zip(observed.shape, covered[::-1], strict=True))
    part = observed[:height, :width].astype(np.float32)
    small = cv2.resize(part, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    seen: Bool[NDArray[np.bool_], "H W"] = small > 0.999
    return seen


def agreement_of_brightness(
    surfels: Surfels,
    surfel_of: Int32[NDArray[np.int32], "H W"],
    grey: Float32[NDArray[np.float32], "H W"],
    settings: PhotometrySettings,
) -> float:
    """Correlate the map's brightness with an image: mean squared correlation of all patches, from 0 to 1.

    The score is 0 where no visible surfel has a brightness.

    Args:
        surfels: surfels of the map, with intensities.
        surfel_of: index of the surfel in each pixel of the small image, -1 for none, as ``SurfelRaycaster.intersect`` returns it.
        grey: logarithmic grey levels, as ``grey_of`` returns them.
        settings: of the score.
    """
    return squared_correlation(mapped_brightness(surfels, surfel_of, settings), grey, settings)


def mapped_brightness(
    surfels: Surfels,
    surfel_of: Int32[NDArray[np.int32], "H W"],
    settings: PhotometrySettings,
) -> Float32[NDArray[np.float32], "H W"]:
    """Logarithm of the brightness of each pixel's surfel, relative to the mean; NaN where unknown."""
    brightness = surfels.brightness_of(np.maximum(surfel_of, 0))
    values = np.where(surfel_of >= 0, np.float32(np.nan) if brightness is None else brightness, np.float32(np.nan))
    known = values[~np.isnan(values)]
    mean = float(known.mean()) if known.size else 0.0
    if not mean > 0:
        return np.full(surfel_of.shape, np.nan, np.float32)
    logarithm: Float32[NDArray[np.float32], "H W"] = np.log(values / np.float32(mean) + np.float32(settings.dark_share))
    return logarithm


def squared_correlation(
    one: Float32[NDArray[np.float32], "H W"], other: Float32[NDArray[np.float32], "H W"], settings: PhotometrySettings
) -> float:
    """Average the squared correlation of two images over all patches; 0 if no patch has enough known pixels.

    Args:
        one: first image, NaN where unknown.
        other: second image, known everywhere.
        settings: of the score. Rows and columns that fill no whole patch are left out.
    """
    size = settings.patch
    known = ~np.isnan(one)
    m = _patches(known.astype(np.float32), size)
    a, b = (_patches(np.where(known, picture, np.float32(0)), size) for picture in (one, other))
    count = m.sum(axis=1)
    enough = count >= settings.known * size * size
    if not enough.any():
        return 0.0
    a, b, m, count = a[enough], b[enough], m[enough], count[enough]
    a -= m * (a.sum(axis=1) / count)[:, None]
    b -= m * (b.sum(axis=1) / count)[:, None]
    noise = np.float32(settings.flat**2)
    own, others, both = (np.einsum("pn,pn->p", x, y) / count for x, y in ((a, a), (b, b), (a, b)))
    return float((both**2 / ((own + noise) * (others + noise))).mean())


def _patches(picture: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Whole patches of an image, one per row: (patches, size x size)."""
    down, across = picture.shape[0] // size, picture.shape[1] // size
    whole = picture[: down * size, : across * size].reshape(down, size, across, size)
    return np.ascontiguousarray(whole.transpose(0, 2, 1, 3)).reshape(down * across, size * size)


class BrightnessScorer:
    """Scorer by the agreement of a query's images with the brightness of the map.

    Args:
        raycasters: ray casting into the cloud of the map.
        measured: frames of the query, the reference first.
        settings: of the score.
    """

    name = "brightness"

    def __init__(
        self, raycasters: Raycasters, measured: tuple[MeasuredFrame, ...], settings: PhotometrySettings
    ) -> None:
        self._raycasters, self._measured, self._settings = raycasters, measured, settings
        self._greys: list[Float32[NDArray[np.float32], "H W"]] | None = None
        self._seen: list[Bool[NDArray[np.bool_], "H W"] | None] = []

    @property
    def is_known(self) -> bool:
        """Whether the map has brightness."""
        return self._raycasters.have_brightness

    def score(self, poses: tuple[Registered, ...]) -> Scores:
        """Return the mean squared correlation over all frames, 0 to 1; 0 if the map has no brightness.

        Args:
            poses: registered poses of the reference's level frame.
        """
        if not self.is_known:
            return Scores(np.zeros(len(poses)))
        if self._greys is None:  # many queries need no brightness, so the images are reduced at the first score
            self._greys = [
                grey_of(each.frame.query.rgb, each.blocks.camera, each.blocks.covered, self._settings)
                for each in self._measured
            ]
            self._seen = [
                None
                if each.frame.query.observed is None
                else seen_by_lens(each.frame.query.observed, each.blocks.camera, each.blocks.covered)
                for each in self._measured
            ]
        return Scores(np.array([self._mean(self._greys, pose) for pose in poses]))

    def _mean(
        self,
        greys: list[Float32[NDArray[np.float32], "H W"]],
        pose: Registered,
    ) -> float:
        found = []
        for each, seen, grey in zip(self._measured, self._seen, greys, strict=True):
            raycaster = self._raycasters.at(each.pose(pose).camera_m)
            if not raycaster.cloud.has_brightness:
                return 0.0
            (surfel_of,) = cast_rays(raycaster, [each.picture], pose)
            if seen is not None:
                surfel_of = np.where(seen, surfel_of, np.int32(-1))
            found.append(agreement_of_brightness(raycaster.cloud, surfel_of, grey, self._settings))
        return float(np.mean(found))
