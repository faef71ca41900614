"""LiDAR frames at the paper's size: simulated and rendered, without storing the 46,741 scans.

Every frame draws its errors from its own seed. Frames are made in blocks. A finished block is marked, and a stopped run
continues with the other blocks.
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

from model_training.simulation.city import City
from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.lidar import LIDARS, scan
from model_training.simulation.meshes import joined
from model_training.simulation.scene import Scene
from model_training.simulation.traversal import Station, lidar_pose, stations
from research.baselines.paper_data.picture25d import SIZE, picture_from_above
from research.baselines.paper_data.table_one import in_proportion
from service.errors import DatasetError
from service.geometry.rigid import heading_of_body
from service.imaging.pca import Level, level_scan
from service.imaging.view_grid import ViewGrid, panorama_from_points

LIDAR, CITY_SEED, FORMAT = "paper_32", 0, 1
#: Spacing of the stations that frames are chosen from, metres. The densest class has a frame every 3 cm.
STEP_M = 0.02
BLOCK = 128
FINISHED, BEGUN = "frames.json", "frames.begun.json"
Report = Callable[[str, int, int], None]
Transform = NDArray[np.float64]
PoseOf = Callable[[int, np.random.Generator], Transform]


@dataclass(frozen=True)
class Frames:
    """LiDAR frames of a traversal in its order, memory-mapped.

    Attributes:
        aligned: the paper's 2.5D images with PCA (n, 224, 224).
        plain: the paper's 2.5D images without PCA (n, 224, 224).
        panoramas: levelled ranges (n, rows, around), metres; column 0 is at azimuth -pi against ``places``.
        intensities: levelled intensities (n, rows, around), 255 times the root of 0..1.
        places: x, y, heading of the panorama's x axis, and height of the LiDAR (n, 4), metres and radians.
        T_map_lidar: poses (n, 4, 4).
        street: classes of Table I (n,), 0 to 15.
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
        """Open finished frames.

        Args:
            folder: folder of ``make_frames``.

        Raises:
            DatasetError: the folder is incomplete.
        """
        if not (folder / FINISHED).exists():
            raise DatasetError(f"{folder} has no complete frames; run make paper", field="frames")
        return Frames(
            **{
                name: np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)
                for name in Frames.__annotations__
            }
        )

    def __len__(self) -> int:
        return len(self.street)


def levelled_panorama(
    points: NDArray[np.float32], grid: ViewGrid
) -> tuple[NDArray[np.float32], NDArray[np.float32], Level]:
    """Return ranges and intensities (rows, around) of a scan on the view grid, and its level.

    Args:
        points: x, y, z in the sensor frame, metres, and intensity (N, 4).
        grid: the view grid.
    """
    level = level_scan(points[:, :3])
    levelled = np.c_[points[:, :3] @ level.R_level_sensor.T.astype(np.float32), points[:, 3]]
    ranges, intensity = panorama_from_points(levelled, grid)
    return ranges, intensity, level


def stations_of(city: City, total: int) -> tuple[list[Station], NDArray[np.int64]]:
    """Choose stations in Table I's proportions, evenly along each class; return them and their classes (total,).

    Args:
        city: the city.
        total: number of stations.
    """
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
    """Simulate, render and keep frames of the survey traversal, or resume a stopped run.

    Args:
        folder: folder of the frames.
        total: number of frames.
        workers: number of processes; None for one per core.
        report: receives a label, the number done and the total.

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
    folder: Path,
    T_map_lidar: NDArray[np.float64],
    street: NDArray[np.int64],
    *,
    traversal: int,
    workers: int | None = None,
    report: Report = lambda *_: None,
) -> Frames:
    """Make frames at given poses among the vehicles and people of another traversal.

    Args:
        folder: folder of the frames.
        T_map_lidar: poses (n, 4, 4).
        street: street classes (n,).
        traversal: number of the traversal.
        workers: number of processes; None for one per core.
        report: receives a label, the number done and the total.

    Raises:
        DatasetError: the folder holds other frames.
    """
    made_of: dict[str, Any] = {
        "format": FORMAT,
        "total": len(street),
        "lidar": LIDAR,
        "city_seed": CITY_SEED,
        "traversal": traversal,
        "poses": hashlib.sha256(np.ascontiguousarray(T_map_lidar).tobytes()).hexdigest(),
    }
    if _finished(folder, made_of):
        return Frames.open(folder)
    city = City(seed=CITY_SEED, name="paper")

    def pose_of(row: int, _: np.random.Generator) -> Transform:
        T: Transform = T_map_lidar[row]
        return T

    return _make(folder, made_of, city, traversal, pose_of, street, workers, report)


def _finished(folder: Path, made_of: dict[str, Any]) -> bool:
    """Return whether the folder already holds these frames.

    Raises:
        DatasetError: it holds other frames.
    """
    for path in (folder / FINISHED, folder / BEGUN):
        if path.exists() and json.loads(path.read_text()) != made_of:
            raise DatasetError(
                f"{path} belongs to other frames; remove {folder}, or choose another --work", field="work"
            )
    return (folder / FINISHED).exists()


def _make(
    folder: Path,
    made_of: dict[str, Any],
    city: City,
    traversal: int,
    pose_of: PoseOf,
    street: NDArray[np.int64],
    workers: int | None,
    report: Report,
) -> Frames:
    folder.mkdir(parents=True, exist_ok=True)
    total, grid = len(street), ViewGrid()
    shapes: dict[str, tuple[tuple[int, ...], type]] = {
        "aligned": ((total, SIZE, SIZE), np.uint8),
        "plain": ((total, SIZE, SIZE), np.uint8),
        "panoramas": ((total, grid.rows, grid.around), np.float16),
        "intensities": ((total, grid.rows, grid.around), np.uint8),
        "places": ((total, 4), np.float64),
        "T_map_lidar": ((total, 4, 4), np.float64),
    }
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
    """Shared data of the workers."""

    folder: Path
    city: City
    scene: Scene
    pose_of: PoseOf
    total: int
    traversal: int
    grid: ViewGrid
    rays: NDArray[np.float32]


#: Set before the workers fork: they share the scene instead of copying it.
_job: _Job | None = None


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
        ranges, intensity, level = levelled_panorama(points, job.grid)
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
