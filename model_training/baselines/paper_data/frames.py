"""LiDAR frames at the paper's size: simulated, drawn and forgotten, so that 46,741 scans need no place on disk.

Every frame draws its errors from its own seed. Frames are made in blocks; a block that is done is marked, and a run that was
stopped goes on with the others.
"""

import hashlib
import json
import multiprocessing
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from model_training.baselines.paper_data.picture25d import SIZE, picture_from_above
from model_training.baselines.paper_data.table_one import in_proportion
from model_training.simulation.city import City
from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.lidar import LIDARS, scan
from model_training.simulation.meshes import joined
from model_training.simulation.scene import Scene
from model_training.simulation.traversal import Station, lidar_pose, stations
from service.errors import DatasetError
from service.geometry.rigid import heading_of_body
from service.imaging.pca import level_scan
from service.imaging.view_grid import ViewGrid, panorama_from_points

LIDAR, CITY_SEED, FORMAT = "paper_32", 0, 1
STEP_M = 0.02  # between the stations that frames are chosen from; the densest class has a frame every 3 cm
BLOCK = 128
FINISHED, BEGUN = "frames.json", "frames.begun.json"
Report = Callable[[str, int, int], None]
Transform = NDArray[np.float64]
PoseOf = Callable[[int, np.random.Generator], Transform]


@dataclass(frozen=True)
class Frames:
    """The drive's frames in the order of the drive, memory-mapped.

    ``aligned`` and ``plain`` (n, 224, 224): the paper's 2.5D image with and without PCA; ``panoramas`` (n, rows, around),
    metres, and ``intensities`` of the same shape (255 times the root of 0..1), levelled, column 0 at azimuth -pi against
    ``places``; ``places`` (n, 4): x, y, heading of the panorama's x axis, LiDAR's height (m, rad); ``T_map_lidar`` (n, 4, 4);
    ``street`` (n): the class of Table I, 0 to 15.
    """

    aligned: NDArray[np.uint8]
    plain: NDArray[np.uint8]
    panoramas: NDArray[np.float16]
    intensities: NDArray[np.uint8]
    places: NDArray[np.float64]
    T_map_lidar: NDArray[np.float64]
    street: NDArray[np.int64]

    @staticmethod
    def open(folder: Path) -> "Frames":
        """Map what ``make_frames`` made.

        Raises:
            DatasetError: the folder is not whole.
        """
        if not (folder / FINISHED).exists():
            raise DatasetError(f"{folder} holds no finished frames; run make paper", field="frames")
        return Frames(**{name: np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)
                         for name in Frames.__annotations__})  # fmt: skip

    def __len__(self) -> int:
        return len(self.street)


def stations_of(city: City, total: int) -> tuple[list[Station], NDArray[np.int64]]:
    """Where the frames are taken, ``total`` in Table I's proportions, evenly along each class; and their classes."""
    along = stations(city, STEP_M)
    points = shapely.points([(station.x, station.y) for station in along])
    class_of = np.full(len(along), -1, np.int64)
    for index, feature in enumerate(city.streets_geojson()["features"]):
        class_of[shapely.contains(shapely.geometry.shape(feature["geometry"]), points)] = index
    chosen = []
    for index, count in enumerate(in_proportion(total)):
        inside = np.flatnonzero(class_of == index)
        chosen.append(inside[np.linspace(0, len(inside) - 1, count).round().astype(int)])
    rows = np.sort(np.concatenate(chosen))
    return [along[k] for k in rows], class_of[rows]


def make_frames(folder: Path, total: int, *, workers: int | None = None, report: Report = lambda *_: None) -> Frames:
    """Simulate, draw and keep ``total`` frames of the survey's drive, or go on with what a stopped run left.

    Raises:
        DatasetError: the folder holds other frames.
    """
    made_of: dict[str, Any] = {"format": FORMAT, "total": total, "lidar": LIDAR, "city_seed": CITY_SEED}
    if _finished(folder, made_of):
        return Frames.open(folder)
    city = City(seed=CITY_SEED, name="paper")
    where, street = stations_of(city, total)

    def pose_of(row: int, rng: np.random.Generator) -> Transform:
        return lidar_pose(city, where[row], rng)

    return _make(folder, made_of, city, 0, pose_of, street, workers, report)


def make_frames_at(
    folder: Path, T_map_lidar: NDArray[np.float64], street: NDArray[np.int64], *, traversal: int,
    workers: int | None = None, report: Report = lambda *_: None,
) -> Frames:  # fmt: skip
    """The same of given poses (n, 4, 4) among the vehicles and people of another drive.

    Raises:
        DatasetError: the folder holds other frames.
    """
    made_of: dict[str, Any] = {
        "format": FORMAT, "total": len(street), "lidar": LIDAR, "city_seed": CITY_SEED, "traversal": traversal,
        "poses": hashlib.sha256(np.ascontiguousarray(T_map_lidar).tobytes()).hexdigest(),
    }  # fmt: skip
    if _finished(folder, made_of):
        return Frames.open(folder)
    city = City(seed=CITY_SEED, name="paper")

    def pose_of(row: int, _: np.random.Generator) -> Transform:
        T: Transform = T_map_lidar[row]
        return T

    return _make(folder, made_of, city, traversal, pose_of, street, workers, report)


def _finished(folder: Path, made_of: dict[str, Any]) -> bool:
    """Whether there is nothing to do; ``folder`` holds these frames, or nothing.

    Raises:
        DatasetError: it holds others.
    """
    for path in (folder / FINISHED, folder / BEGUN):
        if path.exists() and json.loads(path.read_text()) != made_of:
            raise DatasetError(f"{path} is of other frames; remove {folder}, or choose another --work", field="work")
    return (folder / FINISHED).exists()


def _make(
    folder: Path, made_of: dict[str, Any], city: City, traversal: int, pose_of: PoseOf, street: NDArray[np.int64],
    workers: int | None, report: Report,
) -> Frames:  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    total, grid = len(street), ViewGrid()
    shapes: dict[str, tuple[tuple[int, ...], type]] = {
        "aligned": ((total, SIZE, SIZE), np.uint8), "plain": ((total, SIZE, SIZE), np.uint8),
        "panoramas": ((total, grid.rows, grid.around), np.float16), "intensities": ((total, grid.rows, grid.around), np.uint8),
        "places": ((total, 4), np.float64), "T_map_lidar": ((total, 4, 4), np.float64),
    }  # fmt: skip
    begun = folder / BEGUN
    if not begun.exists():
        for name, (shape, kind) in shapes.items():
            np.lib.format.open_memmap(folder / f"{name}.npy", mode="w+", dtype=kind, shape=shape).flush()
        np.save(folder / "street.npy", street)
        begun.write_text(json.dumps(made_of) + "\n")
    todo = [first for first in range(0, total, BLOCK) if not _mark(folder, first).exists()]
    global _job
    scene = Scene(joined([city.static, city.occupants(traversal)]))
    _job = _Job(folder, city, scene, pose_of, total, traversal, grid, LIDARS[LIDAR].rays())
    with (
        threadpool_limits(1, user_api="blas"),
        multiprocessing.get_context("fork").Pool(workers or os.cpu_count()) as pool,
    ):
        done = total - sum(min(BLOCK, total - first) for first in todo)
        for count in pool.imap_unordered(_block, todo):
            done += count
            report("LiDAR frames", done, total)
    for first in range(0, total, BLOCK):
        _mark(folder, first).unlink()
    begun.rename(folder / FINISHED)
    return Frames.open(folder)


@dataclass
class _Job:
    """What a worker has inherited."""

    folder: Path
    city: City
    scene: Scene
    pose_of: PoseOf
    total: int
    traversal: int
    grid: ViewGrid
    rays: NDArray[np.float32]


_job: _Job | None = None  # set before the workers are forked: they share the scene instead of copying it


def _mark(folder: Path, first: int) -> Path:
    return folder / f"block-{first:06d}.done"


def _block(first: int) -> int:
    job = _job
    if job is None:
        raise RuntimeError("a worker was started without its job")
    arrays = {
        name: np.load(job.folder / f"{name}.npy", mmap_mode="r+") for name in Frames.__annotations__ if name != "street"
    }
    rows = range(first, min(first + BLOCK, job.total))
    for row in rows:
        rng = np.random.default_rng([CITY_SEED, 41 + job.traversal, row])
        T = job.pose_of(row, rng)
        points = scan(job.scene, job.city.ground, LIDARS[LIDAR], job.rays, T, CONDITIONS["clear"], rng)
        arrays["aligned"][row] = picture_from_above(points[:, :3], aligned=True)
        arrays["plain"][row] = picture_from_above(points[:, :3], aligned=False)
        level = level_scan(points[:, :3])
        levelled = np.c_[points[:, :3] @ level.R_level_sensor.T.astype(np.float32), points[:, 3]]
        ranges, intensity = panorama_from_points(levelled, job.grid)
        arrays["panoramas"][row] = ranges
        arrays["intensities"][row] = np.rint(255 * np.sqrt(intensity))
        T_map_level = T.copy()
        T_map_level[:3, :3] = T[:3, :3] @ level.R_level_sensor.T
        arrays["places"][row] = (T[0, 3], T[1, 3], heading_of_body(T_map_level), level.height_m)
        arrays["T_map_lidar"][row] = T
    for array in arrays.values():
        array.flush()
    _mark(job.folder, first).touch()
    return len(rows)
