"""Draw the streets from above, for people."""

import unicodedata

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy.typing import NDArray

from service.maps.streets import Street, Streets

_LONGEST_PX = 1600
_PAPER, _INK = (246, 249, 250), (40, 36, 33)
_SHIFT = 4  # fraction bits of OpenCV's coordinates: edges are drawn to a sixteenth of a pixel


def picture_png(streets: Streets, places: Float64[NDArray[np.float64], "n 2"]) -> bytes:
    """Draw a PNG, north up: each street in its own colour with its name, the places of the survey as dots.

    Args:
        streets: map frame, metres.
        places: positions of the survey's scans, map frame, metres.
    """
    rings = [ring for street in streets.features for polygon in street.polygons for ring in polygon]
    everything = np.concatenate([*rings, places])
    low, high = everything.min(axis=0) - 5.0, everything.max(axis=0) + 5.0
    pixels_per_m = _LONGEST_PX / float((high - low).max())
    width, height = (int(np.ceil(side)) for side in (high - low) * pixels_per_m)
    picture: UInt8[NDArray[np.uint8], "h w 3"] = np.full((height, width, 3), _PAPER, np.uint8)

    def to_pixels(points: Float64[NDArray[np.float64], "m 2"]) -> NDArray[np.int32]:
        flat = (points - low) * pixels_per_m
        pixels: NDArray[np.int32] = np.column_stack([flat[:, 0], height - 1 - flat[:, 1]]) * 2**_SHIFT
        return np.rint(pixels).astype(np.int32)

    for number, street in enumerate(streets.features):
        for polygon in street.polygons:
            outlines = [to_pixels(ring) for ring in polygon]
            cv2.fillPoly(picture, outlines, _colour(number), cv2.LINE_AA, _SHIFT)
            cv2.polylines(picture, outlines, True, _INK, 1, cv2.LINE_AA, _SHIFT)
    for x, y in to_pixels(places):
        cv2.circle(picture, (int(x), int(y)), 2 << _SHIFT, (40, 60, 200), -1, cv2.LINE_AA, _SHIFT)
    for street in streets.features:
        x, y = to_pixels(_middle(street)[None])[0] >> _SHIFT
        _write(picture, street.name, int(x), int(y))
    return cv2.imencode(".png", picture)[1].tobytes()


def _colour(number: int) -> tuple[int, int, int]:
    """A light colour; neighbours in the list differ by steps of the golden angle."""
    hue = int(number * 137.508 / 2) % 180
    blue, green, red = cv2.cvtColor(np.array([[[hue, 90, 235]]], np.uint8), cv2.COLOR_HSV2BGR)[0, 0].tolist()
    return blue, green, red


def _middle(street: Street) -> Float64[NDArray[np.float64], "2"]:
    """A point in the street's largest part: the middle of the longest inner stretch at half its height."""
    polygon = max(street.polygons, key=lambda rings: float(np.ptp(rings[0], axis=0).sum()))
    y = float(polygon[0][:, 1].min() + polygon[0][:, 1].max()) / 2 + 1e-6
    crossings = []
    for ring in polygon:
        start, end = ring, np.roll(ring, -1, axis=0)
        spans = (start[:, 1] > y) != (end[:, 1] > y)
        a, b = start[spans], end[spans]
        crossings += (a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])).tolist()
    x = np.sort(crossings)
    widest = int(np.argmax(x[1::2] - x[::2]))
    return np.array([(x[2 * widest] + x[2 * widest + 1]) / 2, y])


def _write(picture: UInt8[NDArray[np.uint8], "h w 3"], name: str, x: int, y: int) -> None:
    text = unicodedata.normalize("NFKD", name.replace("ß", "ss")).encode("ascii", "ignore").decode() or "?"
    (wide, high), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)
    x = int(np.clip(x - wide // 2, 2, max(2, picture.shape[1] - wide - 2)))
    y = int(np.clip(y + high // 2, high + 2, picture.shape[0] - 4))
    rim = [(right, down, _PAPER) for right in (-1, 0, 1) for down in (-1, 0, 1)]  # keeps it legible on any colour
    for right, down, colour in (*rim, (0, 0, _INK)):
        cv2.putText(picture, text, (x + right, y + down), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
