import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.imaging.view_grid import ViewGrid

GRID = ViewGrid(rows=16, columns=32)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Networks this small are slower on several threads, especially on a busy machine."""
    if importlib.util.find_spec("torch") is None:
        yield
        return
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def write_pack(folder: Path, *, places: int = 60, seed: int = 0) -> Path:
    """Write a pack of places spread over 300 m. Each has its own panorama and one query that shows it."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(3, 30, (places, 4, GRID.around // 8))
    panoramas = np.repeat(np.repeat(coarse, 4, axis=1), 8, axis=2)
    poses = np.zeros((places, 4))
    poses[:, :2], poses[:, 2], poses[:, 3] = rng.uniform(0, 300, (places, 2)), rng.uniform(-3, 3, places), 1.8
    turn = rng.uniform(-3, 3, places)
    columns = np.rint((turn[:, None] + GRID.azimuths_rad + np.pi) / (2 * np.pi) * GRID.around).astype(int) % GRID.around
    queries = poses.copy()
    queries[:, 2] += turn
    queries[:, :2] += rng.uniform(-0.5, 0.5, (places, 2))
    queries[:, 3] = 1.5
    arrays: dict[str, np.ndarray] = {
        "panoramas": panoramas.astype(np.float16),
        "intensities": (panoramas * 8).astype(np.uint8),
        "places": poses,
        "rows_seen": np.ones(GRID.rows, np.bool_),
        "ranges": np.stack([p[:, c] for p, c in zip(panoramas, columns, strict=True)]).astype(np.float16),
        "rgb": rng.integers(0, 256, (places, GRID.rows, GRID.columns, 3)).astype(np.uint8),
        "queries": queries,
    }
    folder.mkdir(parents=True)
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    return folder


@pytest.fixture(scope="session")
def pack_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pack(tmp_path_factory.mktemp("packs") / "one")


@pytest.fixture(scope="session")
def grid() -> ViewGrid:
    return GRID


@pytest.fixture(scope="session")
def shape() -> Any:
    from model_training.training.encoder_net import EncoderShape

    return EncoderShape(rows=16, columns=32, widths=(4, 6, 6, 8), narrow=4, descriptor=16)


@pytest.fixture(scope="session")
def pack_of() -> Callable[..., Path]:
    return write_pack
