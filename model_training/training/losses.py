"""Contrastive losses of paired views."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

#: Positions closer than this are not used as negatives, metres.
SAME_PLACE_M = 6.0


@dataclass(frozen=True, slots=True)
class Side:
    """Descriptors of the queries or of the survey views.

    Attributes:
        descriptors: unit descriptors (N, D).
        xy: positions (N, 2), map frame, metres.
    """

    descriptors: Tensor
    xy: Tensor


def paired_info_nce(
    queries: Side, surveys: Side, *, scale: Tensor, more_queries: Side | None = None, more_surveys: Side | None = None
) -> tuple[Tensor, Tensor]:
    """Compute InfoNCE in both directions over a batch of pairs (van den Oord et al., 2018).

    Views closer than ``SAME_PLACE_M`` to each other are not used as negatives.

    Args:
        queries: B queries; row k belongs to row k of ``surveys``.
        surveys: B survey views.
        scale: inverse temperature, learned; a scalar.
        more_queries: N further negatives for the survey views, such as those of earlier batches.
        more_surveys: N further negatives for the queries.

    Returns:
        Loss of each pair (B), and whether its own survey view is the most similar one (B).
    """

    def one_way(logits: Tensor, own: Tensor) -> Tensor:
        return functional.cross_entropy(logits, own, reduction="none")

    forward, backward = _logits(queries, surveys, scale, more_surveys), _logits(surveys, queries, scale, more_queries)
    return _both_ways(forward, backward, one_way)


def hardest_triplet(
    queries: Side, surveys: Side, *, scale: Tensor, more_queries: Side | None = None, more_surveys: Side | None = None
) -> tuple[Tensor, Tensor]:
    """Compute the soft-margin triplet loss of the hardest negative in both directions (Hermans et al., 2017).

    Args:
        queries: B queries; row k belongs to row k of ``surveys``.
        surveys: B survey views.
        scale: factor of the similarities, learned; a scalar.
        more_queries: N further negatives for the survey views.
        more_surveys: N further negatives for the queries.

    Returns:
        Loss of each pair (B), and whether its own survey view is the most similar one (B).
    """

    def one_way(logits: Tensor, own: Tensor) -> Tensor:
        hardest = logits.scatter(1, own[:, None], -torch.inf).max(dim=1).values
        return functional.softplus(hardest - logits[own, own])

    forward, backward = _logits(queries, surveys, scale, more_surveys), _logits(surveys, queries, scale, more_queries)
    return _both_ways(forward, backward, one_way)


def _both_ways(forward: Tensor, backward: Tensor, one_way: Callable[[Tensor, Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """Mean of a loss in both directions, and whether the own survey view is the most similar one, for B pairs."""
    own = torch.arange(len(forward), device=forward.device)
    return 0.5 * (one_way(forward, own) + one_way(backward, own)), forward.argmax(dim=1) == own


def _logits(one: Side, other: Side, scale: Tensor, more: Side | None) -> Tensor:
    """Scaled similarities (B, B + N) of one side to the other side and to further negatives."""
    near = torch.cdist(one.xy, other.xy) < SAME_PLACE_M
    near.fill_diagonal_(False)
    similarity = one.descriptors @ other.descriptors.T
    if more is not None:
        near = torch.cat([near, torch.cdist(one.xy, more.xy) < SAME_PLACE_M], dim=1)
        similarity = torch.cat([similarity, one.descriptors @ more.descriptors.T], dim=1)
    return (similarity * scale).masked_fill(near, -1e4)
