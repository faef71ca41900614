"""Retrieval on real stereo frames by the protocol of the data folder's README.

Gallery: all headings of 14 single frames and 10 full scans, and the mirror image of each as a further place. Queries: 7
stereo frames with SGBM depth, straight and turned by +-6 degrees, each also mirrored. These are 42 queries, of which 7
are independent. A query is correct if its own place (mirrored or not) comes first. All sides use only elevations below
+2.5 degrees.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from model_training.evaluation.raw_range import similarities
from model_training.importing.kitti_object import import_kitti_object
from model_training.mapping.settings import BuildSettings
from model_training.mapping.survey import fan, levelled_scans
from service.geometry.camera import PinholeCamera
from service.imaging.query_view import query_view
from service.imaging.view_grid import Planes, ViewGrid, panorama_from_points, survey_planes, view_from_panorama
from service.retrieval.encoder import Encoder

HIGHEST_DEG = 2.5
TURNS_DEG = (0.0, 6.0, -6.0)
HEADINGS = 24


@dataclass(frozen=True)
class Views:
    """Views and their places.

    Attributes:
        planes: planes (n, 5, rows, columns).
        place: number of the place of each view (n,); mirrored places have their own numbers.
    """

    planes: NDArray[np.float32]
    place: NDArray[np.int64]


def retrieve(encoder: Encoder, kitti: Path, drive: Path, work: Path) -> dict[str, float]:
    """Return R@1 and R@5 of the encoder, and R@1 of the raw range image by setting, over the 42 queries.

    Args:
        encoder: encoder to measure.
        kitti: folder of the single stereo frames.
        drive: folder of the raw traversal with full scans.
        work: folder for the imported dataset.
    """
    folder = work / "kitti_sgbm"
    if not folder.exists():
        import_kitti_object(kitti, folder, depth="sgbm")
    dataset = Dataset(folder)
    grid = ViewGrid(rows=encoder.rows, columns=encoder.columns)
    rows = np.rad2deg(grid.elevations_rad) < HIGHEST_DEG
    gallery, queries = _gallery(dataset, drive, grid, rows), _queries(dataset, grid, rows)
    similarity = encoder.encode(queries.planes, "query") @ encoder.encode(gallery.planes, "survey").T
    result = {"n": float(len(queries.place)), "views": float(len(gallery.place))}
    result |= {f"recall_at_{k}": _recall(similarity, gallery, queries, k) for k in (1, 5)}
    for name, raw in similarities(queries.planes[:, 0], gallery.planes[:, 0]).items():
        result[f"raw_{name}"] = _recall(raw, gallery, queries, 1)
    return result


def _recall(similarity: NDArray[np.float32], gallery: Views, queries: Views, k: int) -> float:
    right = 0
    for row, own in zip(similarity, queries.place, strict=True):
        order = gallery.place[np.argsort(-row)]
        first = order[np.sort(np.unique(order, return_index=True)[1])][:k]
        right += int(own in first)
    return right / len(queries.place)


def _mirrored(planes: Planes) -> Planes:
    return np.ascontiguousarray(planes[:, :, ::-1])


def _gallery(dataset: Dataset, drive: Path, grid: ViewGrid, rows: NDArray[np.bool_]) -> Views:
    settings = BuildSettings(name="kitti", expected_lidar_height_m=1.73)
    count = len(dataset.survey_poses())
    scans = list(levelled_scans(dataset, np.arange(count), settings))
    full = sorted(drive.glob("*/*/velodyne_points/data/*.bin")) or sorted(drive.glob("**/velodyne_points/data/*.bin"))
    if not full:
        raise FileNotFoundError(f"{drive} has no velodyne scans")
    scans += list(levelled_scans(_Scans(full), np.arange(len(full)), settings))  # type: ignore[arg-type]  # it only calls scan()
    planes, place = [], []
    for number, scan in enumerate(scans):
        panorama = panorama_from_points(scan.points, grid)
        for turn in fan(HEADINGS):
            view = survey_planes(
                view_from_panorama(panorama, scan.start_rad + float(turn), grid),
                sensor_height_m=scan.level.height_m,
                rows_seen=rows,
                grid=grid,
            )
            if view[0].any():
                planes += [view, _mirrored(view)]
                place += [number, number + len(scans)]
    return Views(np.stack(planes), np.array(place))


class _Scans:
    """KITTI scans by number, with the interface of a dataset."""

    def __init__(self, paths: list[Path]) -> None:
        self._paths = paths

    def scan(self, number: int) -> NDArray[np.float32]:
        return np.fromfile(self._paths[number], np.float32).reshape(-1, 4)


def _queries(dataset: Dataset, grid: ViewGrid, rows: NDArray[np.bool_]) -> Views:
    names: list[str] = dataset.description.source["places"]
    query_names: list[str] = dataset.description.source["queries"]["frames"]
    places = len(names) + 10
    planes, place = [], []
    for frame in dataset.queries("frames"):
        own = names.index(query_names[frame.number])
        camera: PinholeCamera = frame.camera.pinhole()
        rgb, depth = frame.rgb(), frame.depth_m()
        for turn in TURNS_DEG:
            view = query_view(rgb, depth, camera, grid=grid, rows_seen=rows, turn_rad=float(np.deg2rad(turn))).planes
            planes += [view, _mirrored(view)]
            place += [own, own + places]
    return Views(np.stack(planes), np.array(place))
