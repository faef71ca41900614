"""What a query has found before its answer is built."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.confidence.decision import Decision
from service.retrieval.retrieve import Retrieved
from service.scoring.candidates import Refined


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What a query has found before its answer is built.

    Attributes:
        retrieved: places, clusters and street vote of the reference.
        refined: registered candidates; None if nothing was registered.
        evidence: confidence features; None without ``refined``.
        decision: status and confidence; None if the query asked for no registration, or the map has no cloud or no calibration.
    """

    retrieved: Retrieved
    refined: Refined | None
    evidence: Float64[NDArray[np.float64], " F"] | None
    decision: Decision | None
