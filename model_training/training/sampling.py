"""Augmented batches for other purposes than a training step."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from model_training.training.augment import Augmenter
from model_training.training.batches import open_cities
from model_training.training.loop import TrainingConfig, views_of
from service.imaging.view_grid import ViewGrid


def augmented_batches(packs: list[Path], config: TrainingConfig, *, seed: int) -> Iterator[tuple[Tensor, int]]:
    """Yield augmented batches of random cities without end.

    Args:
        packs: folders of the training cities.
        config: augmentation, pairs per batch and grid size.
        seed: seed of all random numbers.

    Yields:
        Planes (B, 6, rows, columns), and the number of query views. The query views come first.
    """
    grid = ViewGrid(rows=config.encoder.rows, columns=config.encoder.columns)
    rng, place = np.random.default_rng(seed), torch.device("cpu")
    augment = Augmenter(config.augmentation, grid, torch.Generator().manual_seed(seed), place)
    cities = open_cities(packs, grid, turn_deg=config.turn_deg, pairs=config.pairs)
    while True:
        batch = cities[int(rng.integers(len(cities)))].draw(config.pairs, rng)
        yield views_of(batch, augment, place, blind=config.blind), len(batch.query_xy)
