"""The contrastive loss of paired views."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

SAME_PLACE_M = 6.0


@dataclass(frozen=True, slots=True)
class Side:
    """Unit descriptors (N, D) of one side and where they were taken (N, 2), metres."""

    descriptors: Tensor
    xy: Tensor


def paired_info_nce(
    queries: Side, surveys: Side, *, scale: Tensor, more_queries: Side | None = None, more_surveys: Side | None = None
) -> tuple[Tensor, Tensor]:
    """InfoNCE both ways over a batch of pairs (van den Oord et al., 2018), places too near to be told apart left out.

    Args:
        queries: row k belongs to row k of ``surveys`` (B).
        surveys: (B).
        scale: inverse temperature, learned.
        more_queries: further negatives for the surveys, such as those of earlier batches.
        more_surveys: further negatives for the queries.

    Returns:
        Loss of each pair (B) and whether its own survey view came first (B).
    """
    forward = _logits(queries, surveys, scale, more_surveys)
    backward = _logits(surveys, queries, scale, more_queries)
    own = torch.arange(len(queries.descriptors), device=queries.descriptors.device)
    loss = 0.5 * (
        functional.cross_entropy(forward, own, reduction="none")
        + functional.cross_entropy(backward, own, reduction="none")
    )
    return loss, forward.argmax(dim=1) == own


def hardest_triplet(
    queries: Side, surveys: Side, *, scale: Tensor, more_queries: Side | None = None, more_surveys: Side | None = None
) -> tuple[Tensor, Tensor]:
    """The soft-margin triplet loss of each pair's hardest negative, both ways (Hermans et al., 2017), instead of all of them.

    Arguments and result as ``paired_info_nce`` has them.
    """
    forward = _logits(queries, surveys, scale, more_surveys)
    backward = _logits(surveys, queries, scale, more_queries)
    own = torch.arange(len(queries.descriptors), device=queries.descriptors.device)

    def one_way(logits: Tensor) -> Tensor:
        hardest = logits.scatter(1, own[:, None], -torch.inf).max(dim=1).values
        return functional.softplus(hardest - logits[own, own])

    return 0.5 * (one_way(forward) + one_way(backward)), forward.argmax(dim=1) == own


def _logits(asked: Side, answers: Side, scale: Tensor, more: Side | None) -> Tensor:
    """Scaled similarities (B, B + N) of what is asked to its answers and to further negatives."""
    near = torch.cdist(asked.xy, answers.xy) < SAME_PLACE_M
    near.fill_diagonal_(False)
    similarity = asked.descriptors @ answers.descriptors.T
    if more is not None:
        near = torch.cat([near, torch.cdist(asked.xy, more.xy) < SAME_PLACE_M], dim=1)
        similarity = torch.cat([similarity, asked.descriptors @ more.descriptors.T], dim=1)
    return (similarity * scale).masked_fill(near, -1e4)
