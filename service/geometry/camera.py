"""The pinhole camera model, and the lens before it. Pixels are (u, v). The centre of the first pixel is at (0, 0)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

#: Model of a distorting lens: OpenCV's polynomial and rational model, or that of ``cv2.fisheye``.
DistortionModel = Literal["brown_conrady", "kannala_brandt"]


@dataclass(frozen=True, slots=True)
class PinholeCamera:
    """Intrinsics of a camera.

    Attributes:
        width: image width, pixels.
        height: image height, pixels.
        fx: horizontal focal length, pixels.
        fy: vertical focal length, pixels.
        cx: u of the principal point, pixels.
        cy: v of the principal point, pixels.
        distortion: distortion coefficients in OpenCV order. Empty for rectified images.
        distortion_model: model of the lens. ``brown_conrady`` without coefficients, or with zeros, is a pinhole.
            ``kannala_brandt`` never is: four zeros are an equidistant fisheye lens.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    distortion_model: DistortionModel = "brown_conrady"

    @property
    def is_distorted(self) -> bool:
        """Whether the image differs from that of a pinhole camera."""
        return self.distortion_model == "kannala_brandt" or any(self.distortion)

    @property
    def matrix(self) -> Float64[NDArray[np.float64], "3 3"]:
        """The camera matrix K, pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def scaled_to(self, width: int, height: int) -> "PinholeCamera":
        """Return the intrinsics for a resized image.

        Pixel centres are at integers, not pixel corners. So the principal point is shifted by half a pixel before scaling.

        Args:
            width: new image width, pixels.
            height: new image height, pixels.
        """
        sx, sy = width / self.width, height / self.height
        return PinholeCamera(
            width,
            height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
            self.distortion,
            self.distortion_model,
        )

    def rays_of_pixels(self) -> Float64[NDArray[np.float64], "H W 3"]:
        """Return the ray through each pixel centre in the optical frame, scaled to z = 1, without distortion."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones(u.shape)], axis=-1)
