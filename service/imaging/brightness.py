"""Brightness of a cell relative to its view: a cue that LiDAR intensity and image grey level share.

The two have no common scale. Exposure, gamma and the calibration of the sensor differ. So the logarithm is normalised: its mean
is subtracted, and the result is divided by its standard deviation. Both are taken over the cells with a range. The result does
not change if a gain or a gamma changes (decision 0023).
"""

import numpy as np
from jaxtyping import Bool, Float32
from numpy.typing import NDArray

#: Offset under the logarithm, as a share of the mean. All values well below it count as equally black.
FLOOR = 0.03
#: Smallest standard deviation of the logarithm. A flatter view carries no information, e.g. from a sensor without intensity.
LEAST_SPREAD = 0.05
#: Largest absolute brightness, standard deviations.
LIMIT = 3.0


def brightness(
    values: Float32[NDArray[np.float32], "rows columns"],
    *,
    measured: Bool[NDArray[np.bool_], "rows columns"],
    seen: Bool[NDArray[np.bool_], "rows columns"],
) -> Float32[NDArray[np.float32], "rows columns"]:
    """Normalise the brightness of a view to standard deviations from its mean.

    Args:
        values: intensity of LiDAR returns, or of an image (paper, eq. 9). Not negative, any scale.
        measured: cells with a range. Mean and standard deviation are taken over these cells.
        seen: cells whose value is valid. The sky of an image has a brightness and no range.

    Returns:
        Brightness in standard deviations, clipped to +-3. It is 0 outside ``seen``. It is 0 everywhere if the measured cells
        have no positive mean, or if their logarithm varies less than ``LEAST_SPREAD``.
    """
    of_measured = values[measured]
    mean = float(of_measured.mean()) if of_measured.size else 0.0
    if not mean > 0:
        return np.zeros_like(values)
    logarithm = np.log(values / np.float32(mean) + np.float32(FLOOR))
    middle, spread = float(logarithm[measured].mean()), float(logarithm[measured].std())
    if spread < LEAST_SPREAD:
        return np.zeros_like(values)
    scaled = np.clip((logarithm - np.float32(middle)) / np.float32(spread), -LIMIT, LIMIT)
    result: Float32[NDArray[np.float32], "rows columns"] = np.where(seen, scaled, np.float32(0))
    return result
