"""The recording ``kitti_stereo``: seven stereo frames of the same car, with a scan each."""

import shutil
from pathlib import Path

from model_training.datasets.dataset import Dataset
from model_training.importing.kitti_object import import_kitti_object
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.stock import ENCODER

LIDAR_HEIGHT_M = 1.73  # from KITTI's drawing of its vehicle
NAME, QUERIES = "kitti_stereo", "frames"


def stereo_frames(data: Path, work: Path) -> tuple[Dataset, Path] | None:
    """Import the frames with SGBM depth and map all scans; return the dataset and the map, or None without the recording.

    Args:
        data: folder of the recordings.
        work: folder of datasets and maps. Those of an earlier run are deleted.
    """
    source = data / NAME
    if not source.exists():
        return None
    folder, bundle = work / NAME, work / f"{NAME}_map"
    for each in (folder, bundle):
        shutil.rmtree(each, ignore_errors=True)
    import_kitti_object(source, folder, depth="sgbm")
    dataset = Dataset(folder)
    build_map(dataset, ENCODER, bundle, BuildSettings(name="kitti-stereo", expected_lidar_height_m=LIDAR_HEIGHT_M))
    return dataset, bundle
