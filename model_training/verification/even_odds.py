"""A verifier without a network, for the localizer that makes the examples of a training."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from service.scoring.comparison import Comparison


class EvenOdds:
    """A verifier that holds every pose for as likely right as wrong: log odds of 0.

    So it changes no candidate's support. The examples of a training then depend on no earlier verifier.
    """

    def log_odds(self, comparisons: Sequence[Comparison]) -> Float32[NDArray[np.float32], " n"]:
        """Return 0 for each comparison.

        Args:
            comparisons: comparisons of poses.
        """
        return np.zeros(len(comparisons), np.float32)
