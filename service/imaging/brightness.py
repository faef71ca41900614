"""How bright a cell is against the rest of its view: the one cue that a LiDAR's return and a picture's grey both have.

Neither has a scale that the other knows: exposure, gamma, the sensor's own calibration. So both are told in spreads about the
mean of the logarithm, over the cells that have a range, which takes out any factor and any power.
"""

import numpy as np
from jaxtyping import Bool, Float32
from numpy.typing import NDArray

FLOOR = 0.03  # of the mean: darker than this is black, whatever it is
LEAST_SPREAD = 0.05  # of the logarithm: a view flatter than this tells nothing (a sensor without intensity)
LIMIT = 3.0


def brightness(
    values: Float32[NDArray[np.float32], "rows columns"],
    *,
    measured: Bool[NDArray[np.bool_], "rows columns"],
    seen: Bool[NDArray[np.bool_], "rows columns"],
) -> Float32[NDArray[np.float32], "rows columns"]:
    """Brightness of a view in spreads about its mean, within +-3; 0 outside ``seen``, and everywhere if there is none.

    Args:
        values: intensity of a LiDAR's returns, or of a picture (paper, eq. 9); not negative, of any scale.
        measured: cells with a range; mean and spread are taken over these.
        seen: cells whose value means something; a picture's sky has brightness and no range.
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
