"""Remember the last descriptors of a city's pairs: they give more negatives, and they find the hard ones.

A batch of a hundred pairs rarely holds the street that a query is confused with.
Descriptors drift slowly. So descriptors of recent steps serve as negatives without a forward pass
(cross-batch memory, Wang et al., CVPR 2020).
They also show which pairs of a city look alike. A batch can then be drawn from hard negatives.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model_training.training.losses import SAME_PLACE_M

_NEVER = -(10**9)


class DescriptorMemory:
    """Last descriptors of every pair of one city, indexed by the number of its query.

    Args:
        pairs: queries of the city, N.
        descriptor: length of a descriptor, D.
        device: device of the descriptors.

    Attributes:
        queries: query descriptors (N, D).
        surveys: descriptors of the paired survey views (N, D).
        queries_xy: positions of the queries (N, 2), map frame, metres.
        surveys_xy: positions of the survey views (N, 2), map frame, metres.
        step: step at which the pair was last drawn (N); very negative if never.
    """

    def __init__(self, pairs: int, descriptor: int, device: torch.device) -> None:
        self.queries = torch.zeros(pairs, descriptor, device=device)
        self.surveys = torch.zeros(pairs, descriptor, device=device)
        self.queries_xy = torch.zeros(pairs, 2, device=device)
        self.surveys_xy = torch.zeros(pairs, 2, device=device)
        self.step = torch.full((pairs,), _NEVER, dtype=torch.int64)

    def keep(
        self,
        pairs: NDArray[np.int64],
        queries: Tensor,
        surveys: Tensor,
        queries_xy: Tensor,
        surveys_xy: Tensor,
        step: int,
    ) -> None:
        """Store what a batch of pairs had at a step.

        Args:
            pairs: numbers of the queries (B).
            queries: query descriptors (B, D).
            surveys: descriptors of the survey views (B, D).
            queries_xy: positions of the queries (B, 2), map frame, metres.
            surveys_xy: positions of the survey views (B, 2), map frame, metres.
            step: number of the step.
        """
        rows = torch.from_numpy(pairs).to(self.queries.device)
        self.queries[rows], self.surveys[rows] = queries.detach(), surveys.detach()
        self.queries_xy[rows], self.surveys_xy[rows] = queries_xy, surveys_xy
        self.step[torch.from_numpy(pairs)] = step

    def recent(self, step: int, oldest: int) -> NDArray[np.int64]:
        """Return the pairs (N,) of the last steps.

        Args:
            step: number of the current step.
            oldest: greatest age of a descriptor, steps.
        """
        rows: NDArray[np.int64] = np.flatnonzero((step - self.step.numpy()) <= oldest)
        return rows

    def hard_negatives(self, seeds: NDArray[np.int64], among: NDArray[np.int64], each: int) -> NDArray[np.int64]:
        """Find hard negatives: pairs of other places whose survey views are most similar to a query.

        Args:
            seeds: numbers of the queries (S,).
            among: pairs to search (N,).
            each: pairs per seed.

        Returns:
            Numbers of the seeds and their hard negatives, sorted, without duplicates (M,).
        """
        rows = torch.from_numpy(among).to(self.queries.device)
        chosen = torch.from_numpy(seeds).to(self.queries.device)
        similarity = self.queries[chosen] @ self.surveys[rows].T
        similarity[torch.cdist(self.queries_xy[chosen], self.surveys_xy[rows]) < SAME_PLACE_M] = -2.0
        best = similarity.topk(min(each, len(among)), dim=1).indices
        found: NDArray[np.int64] = np.unique(np.concatenate([seeds, rows[best].cpu().numpy().ravel()]))
        return found

    def state(self) -> dict[str, Tensor]:
        """Return the tensors for a checkpoint."""
        return {name: getattr(self, name) for name in ("queries", "surveys", "queries_xy", "surveys_xy", "step")}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Set the tensors from a checkpoint.

        Args:
            state: result of ``state``.
        """
        for name, array in state.items():
            getattr(self, name).copy_(array)
