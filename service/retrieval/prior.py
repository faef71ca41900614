"""Prior of the camera pose that a robot may send, and its weight."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

#: Standard deviations of a prior that gives none: of each coordinate, metres, and of the heading, degrees.
POSITION_STD_M, HEADING_STD_DEG = 20.0, 20.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior:
    """A position, a heading, or both, each with its standard deviation.

    Attributes:
        position_m: x and y in the map frame; None if only the heading is known.
        position_std_m: standard deviation of each coordinate.
        heading_rad: heading of the optical axis, counter-clockwise from map x, rad; None if unknown.
        heading_std_rad: standard deviation of the heading, rad.
    """

    position_m: Float64[NDArray[np.float64], "2"] | None = None
    position_std_m: float = POSITION_STD_M
    heading_rad: float | None = None
    heading_std_rad: float = float(np.deg2rad(HEADING_STD_DEG))

    def log_weight(
        self, xy: Float64[NDArray[np.float64], "n 2"], heading_rad: Float64[NDArray[np.float64], " n"]
    ) -> Float64[NDArray[np.float64], " n"]:
        """Compute the log weight of poses: 0 at the prior, near ``MOST_DOUBT`` far from it.

        The weight is the log of a Gaussian plus a constant exp(``MOST_DOUBT``), normalised to 0 at the prior. The constant limits
        the influence of a wrong prior, so that the images can overrule it.

        Args:
            xy: positions of the camera, map frame, metres.
            heading_rad: headings of the optical axis, counter-clockwise from map x, rad.
        """
        squared = np.zeros(len(xy))
        if self.position_m is not None:
            squared += ((xy - self.position_m) ** 2).sum(axis=1) / self.position_std_m**2
        if self.heading_rad is not None:
            turned = (heading_rad - self.heading_rad + np.pi) % (2 * np.pi) - np.pi
            squared += (turned / self.heading_std_rad) ** 2
        believed: Float64[NDArray[np.float64], " n"] = np.log(np.exp(-0.5 * squared) + np.exp(MOST_DOUBT))
        believed -= np.log1p(np.exp(MOST_DOUBT))
        return believed

    def known_nats(self, xy: Float64[NDArray[np.float64], "2"], heading_rad: float) -> float:
        """Compute how much the prior adds to the log odds that the query comes from the map, in nats (decision 0135).

        A prior position claims that the robot is in the map. All but one prior in about 150 are assumed to be right. So the odds
        rise by up to that factor if the answer agrees with the prior. They stay if it does not, or if only a heading is known.

        Args:
            xy: position of the answer, map frame, metres.
            heading_rad: heading of the answer's optical axis, counter-clockwise from map x, rad.
        """
        if self.position_m is None:
            return 0.0
        return max(0.0, float(self.log_weight(xy[None], np.array([heading_rad]))[0]) - MOST_DOUBT)


#: Log weight of a pose far from the prior, nats. It assumes that one prior in about 150 is entirely wrong.
MOST_DOUBT = -5.0
