"""From light to the bytes of a picture: metering, gain, noise, rain and snow in the air."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from model_training.simulation.conditions import Condition
from model_training.simulation.shading import to_srgb

METERING = (0.8, 1.25)  # factors by which metering errs
_MEAN_LIGHT = 0.26  # what metering brings the darkest channel's mean to (linear)
_PROPORTIONAL = 1.6  # display value (0 to 1) of light 1 times the gain, of a response in proportion


@dataclass(frozen=True, slots=True)
class RgbModel:
    """Parameters of an RGB camera.

    Gain turns light into display values, exposure time and amplifier in one: what is metered by each picture, or fixed. Noise is a
    display value (0 to 255), one sigma: a floor, and a share that grows with the gain up to 40, where denoising sets in.
    ``response`` is how values follow light: ``tone_mapped`` has a soft shoulder and gamma 2.2, so lights and shadows keep their detail;
    ``proportional`` has neither and clips, as cameras for measuring do. Of KITTI's drive 0005 a tenth of the lower half is clipped.
    """

    name: str
    exposure_ev: float = 0.0  # stops that pictures are brighter than metered
    most_gain: float = 60.0  # the longest exposure and the strongest amplifier together
    fixed_gain: float = 0.0  # of an exposure that is not metered; 0: metered
    noise: float = 1.2
    noise_per_gain: float = 0.35
    response: Literal["tone_mapped", "proportional"] = "tone_mapped"


RGBS = {
    m.name: m
    for m in (
        RgbModel("automatic"),
        RgbModel("small", most_gain=30.0, noise=3.0, noise_per_gain=1.0),  # a phone's or webcam's sensor
        RgbModel("fixed", fixed_gain=0.8),  # set once for a clear day: night is nearly black
        RgbModel("machine", response="proportional"),  # a machine-vision camera, as KITTI's
    )
}


def exposed(
    linear: NDArray[np.float32], model: RgbModel, condition: Condition, rng: np.random.Generator, *, metering: float | None = None
) -> NDArray[np.uint8]:  # fmt: skip
    """The picture (H, W, 3) of linear light (H, W, 3); ``metering`` is the factor by which metering errs, by chance if not given."""
    mean = float(np.mean(linear[::4, ::4].min(axis=2))) + 1e-4
    metering = rng.uniform(*METERING) if metering is None else metering
    metered = min(_MEAN_LIGHT * 2.0**model.exposure_ev / mean, model.most_gain) * metering
    gain = model.fixed_gain * 2.0**model.exposure_ev or metered
    picture = to_srgb(linear, gain) if model.response == "tone_mapped" else _in_proportion(linear, gain)
    sigma = model.noise + model.noise_per_gain * min(gain, 40.0)
    picture += rng.standard_normal(linear.shape[:2], dtype=np.float32)[..., None] * np.float32(sigma)
    picture += cv2.resize(rng.standard_normal((linear.shape[0] // 2, linear.shape[1] // 2, 3), dtype=np.float32),
                          (linear.shape[1], linear.shape[0])) * np.float32(0.5 * sigma)  # fmt: skip
    if condition.streaks > 0:
        _particles(picture, condition, rng)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _in_proportion(linear: NDArray[np.float32], gain: float) -> NDArray[np.float32]:
    """Display values that are proportional to light; they clip after the noise, so that what is clipped is flat."""
    return linear * np.float32(255.0 * _PROPORTIONAL * gain)


def _particles(picture: NDArray[np.float32], condition: Condition, rng: np.random.Generator) -> None:
    """Streaks of rain or flakes of snow, drawn into the picture in place."""
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
