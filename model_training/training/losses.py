"""The contrastive loss of paired views."""

import torch
from torch import Tensor
from torch.nn import functional


def paired_info_nce(
    queries: Tensor,
    surveys: Tensor,
    positions_q: Tensor,
    positions_s: Tensor,
    *,
    scale: Tensor,
    same_place_m: float = 6.0,
) -> tuple[Tensor, Tensor]:
    """InfoNCE both ways over a batch of pairs (van den Oord et al., 2018), places too near to be told apart left out.

    Args:
        queries: unit descriptors (B, D); row k belongs to row k of ``surveys``.
        surveys: unit descriptors (B, D).
        positions_q: metres (B, 2).
        positions_s: metres (B, 2).
        scale: inverse temperature, learned.
        same_place_m: pairs of different rows nearer than this are neither positive nor negative.

    Returns:
        Loss of each pair (B) and whether its own survey view came first (B).
    """
    similarity = queries @ surveys.T
    logits = similarity * scale
    near = torch.cdist(positions_q, positions_s) < same_place_m
    near.fill_diagonal_(False)
    logits = logits.masked_fill(near, -1e4)
    own = torch.arange(len(queries), device=queries.device)
    loss = 0.5 * (
        functional.cross_entropy(logits, own, reduction="none")
        + functional.cross_entropy(logits.T, own, reduction="none")
    )
    return loss, logits.argmax(dim=1) == own
