"""Rows ``real.kitti_0005.*`` in other conditions: sparse surveys, grey or small images, a prior, five frames. Tuning may use it."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.real.smaller_images import write_smaller_images
from benchmarks.real.streets import QUERIES, answer_rows, prior_rows, sequence_rows, taken, unpacked
from benchmarks.report import Report
from model_training.datasets.dataset import Dataset, Transforms
from model_training.evaluation.predict import Predictions, predict
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.stock import ENCODER
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.retrieval.query import Query

DRIVE = "kitti_0005"
#: Intervals of the scans of sparse surveys. The drive has one scan every 2.7 m.
SPARSE = (2, 3)
#: Factors of smaller images. Focal length times baseline of the drive is 384 px m; a robot's rig with 640 pixels has 30 to 100 px m.
SMALLER = (2, 3, 4, 6)


class EveryScan(Dataset):
    """A dataset whose survey has every n-th scan.

    Args:
        folder: folder of the dataset.
        each: interval of the scans that stay.
        first: index of the first scan that stays.
    """

    def __init__(self, folder: Path, each: int, first: int) -> None:
        super().__init__(folder)
        self._each, self._first = each, first

    def survey_poses(self) -> Transforms:
        """Return T_map_lidar of the scans that stay (n, 4, 4), metres."""
        return super().survey_poses()[self._first :: self._each]

    def scan(self, number: int) -> NDArray[np.float32]:
        """Return a scan that stays (n, 4): x, y, z in the LiDAR frame (m) and intensity.

        Args:
            number: number among the scans that stay.
        """
        return super().scan(self._first + number * self._each)


def grey(query: Query) -> Query:
    """Return the query as a grey camera takes it.

    Args:
        query: query with a colour image.
    """
    brightness = cv2.cvtColor(query.rgb, cv2.COLOR_RGB2GRAY)
    return replace(query, rgb=np.repeat(brightness[..., None], 3, axis=2))


def variant_rows(report: Report, data: Path, work: Path) -> None:
    """Measure the drive in each condition, at default settings.

    Args:
        report: receives the rows.
        data: folder of the recordings.
        work: folder of datasets and maps.
    """
    drive = unpacked(data, work, DRIVE)
    if drive is None:
        report.row(f"real.{DRIVE}.grey.answered_within_1_m", None, "share", why=f"no recordings at {data.name}")
        return
    dataset = taken(drive, work / f"{DRIVE}_data")
    whole = _localizer(dataset, work / "variant_map")
    answer_rows(report, f"real.{DRIVE}.grey", predict(whole, dataset, QUERIES, seen_by=grey), bars=False)
    prior_rows(report, DRIVE, dataset, whole)
    sequence_rows(report, DRIVE, dataset, whole, bars=False)
    for factor in SMALLER:
        smaller = taken(
            write_smaller_images(drive, work / f"{DRIVE}_smaller_raw", factor), work / f"{DRIVE}_smaller_data"
        )
        answer_rows(report, f"real.{DRIVE}.smaller_{factor}", predict(whole, smaller, QUERIES), bars=False)
        prior_rows(report, f"{DRIVE}.smaller_{factor}", smaller, whole)
    for each in SPARSE:
        found = []
        for first in range(each):
            sparse = EveryScan(dataset.folder, each, first)
            found.append(predict(_localizer(sparse, work / "variant_map"), sparse, QUERIES))
        answer_rows(report, f"real.{DRIVE}.one_scan_of_{each}", _joined(found), bars=False)


def _localizer(dataset: Dataset, folder: Path) -> Localizer:
    build_map(dataset, ENCODER, folder, BuildSettings(name="variant"), overwrite=True)
    return Localizer.open(MapBundle.open(folder))


def _joined(found: list[Predictions]) -> Predictions:
    return Predictions(
        **{name: np.concatenate([getattr(each, name) for each in found]) for name in Predictions.__dataclass_fields__}
    )
