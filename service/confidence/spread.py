"""Mean and covariance over all places where the camera may be, for an answer that is not LOCALIZED."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import Transform, heading_of_camera

#: Lower limit of the spacing of places. Maps of single frames have a spacing of 0.
LEAST_SPACING_M = 1.0
#: Standard deviation of an unknown heading: that of a uniform distribution over the circle.
UNKNOWN_HEADING_RAD = float(np.pi / np.sqrt(3.0))


@dataclass(frozen=True, slots=True, eq=False)
class Extent:
    """The area of a map, as mean and covariance of a position in it.

    Attributes:
        mean_m: mean position of the places, map frame, metres.
        covariance: covariance of a position drawn from the places, map axes, m^2.
    """

    mean_m: Float64[NDArray[np.float64], "3"]
    covariance: Float64[NDArray[np.float64], "3 3"]

    @classmethod
    def of_places(cls, places_m: Float64[NDArray[np.float64], "P 3"], spacing_m: float) -> "Extent":
        """Compute the extent of a set of places.

        Args:
            places_m: positions of the places, map frame, metres.
            spacing_m: distance between adjacent places, metres. A place stands for its surroundings. So the covariance gets
                this standard deviation, at least ``LEAST_SPACING_M``, in addition.
        """
        mean_m = places_m.mean(axis=0)
        apart = places_m - mean_m
        return cls(mean_m, apart.T @ apart / len(places_m) + np.eye(3) * max(spacing_m, LEAST_SPACING_M) ** 2)


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """Mean and covariance of the position over all places where the camera may be.

    The mean is not a pose. The camera is usually somewhere else, for example if the mean lies between two streets.

    Attributes:
        mean_m: mean position, map frame, metres.
        covariance: covariance of the position, map axes, m^2.
        heading_std_rad: circular standard deviation of the heading; at most ``UNKNOWN_HEADING_RAD``.
        hypotheses_weight: probability that one of the hypotheses is right, 0 to 1.
    """

    mean_m: Float64[NDArray[np.float64], "3"]
    covariance: Float64[NDArray[np.float64], "3 3"]
    heading_std_rad: float
    hypotheses_weight: float


def spread_of(
    poses: Sequence[Transform],
    covariances: Sequence[Float64[NDArray[np.float64], "6 6"]],
    shares: Float64[NDArray[np.float64], " H"],
    *,
    confidence: float,
    extent: Extent,
) -> Spread:
    """Compute mean and covariance of a mixture of all hypotheses and the whole map.

    The confidence is the probability that the first hypothesis is right. The others are right in proportion to their shares. The rest
    of the probability belongs to the map. So a single hypothesis with low confidence gives a covariance as large as the map,
    even if its own standard deviation is 0.1 m. The covariance follows from the law of total covariance: the mean of the components'
    covariances plus the covariance of their means.

    Args:
        poses: T_map_camera of each hypothesis, the best supported first; may be empty.
        covariances: covariance of each pose: translation (m), then rotation (rad), in map axes.
        shares: share of each hypothesis in the support; they sum to 1.
        confidence: probability that the first hypothesis is right, 0 to 1.
        extent: extent of the map.
    """
    weight = min(1.0, confidence / float(shares[0])) if len(poses) else 0.0
    weights = np.append(weight * shares[: len(poses)], 1.0 - weight)
    means = np.array([*(T[:3, 3] for T in poses), extent.mean_m])
    within = np.array([*(each[:3, :3] for each in covariances), extent.covariance])
    mean_m = weights @ means
    apart = means - mean_m
    covariance = np.einsum("k,kij->ij", weights, within) + np.einsum("k,ki,kj->ij", weights, apart, apart)
    headings = np.array([heading_of_camera(T) for T in poses])
    variances = np.array([each[5, 5] for each in covariances])
    # The map component has a uniform heading, so it adds nothing to the resultant.
    resultant = abs(np.sum(weights[:-1] * np.exp(1j * headings - 0.5 * variances)))
    heading_std_rad = UNKNOWN_HEADING_RAD
    if resultant > 0.0:
        heading_std_rad = min(heading_std_rad, float(np.sqrt(-2.0 * np.log(min(resultant, 1.0)))))
    return Spread(mean_m, 0.5 * (covariance + covariance.T), heading_std_rad, weight)
