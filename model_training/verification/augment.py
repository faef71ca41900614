"""Errors that the training adds to comparisons: what a rig does not see, and what brightness does not show."""

import math

import torch
from jaxtyping import Float32

from service.scoring.comparison import INVERSE_DEPTH, PLANES

#: Planes that need a measurement of the query.
_OF_QUERY = tuple(
    PLANES.index(n) for n in ("measured", "inverse_depth", "difference_sigmas", "difference_ratio", "height")
)
_INVERSE, _MAPPED = PLANES.index("inverse_depth"), PLANES.index("mapped")
_BRIGHT, _MAPPED_BRIGHT = PLANES.index("brightness"), PLANES.index("mapped_brightness")
#: Share of the comparisons that get each error.
_CUT, _RANGE, _HOLES, _NO_BRIGHTNESS, _NO_MAPPED_BRIGHTNESS, _NOISE, _DROPPED = 0.4, 0.25, 0.3, 0.1, 0.2, 0.4, 0.2
#: Widths of a cut, columns; range limits, m; edge of a hole, cells, and the share of holes.
_CUT_COLUMNS, _LIMITS_M, _HOLE, _HOLE_SHARE = (4, 40), (6.0, 36.0), 8, 0.15
#: Standard deviations of the factor of each brightness and of the noise of the map's brightness; share of its pixels that vanish.
_CONTRAST, _NOISE_STD, _DROPPED_SHARE = 0.3, 0.15, 0.3


def augmented(
    planes: Float32[torch.Tensor, "n 12 64 128"], random: torch.Generator
) -> Float32[torch.Tensor, "n 12 64 128"]:
    """Return comparisons with random errors. The input is changed.

    Half are mirrored. Some lose a range of columns, all depth beyond a limit, or blocks of depth. The map's brightness gets noise, as the
    intensity of a LiDAR has it, and is missing in some.

    Args:
        planes: comparisons.
        random: random generator.
    """
    count, _, rows, columns = planes.shape

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=random)

    def some(share: float) -> torch.Tensor:
        return draw(count) < share

    mirrored = some(0.5)
    planes[mirrored] = planes[mirrored].flip(3)
    position = torch.arange(columns)
    first = draw(count) * columns
    width = _CUT_COLUMNS[0] + draw(count) * (_CUT_COLUMNS[1] - _CUT_COLUMNS[0])
    cut = (position >= first[:, None]) & (position < (first + width)[:, None]) & some(_CUT)[:, None]
    planes *= ~cut[:, None, None, :]
    # What the query lacks.
    least, most = _LIMITS_M
    limit_m = least * torch.exp(draw(count) * math.log(most / least))
    far = (planes[:, _INVERSE] < (1 / (INVERSE_DEPTH * limit_m))[:, None, None]) & some(_RANGE)[:, None, None]
    holes = draw(count, rows // _HOLE, columns // _HOLE) < _HOLE_SHARE
    holes = holes.repeat_interleave(_HOLE, 1).repeat_interleave(_HOLE, 2) & some(_HOLES)[:, None, None]
    planes[:, _OF_QUERY] *= ~(far | holes)[:, None]
    # Brightness.
    noise = _NOISE_STD * draw(count, 1, 1) * torch.randn(count, rows, columns, generator=random)
    planes[:, _MAPPED_BRIGHT] += noise * planes[:, _MAPPED] * some(_NOISE)[:, None, None]
    dropped = (draw(count, rows, columns) < _DROPPED_SHARE * draw(count, 1, 1)) & some(_DROPPED)[:, None, None]
    planes[:, _MAPPED_BRIGHT] *= ~dropped
    for plane, missing in ((_BRIGHT, _NO_BRIGHTNESS), (_MAPPED_BRIGHT, _NO_MAPPED_BRIGHTNESS)):
        contrast = 1 + _CONTRAST * torch.randn(count, 1, 1, generator=random)
        planes[:, plane] *= contrast * ~some(missing)[:, None, None]
    return planes
