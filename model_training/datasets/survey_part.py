"""Some scans of a dataset's survey."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset, ScanFile, Transforms, scan_path
from model_training.datasets.frames import MovedFrame


class SurveyPart(Dataset):
    """A dataset whose survey is a part of another one. Scan ``k`` of the part is scan ``numbers[k]`` of the whole survey.

    Args:
        folder: folder of the whole dataset.
        numbers: indices of the scans of the part, ascending (n,).
        poses: their T_map_lidar (n, 4, 4), metres. So nobody reads the poses of the whole survey again. In a dataset that has been moved
            into another frame, they are in that frame.

    Raises:
        DatasetError: the dataset cannot be opened.
    """

    def __init__(self, folder: Path, numbers: NDArray[np.int64], poses: Transforms) -> None:
        super().__init__(folder)
        self._numbers, self._poses = numbers, poses

    def survey_trajectory(self) -> tuple[NDArray[np.float64], Transforms]:
        """Return the time of each scan of the part in seconds (n,), and T_map_lidar in metres (n, 4, 4).

        Raises:
            DatasetError: the pose file is missing or damaged.
        """
        return super().survey_trajectory()[0][self._numbers], self._poses

    def survey_poses(self) -> Transforms:
        """Return T_map_lidar of each scan of the part (n, 4, 4), metres."""
        return self._poses

    def scan(self, number: int) -> NDArray[np.float32]:
        """Return a scan of the part (n, 4), as ``Dataset.scan``.

        Args:
            number: index of the scan in the part.

        Raises:
            DatasetError: the file is missing, truncated or cannot be read.
        """
        return super().scan(self.number_in_survey(number))

    def number_in_survey(self, number: int) -> int:
        """Return the index of a scan in the whole survey.

        Args:
            number: index of the scan in the part.
        """
        return int(self._numbers[number])

    def scan_files(self) -> Iterator[ScanFile]:
        """Yield the files of the scans of the part that exist, in their order.

        Raises:
            DatasetError: the folder cannot be read.
        """
        return self._files_at(scan_path(self.folder, int(number)) for number in self._numbers)

    def prepare(self) -> None:
        """Bring the scans to this machine before they are read; here they are there."""

    def release(self) -> None:
        """Delete what ``prepare`` brought."""


class PartSource(Protocol):
    """Where a process finds a part of a survey. It can be pickled."""

    def part(self, numbers: NDArray[np.int64], poses: Transforms, *, scratch: Path) -> SurveyPart:
        """Open the part.

        Args:
            numbers: indices of the scans in the survey, ascending (n,).
            poses: their T_map_lidar (n, 4, 4), metres.
            scratch: folder that the part may use until ``SurveyPart.release``.

        Raises:
            DatasetError: the dataset cannot be opened.
        """
        ...


@dataclass(frozen=True, slots=True)
class FolderSource:
    """A survey in a folder.

    Attributes:
        folder: folder of the whole dataset.
        frame: map frame of the part; None: that of the folder.
    """

    folder: Path
    frame: MovedFrame | None = None

    def part(self, numbers: NDArray[np.int64], poses: Transforms, *, scratch: Path) -> SurveyPart:  # noqa: ARG002
        """Open the part, as ``PartSource.part``.

        Args:
            numbers: indices of the scans in the survey, ascending (n,).
            poses: their T_map_lidar (n, 4, 4), metres.
            scratch: not used.

        Raises:
            DatasetError: the dataset cannot be opened.
        """
        return SurveyPart(self.folder, numbers, poses).moved(self.frame)
