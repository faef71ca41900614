"""What a robot knows beforehand of where it is, and how much it is believed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior:
    """A position, a heading, or both, each with its standard deviation.

    Attributes:
        position_m: x, y in the map frame; None where only the heading is known.
        position_std_m: of each coordinate.
        heading_rad: of the optical axis, counter-clockwise from map x; None where it is not known.
        heading_std_rad: of the same.
    """

    position_m: Float64[NDArray[np.float64], "2"] | None = None
    position_std_m: float = 20.0
    heading_rad: float | None = None
    heading_std_rad: float = float(np.deg2rad(20.0))

    def log_weight(
        self, xy: Float64[NDArray[np.float64], "n 2"], heading_rad: Float64[NDArray[np.float64], " n"]
    ) -> Float64[NDArray[np.float64], " n"]:
        """Logarithm of how well poses fit, 0 at best.

        It stays near ``MOST_DOUBT`` however far off a pose is: a prior may be wrong, and then the pictures must be able to say so.
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
        """What the prior adds to the log odds that the query was taken in the map, where the answer is a pose.

        A position in the map, right in all but one case of some 150, makes a stranger so much rarer. It counts as far as the answer
        agrees with it; a heading alone says nothing of where the robot is.
        """
        if self.position_m is None:
            return 0.0
        return max(0.0, float(self.log_weight(xy[None], np.array([heading_rad]))[0]) - MOST_DOUBT)


#: One prior in some 150 is taken to be wrong altogether.
MOST_DOUBT = -5.0
