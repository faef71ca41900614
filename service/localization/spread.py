"""Where a query may have been taken, as mean and covariance, while no single pose is confirmed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import Transform, heading_of_camera

#: Maps of single frames say 0.
LEAST_SPACING_M = 1.0
#: Standard deviation of a heading of which nothing is known: uniform on the circle.
UNKNOWN_HEADING_RAD = float(np.pi / np.sqrt(3.0))


@dataclass(frozen=True, slots=True, eq=False)
class Extent:
    """The area of a map, as mean and covariance of a position in it.

    Attributes:
        mean_m: middle of the places, map frame, metres.
        covariance: of a position drawn from the places, m^2.
    """

    mean_m: Float64[NDArray[np.float64], "3"]
    covariance: Float64[NDArray[np.float64], "3 3"]

    @classmethod
    def of_places(cls, places_m: Float64[NDArray[np.float64], "P 3"], spacing_m: float) -> "Extent":
        """The extent of some places.

        Args:
            places_m: positions, map frame, metres.
            spacing_m: between places; a place stands for its surroundings, so this much, at least ``LEAST_SPACING_M``, is added
                as a standard deviation.
        """
        mean_m = places_m.mean(axis=0)
        apart = places_m - mean_m
        return cls(mean_m, apart.T @ apart / len(places_m) + np.eye(3) * max(spacing_m, LEAST_SPACING_M) ** 2)


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """Mean and covariance of the position over all places where the camera may be.

    The mean is usually a place where the camera is not: between two streets, for example. It is not a pose.

    Attributes:
        mean_m: map frame, metres.
        covariance: of the position, map axes, m^2.
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
    """Mean and covariance of a mixture: every hypothesis, and the whole map in case none of them is right.

    The confidence is the probability that the first hypothesis is right. The others are right in proportion to their shares. What is
    left of the probability is spread over the map. So one wrong hypothesis of 0.1 m gives a covariance of the size of the map.
    The covariance follows from the law of total covariance: the mean of the parts' covariances plus the covariance of their means.

    Args:
        poses: T_map_camera of each hypothesis, the first is the best supported; may be empty.
        covariances: of each, translation first, map axes.
        shares: of each, of the support of all; they sum to 1.
        confidence: probability that the first hypothesis is right, 0 to 1.
        extent: of the map.
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
    # The map's part has no preferred heading, so it adds nothing to the resultant.
    resultant = abs(np.sum(weights[:-1] * np.exp(1j * headings - 0.5 * variances)))
    heading_std_rad = UNKNOWN_HEADING_RAD
    if resultant > 0.0:
        heading_std_rad = min(heading_std_rad, float(np.sqrt(-2.0 * np.log(min(resultant, 1.0)))))
    return Spread(mean_m, 0.5 * (covariance + covariance.T), heading_std_rad, weight)
