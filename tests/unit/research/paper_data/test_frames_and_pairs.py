import json
import shutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from model_training.datasets.dataset import Dataset
from model_training.simulation.city import City
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.simulation.simulate import simulate
from research.baselines.paper_data import frames as module
from research.baselines.paper_data.frames import Frames, make_frames, make_frames_at
from research.baselines.paper_data.pairs import SIDE, Pairs, make_pairs
from research.baselines.paper_data.table_one import in_proportion
from service.errors import DatasetError

BLOCK = 32
TOTAL = BLOCK + 16


@pytest.fixture(scope="module", autouse=True)
def _small_blocks_of_one_city() -> Iterator[None]:
    """Make blocks small, and the city once. It takes two seconds, and comes out the same each time (``test_city.py``)."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "BLOCK", BLOCK)
        patch.setattr(module, "City", cache(City))
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("paper") / "frames"
    make_frames(path, TOTAL, workers=2)
    return path


def test_frames_have_table_one_s_proportions_and_the_drive_s_order(folder: Path) -> None:
    frames = Frames.open(folder)

    assert tuple(np.bincount(frames.street, minlength=16)) == in_proportion(TOTAL)
    assert (np.asarray(frames.aligned).reshape(TOTAL, -1).max(axis=1) > 0).all()
    measured = (np.asarray(frames.panoramas, np.float32) > 0).mean(axis=(1, 2))
    assert measured.min() > 0.2
    assert np.allclose(frames.places[:, :2], frames.T_map_lidar[:, :2, 3])
    assert np.allclose(frames.places[:, 3], 1.8, atol=0.3)


def test_a_stopped_run_goes_on_and_ends_with_the_same_frames(folder: Path, tmp_path: Path) -> None:
    again = tmp_path / "frames"
    shutil.copytree(folder, again)
    before = np.array(Frames.open(again).aligned)
    (again / "frames.json").rename(again / "frames.begun.json")  # as if stopped with the first block done alone
    (again / "block-000000.done").touch()
    array = np.load(again / "aligned.npy", mmap_mode="r+")
    array[BLOCK:] = 0
    array.flush()
    del array

    frames = make_frames(again, TOTAL, workers=1)

    assert (np.asarray(frames.aligned) == before).all()  # nor does the number of workers matter
    assert not list(again.glob("*.done"))


def test_a_folder_of_other_frames_is_refused(folder: Path) -> None:
    with pytest.raises(DatasetError, match="belongs to other frames; remove"):
        make_frames(folder, TOTAL + 1)


def test_an_unfinished_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="has no complete frames"):
        Frames.open(tmp_path)


def test_frames_at_given_poses_see_another_drive_s_vehicles(folder: Path, tmp_path: Path) -> None:
    frames = Frames.open(folder)
    rows = np.array([12, 25, 38])
    T, street = np.array(frames.T_map_lidar[rows]), np.array(frames.street[rows])

    other = make_frames_at(tmp_path / "other", T, street, traversal=6, workers=1)

    assert (np.asarray(other.T_map_lidar) == T).all()
    near, far = np.asarray(other.panoramas, np.float32), np.asarray(frames.panoramas[rows], np.float32)
    both = (near > 0) & (far > 0)
    same = np.abs(near - far)[both] < 0.2
    assert 0.6 < same.mean() < 0.999  # the street is the same, who stands there is not


def test_pairs_are_small_and_keep_depth_unmixed(tmp_path: Path) -> None:
    plan = SimulationPlan(
        name="tiny", city="paper", streets=("3",), spacing_m=8.0, queries=(QueryPlan(name="q", traversal=1, count=4),)
    )
    simulate(plan, tmp_path / "data", workers=1)
    dataset = Dataset(tmp_path / "data")

    pairs = make_pairs(dataset, ("q_precise",), tmp_path / "pairs")

    frame = next(iter(dataset.queries("q_precise")))
    assert pairs.rgb.shape == (4, SIDE, SIDE, 3)
    assert pairs.camera.width == SIDE
    assert pairs.camera.fx == pytest.approx(320 * SIDE / 640)
    full = np.rint(frame.depth_m() * 1000).astype(np.uint16)
    assert set(np.unique(pairs.depth_mm[0])) <= set(np.unique(full))  # taken, never averaged
    assert (pairs.street >= 0).all()
    assert np.allclose(pairs.views[0, :2], pairs.T_map_camera[0, :2, 3])
    assert Pairs.open(tmp_path / "pairs").camera == pairs.camera
    assert not (tmp_path / "pairs.part").exists()
    assert json.loads((tmp_path / "pairs" / "pairs.json").read_text())["height"] == SIDE
