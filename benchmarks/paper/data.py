"""Data that all methods share, made once under the work folder."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model_training.cli.progress import bars
from model_training.datasets.dataset import Dataset
from model_training.simulation.simulate import simulate
from research.baselines.paper_data.frames import Frames, make_frames, make_frames_at
from research.baselines.paper_data.pairs import Pairs, make_pairs
from research.baselines.paper_data.plan import SPLITS, TEST_TRAVERSAL, TRAINING_SETS, pairs_plan
from research.baselines.paper_data.table_one import PAPER_FRAMES, PAPER_PAIRS
from service.geometry.rigid import R_BODY_OPTICAL

LIDAR_ABOVE_CAMERA_M = 0.3


@dataclass(frozen=True)
class Size:
    """Amount of data: the paper's, or less for a quick check that everything runs.

    Attributes:
        frames: number of LiDAR frames.
        pairs: number of RGB-D training pairs.
        test_images: test images per split; None for Table I's 626.
    """

    frames: int = PAPER_FRAMES
    pairs: int = PAPER_PAIRS
    test_images: int | None = None

    @property
    def spacing_m(self) -> float:
        """Distance between the places of the map, metres. With fewer test images than the paper's, the map is sparse too."""
        return 1.0 if self.test_images is None else 20.0


def made_minutes(folder: Path) -> float:
    """Return the wall time between a folder's first and last file in minutes, pauses included.

    Args:
        folder: folder to look at.
    """
    times = [path.stat().st_mtime for path in folder.rglob("*") if path.is_file()]
    return (max(times) - min(times)) / 60 if times else 0.0


class PaperData:
    """Frames, pairs and tests of one size, made on first use and reused.

    Args:
        work: folder of the data.
        size: amount of data.
    """

    def __init__(self, work: Path, size: Size) -> None:
        self.work, self.size = work, size

    def made_minutes(self) -> dict[str, float]:
        """Return the wall time of making each part, minutes."""
        frames, dataset = self.work / f"frames-{self.size.frames}", self.dataset.folder
        return {
            "LiDAR frames": made_minutes(frames),
            "RGB-D pairs, tests and survey": made_minutes(dataset),
            "small images of the pairs": made_minutes(self.work / f"pairs-{self.size.pairs}"),
        }

    @cached_property
    def frames(self) -> Frames:
        """LiDAR frames of the survey traversal."""
        with bars() as report:
            return make_frames(self.work / f"frames-{self.size.frames}", self.size.frames, report=report)

    @cached_property
    def dataset(self) -> Dataset:
        """Dataset of pairs and tests; its survey makes our map."""
        tests = self.size.test_images
        plan = pairs_plan(self.size.pairs, test_images=tests)
        folder = self.work / (f"dataset-{self.size.pairs}" + ("" if tests is None else f"-{tests}"))
        with bars() as report:
            simulate(plan, folder, report=report)
        return Dataset(folder)

    @cached_property
    def pairs(self) -> Pairs:
        """Training pairs: the first half from the survey traversal, the second half from another."""
        with bars() as report:
            return make_pairs(self.dataset, TRAINING_SETS, self.work / f"pairs-{self.size.pairs}", report=report)

    @cached_property
    def tests(self) -> dict[str, Pairs]:
        """Test queries by split."""
        count, found = self.size.test_images or 626, {}
        for split in SPLITS:
            with bars() as report:
                found[split] = make_pairs(
                    self.dataset, (test_set(split),), self.work / f"{split}-{count}", report=report
                )
        return found

    @cached_property
    def other_lidar(self) -> Frames:
        """Scans of a LiDAR above the camera at the other traversal's queries."""
        test = self.tests["other_drive"]
        with bars() as report:
            return make_frames_at(
                self.work / f"other-lidar-{len(test)}",
                lidar_above(np.asarray(test.T_map_camera)),
                np.asarray(test.street),
                traversal=TEST_TRAVERSAL,
                report=report,
            )


def test_set(split: str) -> str:
    """Return the name of a split's query set in the dataset.

    Args:
        split: name of the split.
    """
    return f"{split}_precise"


def lidar_above(T_map_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return T_map_lidar (n, 4, 4) of a LiDAR 0.3 m above each camera, with the camera's heading.

    Args:
        T_map_camera: camera poses (n, 4, 4), optical frame.
    """
    T_camera_lidar = np.eye(4)
    T_camera_lidar[:3, :3] = R_BODY_OPTICAL.T
    T_camera_lidar[:3, 3] = [0.0, -LIDAR_ABOVE_CAMERA_M, 0.0]  # optical axes: y down
    above: NDArray[np.float64] = T_map_camera @ T_camera_lidar
    return above
