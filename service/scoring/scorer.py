"""The interface of a scorer. Each scorer rates registered poses by one quantity and has a file of its own in this package."""

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.registration.register import Registered


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """The scores of some poses by one scorer.

    Attributes:
        values: score of each pose. The support weighs it.
        details: further numbers of each pose, by name. Confidence features may read them; the support does not.
    """

    values: Float64[NDArray[np.float64], " n"]
    details: dict[str, Float64[NDArray[np.float64], " n"]] = field(default_factory=dict)


@runtime_checkable
class Scorer(Protocol):
    """Rates poses of one query. A scorer holds the query and the map, so poses are its only input.

    Attributes:
        name: name of the score in ``Candidate.scores``.
    """

    name: str

    def score(self, poses: tuple[Registered, ...]) -> Scores:
        """Score poses.

        Args:
            poses: one or more registered poses of the reference's level frame.

        Returns:
            One score per pose, in their order.
        """
        ...
