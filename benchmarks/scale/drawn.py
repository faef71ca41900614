"""Maps of any size from the real descriptors of a few small cities.

A drawn view mixes two real views: ``mean + sqrt(1/2) (x - mean) + sqrt(1/2) (y - mean)``. The mean and the covariance of all views stay.
A *copy* of the cities joins each place with the place some distance further along the survey, at another heading. So neighbouring
places and headings of a drawn map are as similar as those of a real one, and two copies share at most one of their two streets.

A query at a drawn place mixes a real query of ``x`` with the map view ``y``, to which it adds the difference between another real query
and its own view. So it has the noise of two views of one place: the errors of depth and colour, the offset from the survey's lane, other
parked vehicles, and the difference between camera and LiDAR.
"""

from dataclasses import dataclass
from math import gcd

import numpy as np
from jaxtyping import Float32, Int8, Int64
from numpy.typing import NDArray

from benchmarks.scale.sources import HEADINGS, RealDescriptors

#: Least distance between two copies along the survey, places; a place and the eighth further one are hardly more similar than strangers.
APART = 8
#: Headings between two copies of the same distance: 60 degrees.
TURN = 4
_HALF = np.float32(np.sqrt(0.5))


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """Queries in a drawn map.

    Attributes:
        descriptors: descriptors at the turns of each query.
        true_view: view of the place and heading of each query.
    """

    descriptors: Float32[NDArray[np.float32], "Q T D"]
    true_view: Int64[NDArray[np.int64], " Q"]


class DrawnViews:
    """The 8-bit descriptors of a drawn map. It behaves like the array of ``descriptors.npy``, but computes what is read.

    Args:
        real: real descriptors.
        views: number of views.

    Raises:
        ValueError: the real descriptors give no map of this size.
    """

    def __init__(self, real: RealDescriptors, views: int) -> None:
        self._real, self._views = real, views
        self._mean = real.views.mean(axis=0)
        self._part = (real.views - self._mean) * _HALF
        self._places = len(real.views) // HEADINGS
        distances, turns = range(APART, self._places // 2, APART), HEADINGS // TURN
        self._copies = len(distances) * turns
        if views > self._copies * len(real.views):
            raise ValueError(
                f"{views} views: {len(real.views)} real descriptors give at most {self._copies * len(real.views)}"
            )

    def __len__(self) -> int:
        return self._views

    @property
    def shape(self) -> tuple[int, int]:
        """Number of views, and number of components."""
        return self._views, self._part.shape[1]

    def __getitem__(self, views: slice | Int64[NDArray[np.int64], " n"]) -> Int8[NDArray[np.int8], "n D"]:
        """Compute the descriptors of some views.

        Args:
            views: their numbers.
        """
        numbers = np.arange(*views.indices(self._views)) if isinstance(views, slice) else np.asarray(views)
        one, other = self._parts_of(numbers)
        mixed = self._part[one] + self._part[other]
        mixed += self._mean
        mixed *= 127 / np.abs(mixed).max(axis=1, keepdims=True)
        rounded: NDArray[np.int8] = np.rint(mixed, out=mixed).astype(np.int8)
        return rounded

    def _parts_of(self, numbers: Int64[NDArray[np.int64], " n"]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the two real views of some drawn views."""
        copy, one = np.divmod(numbers, len(self._part))
        # A step without a common factor visits every copy once, in an order without pattern.
        copy = copy * _step(self._copies) % self._copies
        distance, turn = np.divmod(copy, HEADINGS // TURN)
        place, heading = np.divmod(one, HEADINGS)
        place = (place + APART * (distance + 1)) % self._places
        return one, place * HEADINGS + (heading + TURN * turn) % HEADINGS

    def queries(self, count: int, seed: int = 0) -> Asked:
        """Draw queries.

        Args:
            count: number of queries.
            seed: seed of the choice.
        """
        rng, real = np.random.default_rng(seed), self._real
        copies = -(-self._views // len(self._part))
        drawn: list[tuple[int, int]] = []
        while len(drawn) < count:
            asked = int(rng.integers(len(real.queries)))
            view = int(rng.integers(copies)) * len(self._part) + int(real.true_view[asked])
            if view < self._views:
                drawn.append((asked, view))
        first, true_view = (np.array(column) for column in zip(*drawn, strict=True))
        noise = rng.permutation(np.resize(np.arange(len(real.queries)), count))
        _, other = self._parts_of(true_view)
        differs = real.queries[noise] - real.views[real.true_view[noise]][:, None]
        mixed = self._mean + _HALF * (real.queries[first] - self._mean)
        mixed += (self._part[other])[:, None] + _HALF * differs
        return Asked(mixed / np.linalg.norm(mixed, axis=2, keepdims=True), true_view)


def _step(copies: int) -> int:
    """Return the first number from 0.618 times the copies that has no common factor with their number."""
    step = max(1, round(0.618 * copies))
    while gcd(step, copies) > 1:
        step += 1
    return step
