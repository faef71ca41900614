"""Draw batches of pairs of one city. The caller may choose some pairs, to get hard negatives.

A GPU holds whole packs in its memory and cuts the views out itself. Otherwise it waits for the CPU most of the time (decision 0167).
"""

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

_CPU = torch.device("cpu")
#: Greatest distance of a query from the place that it is paired with, metres.
PAIR_REACH_M = 2.5


@dataclass(frozen=True)
class Batch:
    """Clean views of B pairs. Views and heights are on the device of the city.

    Attributes:
        survey_ranges: (B, rows, columns), metres.
        survey_intensity: (B, rows, columns), 0..1.
        survey_height_m: LiDAR height above the ground (B), metres.
        query_ranges: (B, rows, columns), metres.
        query_rgb: sRGB (B, 3, rows, columns), 0..255.
        query_height_m: camera height above the ground (B), metres.
        rows_seen: rows that the LiDAR covers (rows).
        survey_xy: position of the places (B, 2), map frame, metres.
        query_xy: position of the queries (B, 2), map frame, metres.
        pairs: number of each query in its pack (B).
        query_seen: cells that the camera looks at (B, rows, columns), if depth comes from stereo matching and already has
            errors; otherwise None.
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
        """Number of views in the batch: two per pair."""
        return 2 * len(self.query_xy)


@dataclass(frozen=True)
class Choice:
    """Chosen pairs of a batch, B, before their views are read.

    Attributes:
        pairs: number of each query in its pack (B), sorted.
        place: number of the paired place in its pack (B).
        turn_rad: rotation between the query and its map view (B), radians.
        queries: poses of the queries (B, 4), as in ``Pack``.
        places: poses of the places (B, 4), as in ``Pack``.
    """

    pairs: NDArray[np.int64]
    place: NDArray[np.int64]
    turn_rad: NDArray[np.float64]
    queries: NDArray[np.float64]
    places: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, part: slice) -> "Choice":
        return Choice(self.pairs[part], self.place[part], self.turn_rad[part], self.queries[part], self.places[part])

    @property
    def query_xy(self) -> Tensor:
        """Position of the queries (B, 2), map frame, metres."""
        return _tensor(self.queries[:, :2])

    @property
    def survey_xy(self) -> Tensor:
        """Position of the places (B, 2), map frame, metres."""
        return _tensor(self.places[:, :2])


def open_cities(
    folders: list[Path], grid: ViewGrid, *, turn_deg: float, pairs: int, device: torch.device = _CPU
) -> "list[City]":
    """Open packs. Each pack must fill a batch.

    Args:
        folders: the packs.
        grid: the view grid.
        turn_deg: greatest rotation between a query and its map view, degrees.
        pairs: pairs per batch.
        device: device that holds the packs. On a CPU they stay in their files.

    Raises:
        DatasetError: a pack is damaged, has too few queries near a place, or does not fit into the memory of the device.
    """
    cities: list[City] = []
    for folder in folders:
        try:
            city = City(Pack.open(folder), grid, turn_deg=turn_deg, device=device)
        except torch.OutOfMemoryError as error:
            raise DatasetError(
                f"device: the memory of {device} is full after {len(cities)} of {len(folders)} cities; train with fewer --cities, or with "
                "--device cpu",
                field="device",
            ) from error
        if len(city.usable) < pairs:
            raise DatasetError(
                f"{folder}: {len(city.usable)} of its {len(city.pack.queries)} queries lie within {PAIR_REACH_M:g} m "
                f"of a place, but a batch needs {pairs} pairs; create the city with more places or queries, or train "
                f"with --pairs {len(city.usable)} or fewer",
                field="pairs",
            )
        cities.append(city)
    return cities


class City:
    """One pack, with the places near each query.

    Args:
        pack: the city's views.
        grid: the view grid.
        turn_deg: greatest rotation between a query and its map view, degrees.
        device: device that holds the views.
    """

    def __init__(self, pack: Pack, grid: ViewGrid, *, turn_deg: float, device: torch.device = _CPU) -> None:
        self.pack, self._grid, self._turn_rad, self._device = pack, grid, np.deg2rad(turn_deg), device
        self._panoramas, self._intensities, self._ranges, self._rgb, self._rows_seen = (
            torch.from_numpy(array).to(device)
            for array in (pack.panoramas, pack.intensities, pack.ranges, pack.rgb, pack.rows_seen)
        )
        self._seen = None if pack.seen is None else torch.from_numpy(pack.seen).to(device)
        places = cKDTree(pack.places[:, :2])
        self._places_near = places.query_ball_point(pack.queries[:, :2], PAIR_REACH_M)
        self.usable = np.array([k for k, near in enumerate(self._places_near) if near])

    def draw(self, pairs: int, rng: np.random.Generator, wanted: NDArray[np.int64] | None = None) -> Batch:
        """Draw a batch of up to ``pairs`` pairs and read its views.

        Args:
            pairs: greatest number of pairs; a pair that is chosen twice counts once.
            rng: source of random numbers.
            wanted: numbers of usable queries that the batch must hold (N,); the rest is random.
        """
        return self.read(self.choose(pairs, rng, wanted))

    def choose(self, pairs: int, rng: np.random.Generator, wanted: NDArray[np.int64] | None = None) -> Choice:
        """Choose the pairs of a batch without reading their views.

        Args:
            pairs: greatest number of pairs; a pair that is chosen twice counts once.
            rng: source of random numbers.
            wanted: numbers of usable queries that the batch must hold (N,); the rest is random.
        """
        first = np.zeros(0, np.int64) if wanted is None else wanted[:pairs]
        others = rng.choice(self.usable, pairs - len(first), replace=False)
        chosen = np.unique(np.concatenate([first, others])).astype(np.int64)
        place = np.array([rng.choice(self._places_near[k]) for k in chosen], np.int64)
        turn = rng.uniform(-self._turn_rad, self._turn_rad, len(chosen))
        return Choice(chosen, place, turn, self.pack.queries[chosen], self.pack.places[place])

    def read(self, choice: Choice) -> Batch:
        """Read the views of chosen pairs.

        Args:
            choice: B pairs of this city.
        """
        grid, queries, places = self._grid, choice.queries, choice.places
        heading = queries[:, 2] + choice.turn_rad - places[:, 2]
        turned = np.rint((heading[:, None] + grid.azimuths_rad + np.pi) / (2 * np.pi) * grid.around)
        columns = self._on_device(turned.astype(np.int64) % grid.around)[:, None, :]
        pairs, place = self._on_device(choice.pairs), self._on_device(choice.place)[:, None, None]
        rows = torch.arange(grid.rows, device=self._device)[None, :, None]
        return Batch(
            self._panoramas[place, rows, columns].float(),
            (self._intensities[place, rows, columns].float() / 255) ** 2,
            self._on_device(places[:, 3]).float(),
            self._ranges[pairs].float(),
            self._rgb[pairs].permute(0, 3, 1, 2).float().contiguous(),
            self._on_device(queries[:, 3]).float(),
            self._rows_seen,
            choice.survey_xy,
            choice.query_xy,
            choice.pairs,
            None if self._seen is None else self._seen[pairs],
        )

    def _on_device(self, array: NDArray[np.generic]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._device)


def _tensor(array: NDArray[np.generic]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array)).float()
