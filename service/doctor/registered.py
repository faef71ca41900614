"""Check that the depth image is registered to the colour image: depth edges should lie on colour edges."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy.typing import NDArray

from service.doctor.finding import Finding

#: Both images are compared at this width, pixels.
WIDTH = 320
#: Two measured pixels with one pixel between them are a strong depth edge if their depths differ by this share of the nearer one.
STEP = 0.2
#: Depth edges beyond this depth count for nothing: noise of stereo matching makes them, metres.
REACH_M = 25.0
#: This share of the pixels with the strongest brightness gradient are colour edges.
COLOUR_SHARE = 0.1
#: A colour edge counts up to this distance, pixels of the compared size.
NEAR_PX = 1
#: Largest shift of the depth that is tried, pixels of the compared size: to the sides, and up or down.
ACROSS_PX, DOWN_PX = 24, 12
#: Fewest pixels on depth edges for a comparison.
FEWEST = 200
#: A shift is clearly better if it is at least so long (pixels of the compared size), raises the share by ``GAIN``, and lies so many
#: standard deviations of all shifts above their mean.
LEAST_SHIFT_PX, GAIN, DEVIATIONS = 4.0, 0.18, 2.8


@dataclass(frozen=True, slots=True)
class EdgeShift:
    """How well depth edges lie on colour edges, as given and at the best shift.

    Attributes:
        edges: pixels on depth edges, at the compared size.
        as_given: share of them near a colour edge.
        shifted: the same share at the best shift.
        across_px: best shift of the depth to the right, pixels of the colour image.
        down_px: best shift of the depth down, pixels of the colour image.
        deviations: distance of ``shifted`` from the mean over all shifts, in standard deviations.
        length_px: length of the best shift, pixels of the compared size.
    """

    edges: int
    as_given: float
    shifted: float
    across_px: float
    down_px: float
    deviations: float
    length_px: float

    @property
    def is_clear(self) -> bool:
        """Whether the shifted depth fits the colour clearly better than the depth as given."""
        gained = self.shifted - self.as_given
        return self.length_px >= LEAST_SHIFT_PX and gained >= GAIN and self.deviations >= DEVIATIONS


def edge_shift(
    rgb: UInt8[NDArray[np.uint8], "H W 3"], depth_m: Float32[NDArray[np.float32], "h w"]
) -> EdgeShift | None:
    """Compare the edges of depth and colour at all small shifts of the depth.

    Args:
        rgb: colour image, sRGB.
        depth_m: z, metres, 0 where nothing was measured. It has the aspect ratio of the colour image.

    Returns:
        The comparison; None if there are too few depth edges.
    """
    height = max(2, round(WIDTH * rgb.shape[0] / rgb.shape[1]))
    colour = _colour_edges(np.asarray(cv2.resize(rgb, (WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8))
    depth = depth_edges(np.asarray(cv2.resize(depth_m, (WIDTH, height), interpolation=cv2.INTER_NEAREST), np.float32))
    v, u = np.nonzero(depth)
    inside = (u >= ACROSS_PX) & (u < WIDTH - ACROSS_PX) & (v >= DOWN_PX) & (v < height - DOWN_PX)
    v, u = v[inside], u[inside]
    if len(u) < FEWEST:
        return None
    shifts = [(du, dv) for dv in range(-DOWN_PX, DOWN_PX + 1) for du in range(-ACROSS_PX, ACROSS_PX + 1)]
    shares = np.array([colour[v + dv, u + du].mean() for du, dv in shifts])
    best = int(shares.argmax())
    du, dv = shifts[best]
    scale = rgb.shape[1] / WIDTH
    return EdgeShift(
        edges=len(u),
        as_given=float(shares[shifts.index((0, 0))]),
        shifted=float(shares[best]),
        across_px=du * scale,
        down_px=dv * scale,
        deviations=float((shares[best] - shares.mean()) / max(float(shares.std()), 1e-9)),
        length_px=float(np.hypot(du, dv)),
    )


def depth_edges(depth_m: Float32[NDArray[np.float32], "H W"]) -> Bool[NDArray[np.bool_], "H W"]:
    """Find the pixels between two measured pixels, beside or above each other, whose depths differ strongly.

    Args:
        depth_m: z, metres, 0 where nothing was measured.
    """
    edges = np.zeros(depth_m.shape, np.bool_)
    for one, other, between in (
        (depth_m[:, :-2], depth_m[:, 2:], edges[:, 1:-1]),
        (depth_m[:-2], depth_m[2:], edges[1:-1]),
    ):
        nearer = np.minimum(one, other)
        between |= (nearer > 0) & (nearer < REACH_M) & (np.abs(one - other) > STEP * nearer)
    return edges


def _colour_edges(rgb: UInt8[NDArray[np.uint8], "H W 3"]) -> Bool[NDArray[np.bool_], "H W"]:
    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (3, 3), 0).astype(np.float32)
    strength = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    edges = (strength > max(float(np.quantile(strength, 1 - COLOUR_SHARE)), 1e-3)).astype(np.uint8)
    grown = cv2.dilate(edges, np.ones((2 * NEAR_PX + 1, 2 * NEAR_PX + 1), np.uint8))
    return np.asarray(grown > 0)


def check_registered(rgb: UInt8[NDArray[np.uint8], "H W 3"], depth_m: Float32[NDArray[np.float32], "h w"]) -> Finding:
    """Check that the depth image is registered to the colour image.

    Args:
        rgb: colour image, sRGB.
        depth_m: z, metres, 0 where nothing was measured.
    """
    check = "depth on colour"
    found = edge_shift(rgb, depth_m)
    if found is None:
        return Finding(check, "ok", "not compared: the depth image has too few edges")
    text = f"{found.as_given:.0%} of the depth edges lie on colour edges"
    if not found.is_clear:
        return Finding(check, "ok", f"{text}; no shift is clearly better")
    where = f"{_pixels(found.across_px, 'right', 'left')} and {_pixels(found.down_px, 'down', 'up')}"
    return Finding(
        check,
        "warning",
        f"{text}, and {found.shifted:.0%} with the depth moved {where} (pixels of the colour image)",
        "register the depth image to the colour camera, as the driver's option align_depth does, and send images with the same time stamp",
    )


def _pixels(shift_px: float, positive: str, negative: str) -> str:
    return f"{abs(shift_px):.0f} px {positive if shift_px >= 0 else negative}"
