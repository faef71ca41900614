"""The learning rate over a budget of processor time."""

import math

import torch

WARM_UP = 0.02  # of the budget
LEAST = 0.01  # of the rate, at the budget's end


def cosine(rate: float, share_spent: float) -> float:
    """Rise over the first fiftieth of the budget, then half a cosine down to a hundredth of ``rate``."""
    if share_spent < WARM_UP:
        return rate * max(share_spent / WARM_UP, LEAST)
    done = (share_spent - WARM_UP) / (1.0 - WARM_UP)
    return rate * (LEAST + (1.0 - LEAST) * 0.5 * (1.0 + math.cos(math.pi * done)))


def set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Give all groups the rate, a group's ``times`` over where it has such a factor."""
    for group in optimiser.param_groups:
        group["lr"] = rate * group.get("times", 1.0)
