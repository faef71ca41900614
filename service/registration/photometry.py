"""Do the map's brightness, as a pose shows it, and the picture's vary together?

A LiDAR's returns and a picture do not share a scale, nor even a sign: leaves are bright in the infrared, a wall that is darker than its
neighbour to the eye may be brighter to the laser. But where one changes, the other mostly does: panes, frames, kerbs, doors, posters. So
what counts is how well either can be told from the other within a patch, whatever the sign: the squared correlation, patch by patch.
It knows nothing of depth, which is why it tells poses apart that depth cannot. (Mutual information does so for whole pictures: Pandey
et al., "Automatic Targetless Extrinsic Calibration", AAAI 2012; patches were better here, see the decision log.)
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Int32, UInt8
from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotometrySettings:
    """Ours, November 2026; chosen on a watch city.

    Attributes:
        patch: pixels of the small picture along the edge of a patch.
        known: share of a patch's pixels that must show a surfel with a brightness.
        flat: deviation of the logarithm of a brightness within a patch that is taken for its noise.
        dark_grey: grey levels (of 255) below which the logarithm of the picture levels off;
        dark_share: and of the map, in means of what is in view.
    """

    patch: int = 8
    known: float = 0.5
    flat: float = 0.05
    dark_grey: float = 8.0
    dark_share: float = 0.03


def grey_of(
    rgb: UInt8[NDArray[np.uint8], "h w 3"], camera: PinholeCamera, covered: tuple[float, float], settings: PhotometrySettings
) -> Float32[NDArray[np.float32], "H W"]:  # fmt: skip
    """Logarithm of a picture's grey levels, each pixel of the small camera the mean of what it covers.

    Args:
        rgb: of the camera's aspect, of any size.
        camera: of the small picture.
        covered: share of the picture's width and height that the small one covers, from the left and the top.
        settings: where it levels off.
    """
    height, width = (max(1, round(side * share)) for side, share in zip(rgb.shape[:2], covered[::-1], strict=True))
    grey = cv2.cvtColor(rgb[:height, :width], cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    logarithm: Float32[NDArray[np.float32], "H W"] = np.log(small.astype(np.float32) + np.float32(settings.dark_grey))
    return logarithm


def agreement_of_brightness(
    brightness: Float32[NDArray[np.float32], " n"], met: Int32[NDArray[np.int32], "H W"], grey: Float32[NDArray[np.float32], "H W"],
    settings: PhotometrySettings,
) -> float:  # fmt: skip
    """Mean squared correlation of patches, from 0 (also where the map knows no brightness) to 1.

    Args:
        brightness: of the map's surfels.
        met: the surfel that each pixel of the small picture shows, as ``meet`` gave it.
        grey: of the picture, as ``grey_of`` gave it.
        settings: of the patches.
    """
    return squared_correlation(_drawn(brightness, met, settings), grey, settings)


def _drawn(
    brightness: Float32[NDArray[np.float32], " n"], met: Int32[NDArray[np.int32], "H W"], settings: PhotometrySettings
) -> Float32[NDArray[np.float32], "H W"]:
    """Logarithm of the brightness that each pixel shows, NaN where none is known."""
    values = np.where(met >= 0, brightness[np.maximum(met, 0)], np.float32(np.nan))
    known = values[~np.isnan(values)]
    mean = float(known.mean()) if known.size else 0.0
    if not mean > 0:
        return np.full(met.shape, np.nan, np.float32)
    logarithm: Float32[NDArray[np.float32], "H W"] = np.log(values / np.float32(mean) + np.float32(settings.dark_share))
    return logarithm


def squared_correlation(
    one: Float32[NDArray[np.float32], "H W"], other: Float32[NDArray[np.float32], "H W"], settings: PhotometrySettings
) -> float:
    """Mean over patches of the squared correlation of two pictures, 0 where no patch has enough pixels.

    Args:
        one: NaN where it is not known.
        other: known everywhere.
        settings: of the patches; what remains beside whole ones is left out.
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
    """Whole patches, a row each."""
    down, across = picture.shape[0] // size, picture.shape[1] // size
    whole = picture[: down * size, : across * size].reshape(down, size, across, size)
    return np.ascontiguousarray(whole.transpose(0, 2, 1, 3)).reshape(down * across, size * size)
