"""What a city's pairs looked like when they were last drawn: more negatives than a batch holds, and the hard ones among them.

A batch of a hundred pairs rarely holds the street that a query is mistaken for. Descriptors drift slowly, so those of the
last steps serve as negatives that cost no forward pass (cross-batch memory, Wang et al., CVPR 2020), and they tell which
pairs of a city are alike, so that a batch can be drawn from look-alikes.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model_training.training.losses import SAME_PLACE_M

_NEVER = -(10**9)


class DescriptorMemory:
    """Last descriptors of every pair of one city, by the number of its query."""

    def __init__(self, pairs: int, descriptor: int, device: torch.device) -> None:
        self.queries = torch.zeros(pairs, descriptor, device=device)
        self.surveys = torch.zeros(pairs, descriptor, device=device)
        self.queries_xy = torch.zeros(pairs, 2, device=device)
        self.surveys_xy = torch.zeros(pairs, 2, device=device)
        self.step = torch.full((pairs,), _NEVER, dtype=torch.int64)

    def keep(
        self, pairs: NDArray[np.int64], queries: Tensor, surveys: Tensor, queries_xy: Tensor, surveys_xy: Tensor, step: int
    ) -> None:  # fmt: skip
        """Remember the descriptors (B, D) and positions (B, 2) that ``pairs`` (B) had at a step."""
        rows = torch.from_numpy(pairs).to(self.queries.device)
        self.queries[rows], self.surveys[rows] = queries.detach(), surveys.detach()
        self.queries_xy[rows], self.surveys_xy[rows] = queries_xy, surveys_xy
        self.step[torch.from_numpy(pairs)] = step

    def recent(self, step: int, oldest: int) -> NDArray[np.int64]:
        """Pairs (N) seen in the last ``oldest`` steps."""
        rows: NDArray[np.int64] = np.flatnonzero((step - self.step.numpy()) <= oldest)
        return rows

    def alike(self, seeds: NDArray[np.int64], among: NDArray[np.int64], each: int) -> NDArray[np.int64]:
        """For each seed the ``each`` pairs of other places whose survey views are most like its query; seeds included."""
        rows = torch.from_numpy(among).to(self.queries.device)
        chosen = torch.from_numpy(seeds).to(self.queries.device)
        likeness = self.queries[chosen] @ self.surveys[rows].T
        likeness[torch.cdist(self.queries_xy[chosen], self.surveys_xy[rows]) < SAME_PLACE_M] = -2.0
        best = likeness.topk(min(each, len(among)), dim=1).indices
        found: NDArray[np.int64] = np.unique(np.concatenate([seeds, rows[best].cpu().numpy().ravel()]))
        return found

    def state(self) -> dict[str, Tensor]:
        """Arrays for a checkpoint."""
        return {name: getattr(self, name) for name in ("queries", "surveys", "queries_xy", "surveys_xy", "step")}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take back what ``state`` gave."""
        for name, array in state.items():
            getattr(self, name).copy_(array)
