"""Find depth whose unit is probably wrong, for error messages. No value is changed."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Range of the median depth of street images, metres.
USUAL_M = (0.3, 60.0)
#: Metres per millimetre: the factor of millimetres that were taken for metres.
MILLIMETRE_FACTOR = 0.001
#: Factors that are tried. The second is that of metres that were taken for millimetres.
FACTORS = (MILLIMETRE_FACTOR, 1000.0)
#: Depth with at least this share of its measurements in ``USUAL_M`` has the right unit.
USUAL_SHARE = 0.01


def unit_factor(depth_m: NDArray[Any]) -> float | None:
    """Return the factor that turns implausible depth into plausible depth; None if there is none, or nothing was measured.

    Depth is implausible if fewer than ``USUAL_SHARE`` of its measurements lie in ``USUAL_M``. A factor fits if the median then
    lies in ``USUAL_M``.

    Args:
        depth_m: depth as decoded (h, w), metres. 0, negative, NaN and infinite values mean "not measured".
    """
    measured = _measured(depth_m)
    least_m, most_m = USUAL_M
    if not len(measured) or np.mean((measured >= least_m) & (measured <= most_m)) >= USUAL_SHARE:
        return None
    median_m = float(np.median(measured))
    return next((factor for factor in FACTORS if least_m <= factor * median_m <= most_m), None)


def unit_hint(depth_m: NDArray[Any]) -> str | None:
    """Return what a request's depth looks like, and which ``depth.scale_m`` to send; None if its unit seems right.

    Args:
        depth_m: depth image (H, W), metres, as in ``unit_factor``.
    """
    factor = unit_factor(depth_m)
    if factor is None:
        return None
    median_m = float(np.median(_measured(depth_m)))
    unit, scale_m = ("millimetres", "0.001") if factor < 1 else ("metres that were read as millimetres", "1")
    return (
        f"the median depth is {median_m:.4g} m, which looks like {unit}; send depth.scale_m = {scale_m}, "
        f"or multiply the scale that you sent by {factor:g} (for disparity, divide it by {factor:g})"
    )


def _measured(depth_m: NDArray[Any]) -> NDArray[Any]:
    measured: NDArray[Any] = depth_m[np.isfinite(depth_m) & (depth_m > 0)]
    return measured
