"""Conversion of linear light to image bytes: metering, gain, noise, rain and snow in the air."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from model_training.simulation.conditions import Condition
from model_training.simulation.shading import to_srgb

#: Range of the factor by which metering is wrong.
METERING = (0.8, 1.25)
#: Metering target: mean over the pixels of the darkest channel, linear.
_MEAN_LIGHT = 0.26
#: Display value (0 to 1) of light 1 at gain 1 for the proportional response.
_PROPORTIONAL = 1.6


@dataclass(frozen=True, slots=True)
class RgbModel:
    """Parameters of an RGB camera.

    The gain converts linear light to display values. It combines exposure time and amplification. It is metered per image, or fixed.

    Attributes:
        name: name of the preset.
        exposure_ev: exposure correction, stops; positive is brighter.
        most_gain: largest metered gain: longest exposure and strongest amplification.
        fixed_gain: gain of an exposure that is not metered; 0: metered.
        noise: constant part of the noise, one sigma, display values of 0 to 255.
        noise_per_gain: noise per unit of gain, display values. It stops growing at a gain of 40, where denoising would start.
        response: ``tone_mapped`` has a soft shoulder and gamma 2.2, so highlights and shadows keep their detail. ``proportional`` is
            linear and clips, as machine-vision cameras do. In KITTI drive 0005 a tenth of the lower image half is clipped.
    """

    name: str
    exposure_ev: float = 0.0
    most_gain: float = 60.0
    fixed_gain: float = 0.0
    noise: float = 1.2
    noise_per_gain: float = 0.35
    response: Literal["tone_mapped", "proportional"] = "tone_mapped"


#: Presets by name.
RGBS = {
    m.name: m
    for m in (
        RgbModel("automatic"),
        RgbModel("small", most_gain=30.0, noise=3.0, noise_per_gain=1.0),  # sensor of a phone or webcam
        RgbModel("fixed", fixed_gain=0.8),  # set for a clear day: night images are nearly black
        RgbModel("machine", response="proportional"),  # a machine-vision camera, as in KITTI
    )
}


def exposed(
    linear: NDArray[np.float32],
    model: RgbModel,
    condition: Condition,
    rng: np.random.Generator,
    *,
    metering: float | None = None,
) -> NDArray[np.uint8]:
    """Return the image (H, W, 3) of linear light.

    Args:
        linear: linear light (H, W, 3).
        model: RGB camera.
        condition: weather; it may put rain streaks or snow flakes into the image.
        rng: random generator of the frame.
        metering: factor by which the metered gain is wrong; None draws it from ``METERING``.
    """
    mean = float(np.mean(linear[::4, ::4].min(axis=2))) + 1e-4
    metering = rng.uniform(*METERING) if metering is None else metering
    metered = min(_MEAN_LIGHT * 2.0**model.exposure_ev / mean, model.most_gain) * metering
    gain = model.fixed_gain * 2.0**model.exposure_ev or metered
    picture = to_srgb(linear, gain) if model.response == "tone_mapped" else _in_proportion(linear, gain)
    sigma = model.noise + model.noise_per_gain * min(gain, 40.0)
    picture += rng.standard_normal(linear.shape[:2], dtype=np.float32)[..., None] * np.float32(sigma)
    picture += cv2.resize(
        rng.standard_normal((linear.shape[0] // 2, linear.shape[1] // 2, 3), dtype=np.float32),
        (linear.shape[1], linear.shape[0]),
    ) * np.float32(0.5 * sigma)
    if condition.streaks > 0:
        _particles(picture, condition, rng)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _in_proportion(linear: NDArray[np.float32], gain: float) -> NDArray[np.float32]:
    """Return display values proportional to light. They clip only after the noise is added, so clipped areas are flat."""
    return linear * np.float32(255.0 * _PROPORTIONAL * gain)


def _particles(picture: NDArray[np.float32], condition: Condition, rng: np.random.Generator) -> None:
    """Draw rain streaks or snow flakes into the image in place."""
    height, width = picture.shape[:2]
    flakes = condition.snow_cover > 0
    slant = rng.normal(0, 0.15)
    for _ in range(int(condition.streaks * 500 * width / 640)):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        tone = float(rng.uniform(170, 235))
        if flakes:
            cv2.circle(picture, (x, y), int(rng.integers(1, 4)), (tone, tone, tone), -1, cv2.LINE_AA)
        else:
            length = int(rng.integers(6, 26))
            cv2.line(picture, (x, y), (x + int(slant * length), y + length), (tone, tone, tone), 1, cv2.LINE_AA)
