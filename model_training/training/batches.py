"""Batches of pairs, all of one city; the caller may ask for some of them, so that negatives are hard."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from model_training.training.packs import Pack
from service.errors import DatasetError
from service.imaging.view_grid import ViewGrid

PAIR_REACH_M = 2.5


@dataclass(frozen=True)
class Batch:
    """Clean views of pairs: tensors (B, rows, columns), colour (B, 3, rows, columns), heights and positions (m).

    ``survey_intensity`` is 0..1; ``query_seen`` (B, rows, columns) are cells that the camera looks at, where depth comes from matching
    and has its errors already, else None.
    """

    survey_ranges: Tensor
    survey_intensity: Tensor
    survey_height_m: Tensor
    query_ranges: Tensor
    query_rgb: Tensor
    query_height_m: Tensor
    rows_seen: Tensor
    survey_xy: Tensor
    query_xy: Tensor
    pairs: NDArray[np.int64]
    query_seen: Tensor | None = None

    @property
    def images(self) -> int:
        """Branches of pairs in the batch."""
        return 2 * len(self.query_xy)


def open_cities(folders: list[Path], grid: ViewGrid, *, turn_deg: float, pairs: int) -> "list[City]":
    """Open packs, each of which must fill a batch of ``pairs`` pairs.

    Raises:
        DatasetError: a pack is damaged, or has too few queries that lie near a place.
    """
    cities = []
    for folder in folders:
        city = City(Pack.open(folder), grid, turn_deg=turn_deg)
        if len(city.usable) < pairs:
            raise DatasetError(
                f"{folder}: {len(city.usable)} of its {len(city.pack.queries)} queries lie within {PAIR_REACH_M:g} m of a place, and a "
                f"batch takes {pairs} pairs; make the city with more places or queries, or train with --pairs {len(city.usable)} or fewer",
                field="pairs",
            )  # fmt: skip
        cities.append(city)
    return cities


class City:
    """One pack with what sampling needs: which places lie near each query; views are turned by up to ``turn_deg``."""

    def __init__(self, pack: Pack, grid: ViewGrid, *, turn_deg: float) -> None:
        self.pack, self._grid, self._turn_rad = pack, grid, np.deg2rad(turn_deg)
        places = cKDTree(pack.places[:, :2])
        self._places_near = places.query_ball_point(pack.queries[:, :2], PAIR_REACH_M)
        self.usable = np.array([k for k, near in enumerate(self._places_near) if near])

    def draw(self, pairs: int, rng: np.random.Generator, wanted: NDArray[np.int64] | None = None) -> Batch:
        """Draw a batch of up to ``pairs`` pairs: ``wanted`` (queries that are usable) and others by chance."""
        pack, grid = self.pack, self._grid
        first = np.zeros(0, np.int64) if wanted is None else wanted[:pairs]
        others = rng.choice(self.usable, pairs - len(first), replace=False)
        chosen = np.unique(np.concatenate([first, others])).astype(np.int64)
        place = np.array([rng.choice(self._places_near[k]) for k in chosen])
        queries, places = pack.queries[chosen], pack.places[place]
        turn = rng.uniform(-self._turn_rad, self._turn_rad, len(chosen))
        heading = queries[:, 2] + turn - places[:, 2]
        columns = (
            np.rint((heading[:, None] + grid.azimuths_rad + np.pi) / (2 * np.pi) * grid.around).astype(int)
            % grid.around
        )

        def views(panoramas: NDArray[np.generic]) -> NDArray[np.generic]:
            return np.stack([panoramas[p][:, c] for p, c in zip(place, columns, strict=True)])

        def tensor(array: NDArray[np.generic]) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(array)).float()

        return Batch(
            tensor(views(pack.panoramas)), (tensor(views(pack.intensities)) / 255) ** 2, tensor(places[:, 3]),
            tensor(pack.ranges[chosen]), tensor(pack.rgb[chosen].transpose(0, 3, 1, 2)), tensor(queries[:, 3]),
            torch.from_numpy(np.array(pack.rows_seen)), tensor(places[:, :2]), tensor(queries[:, :2]), chosen,
            None if pack.seen is None else torch.from_numpy(np.ascontiguousarray(pack.seen[chosen])),
        )  # fmt: skip
