"""RGB-D pairs for the learned methods: small images in memory maps, made once from a dataset's query sets."""

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset, QueryFrame
from research.baselines.answers import nearest_streets
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import heading_of_body
from service.imaging.level import CameraLevel, level_camera
from service.imaging.resample import resample
from service.imaging.view_grid import ViewGrid
from service.maps.streets import Streets

SIDE = 224
Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Pairs:
    """RGB-D pairs, memory-mapped.

    Attributes:
        rgb: colours (n, 224, 224, 3), sRGB.
        depth_mm: z (n, 224, 224), millimetres, 0 for no measurement.
        ranges: levelled ranges on the view grid (n, rows, columns), metres.
        colours: levelled colours on the view grid (n, rows, columns, 3).
        views: x, y, heading of the view, and height of the camera (n, 4), metres and radians.
        T_map_camera: poses (n, 4, 4).
        street: classes of Table I (n,), 0 to 15.
        camera: camera of ``rgb`` and ``depth_mm``.
    """

    rgb: NDArray[np.uint8]
    depth_mm: NDArray[np.uint16]
    ranges: NDArray[np.float16]
    colours: NDArray[np.uint8]
    views: NDArray[np.float64]
    T_map_camera: NDArray[np.float64]
    street: NDArray[np.int64]
    camera: PinholeCamera

    @staticmethod
    def open(folder: Path) -> "Pairs":
        """Open finished pairs.

        Args:
            folder: folder of ``make_pairs``.

        Raises:
            DatasetError: the folder is incomplete.
        """
        if not (folder / "pairs.json").exists():
            raise DatasetError(f"{folder} has no complete pairs; run make paper", field="pairs")
        camera = PinholeCamera(**json.loads((folder / "pairs.json").read_text()))
        arrays = {
            name: np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)
            for name in Pairs.__annotations__
            if name != "camera"
        }
        return Pairs(**arrays, camera=camera)

    def __len__(self) -> int:
        return len(self.street)


def make_pairs(dataset: Dataset, names: Sequence[str], folder: Path, *, report: Report = lambda *_: None) -> Pairs:
    """Shrink the pairs of query sets into a folder that appears complete or not at all.

    Args:
        dataset: dataset of the query sets.
        names: names of the query sets.
        folder: folder to create.
        report: receives a label, the number done and the total.

    Raises:
        DatasetError: a set has no ground truth, or the dataset has no streets.
    """
    if (folder / "pairs.json").exists():
        return Pairs.open(folder)
    part = folder.with_name(folder.name + ".part")
    part.mkdir(parents=True, exist_ok=True)
    frames, grid = list(chain.from_iterable(dataset.queries(name) for name in names)), ViewGrid()
    count, shape = len(frames), (grid.rows, grid.columns)
    shapes: dict[str, tuple[tuple[int, ...], type]] = {
        "rgb": ((count, SIDE, SIDE, 3), np.uint8),
        "depth_mm": ((count, SIDE, SIDE), np.uint16),
        "ranges": ((count, *shape), np.float16),
        "colours": ((count, *shape, 3), np.uint8),
        "views": ((count, 4), np.float64),
        "T_map_camera": ((count, 4, 4), np.float64),
    }
    arrays = {
        name: np.lib.format.open_memmap(part / f"{name}.npy", mode="w+", dtype=kind, shape=size)
        for name, (size, kind) in shapes.items()
    }

    def shrink(row: int) -> None:
        for name, value in _shrunk(frames[row], grid).items():
            arrays[name][row] = value

    with ThreadPoolExecutor(2) as pool:
        for done, _ in enumerate(pool.map(shrink, range(count)), 1):
            report(f"pairs of {names[0]}", done, count)
    for array in arrays.values():
        array.flush()
    streets = dataset.streets()
    if streets is None:
        raise DatasetError(f"{dataset.folder} has no streets.geojson", field="streets")
    np.save(part / "street.npy", nearest_streets(Streets.from_geojson(streets), arrays["T_map_camera"][:, :2, 3]))
    small = frames[0].camera.pinhole().scaled_to(SIDE, SIDE)
    kept = {name: getattr(small, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    (part / "pairs.json").write_text(json.dumps(kept) + "\n")
    part.rename(folder)
    return Pairs.open(folder)


def levelled_view(
    rgb: NDArray[np.uint8], depth_m: NDArray[np.float32], camera: PinholeCamera, grid: ViewGrid
) -> tuple[NDArray[np.float32], NDArray[np.uint8], CameraLevel]:
    """Return ranges (rows, columns, metres) and colours (rows, columns, 3) of a pair on the view grid, and the camera's level.

    Args:
        rgb: colours (H, W, 3), sRGB.
        depth_m: z (h, w), metres, 0 for no measurement.
        camera: camera of both images.
        grid: the view grid.
    """
    level = level_camera(depth_m, camera, down_camera=None, nominal_height_m=1.5)
    ranges, colour, _ = resample(rgb, depth_m, camera, level.R_level_camera.T, grid)
    return ranges, np.rint(colour).clip(0, 255).astype(np.uint8), level


def _shrunk(frame: QueryFrame, grid: ViewGrid) -> dict[str, NDArray[np.generic]]:
    """Shrink one pair: colour is averaged; depth is the nearest pixel's, never an average."""
    T = frame.T_map_camera
    if T is None:
        raise DatasetError("a query set has no poses.txt, so it cannot be used for training", field="queries")
    rgb, depth_m, camera = frame.rgb(), frame.depth_m(), frame.camera.pinhole()
    ranges, colour, level = levelled_view(rgb, depth_m, camera, grid)
    T_map_level = np.eye(4)
    T_map_level[:3, :3] = T[:3, :3] @ level.R_level_camera.T
    heading = heading_of_body(T_map_level)
    return {
        "rgb": np.asarray(cv2.resize(rgb, (SIDE, SIDE), interpolation=cv2.INTER_AREA), np.uint8),
        "depth_mm": np.rint(np.asarray(cv2.resize(depth_m, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)) * 1000)
        .clip(0, 65535)
        .astype(np.uint16),
        "ranges": ranges.astype(np.float16),
        "colours": colour,
        "views": np.array([T[0, 3], T[1, 3], heading, level.height_m]),
        "T_map_camera": T,
    }
