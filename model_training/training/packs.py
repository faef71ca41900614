"""Training data: a simulated city as levelled panoramas and clean query views on the view grid.

A pack holds the views of one city. It is small, so that many can be kept.
It holds no sensor errors: training draws new ones each time that it uses a pair (``augment``).
The panoramas are levelled and resampled like those of a real survey.
"""

import hashlib
import multiprocessing
import os
import secrets
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from glob import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.files import read_arrays
from model_training.simulation.city import City
from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.lidar import LIDARS, scan
from model_training.simulation.meshes import joined
from model_training.simulation.scene import Scene
from model_training.simulation.shading import Light, shade, to_srgb
from model_training.simulation.traversal import lidar_pose, stations, upright_on
from model_training.training.matched_views import MatchedRig, TraversalRig
from service.geometry.rigid import heading_of_body, rotation_x, rotation_y, rotation_z, transform_from
from service.imaging.pca import level_scan
from service.imaging.view_grid import ViewGrid, panorama_from_points

#: Version of the pack format; part of the folder's name.
FORMAT = 3
#: Matched views per traversal. Then the next rig follows, with new rectification errors and another sun.
DRIVE_VIEWS = 60
#: Rays that show whether an object stands directly in front of the camera (128, 3).
_COARSE = ViewGrid(rows=8, columns=16).rays_level().reshape(-1, 3)
#: Part of the names of packs with stereo-matched depth.
MATCHED = "-matched"
#: First traversal of the training set. No dataset uses these numbers, so its vehicles and people differ.
OWN_DRIVES = 1000


@dataclass(frozen=True, slots=True)
class PackPlan:
    """Plan of one city of the training set. Numbers that change the pack are part of its name.

    Attributes:
        seed: seed of the city.
        name: kind of city.
        places: number of places.
        queries_a_place: queries per place.
        lidar: name of the survey LiDAR.
        size_m: size of the city, metres.
        rigs: stereo rigs of the queries, used in turn; empty for clean depth.
        lidar_height_m: height of the survey LiDAR above the ground, metres.
        camera_height_m: least and greatest height of the camera of clean queries above the ground, metres; drawn log-uniformly.
    """

    seed: int
    name: str = "city"
    places: int = 1200
    queries_a_place: int = 3
    lidar: str = "paper_32"
    size_m: tuple[float, float] = (300.0, 400.0)
    rigs: tuple[MatchedRig, ...] = ()
    lidar_height_m: float = 1.8
    camera_height_m: tuple[float, float] = (1.2, 1.9)

    @property
    def stem(self) -> str:
        """Folder name of the pack."""
        matched = f"{MATCHED}-{_digest(self.rigs)}" if self.rigs else ""
        low, high = self.camera_height_m
        heights = f"{self.lidar_height_m:g}m-{low:g}to{high:g}m"
        return (
            f"pack{FORMAT}-{self.name}-{self.seed}-{self.places}x{self.queries_a_place}-{self.lidar}-{heights}{matched}"
        )


@dataclass(frozen=True)
class Pack:
    """One city, memory-mapped: P places and Q queries.

    Attributes:
        panoramas: (P, rows, around), metres; 0 where nothing was measured.
        intensities: (P, rows, around), 255 times the square root of the intensity 0..1.
        places: (P, 4): x, y (m), heading of the panorama's x axis (rad), LiDAR height (m); map frame.
        rows_seen: rows that the LiDAR covers (rows).
        ranges: (Q, rows, columns), metres; 0 where nothing was measured.
        rgb: sRGB (Q, rows, columns, 3).
        queries: (Q, 4): x, y (m), heading (rad), camera height (m); map frame.
        seen: cells that the camera looks at (Q, rows, columns), if depth comes from stereo matching and already has
            errors; otherwise None.
    """

    panoramas: NDArray[np.float16]
    intensities: NDArray[np.uint8]
    places: NDArray[np.float64]
    rows_seen: NDArray[np.bool_]
    ranges: NDArray[np.float16]
    rgb: NDArray[np.uint8]
    queries: NDArray[np.float64]
    seen: NDArray[np.bool_] | None = None

    @staticmethod
    def open(folder: Path) -> "Pack":
        """Map the arrays of a pack; they are read when they are needed.

        Args:
            folder: the pack.

        Raises:
            DatasetError: an array is missing or damaged.
        """
        remedy = f"remove {folder}, so that the next training creates the city again"
        matched = MATCHED in folder.name
        return Pack(
            **{
                name: read_arrays(path, partial(np.load, path, mmap_mode="c", allow_pickle=False), remedy=remedy)
                for name, path in ((name, folder / f"{name}.npy") for name in Pack.__annotations__)
                if name != "seen" or matched
            }
        )


def _digest(rigs: tuple[MatchedRig, ...]) -> str:
    """Eight hexadecimal digits that change with every number of the rigs."""
    return hashlib.sha256(repr((DRIVE_VIEWS, rigs)).encode()).hexdigest()[:8]


def rows_seen_by(panoramas: NDArray[np.float16], *, least: float = 0.02) -> NDArray[np.bool_]:
    """Return the rows (rows,) that the survey LiDAR covers.

    Args:
        panoramas: (P, rows, around), metres; 0 where nothing was measured.
        least: share of measured cells above which a row counts as covered.
    """
    measured = (np.asarray(panoramas[:: max(1, len(panoramas) // 200)]) > 0).mean(axis=(0, 2))
    seen: NDArray[np.bool_] = measured > least
    return seen


def make_packs(
    plans: list[PackPlan],
    root: Path,
    grid: ViewGrid,
    *,
    workers: int | None = None,
    report: Callable[[str, int, int], None] = lambda *_: None,
) -> list[Path]:
    """Make the packs that do not exist yet, one city per process, and return all folders.

    Args:
        plans: the cities.
        root: folder of the packs.
        grid: the view grid.
        workers: number of processes; None for one per core.
        report: called with the name of the stage, cities done, and all cities to make.
    """
    root.mkdir(parents=True, exist_ok=True)
    folders = [root / plan.stem for plan in plans]
    missing = [plan for plan, folder in zip(plans, folders, strict=True) if not folder.exists()]
    if missing:
        report("training cities", 0, len(missing))
        with multiprocessing.get_context("spawn").Pool(workers or os.cpu_count(), maxtasksperchild=1) as pool:
            for done, _ in enumerate(pool.imap_unordered(partial(_make_in, root=root, grid=grid), missing), 1):
                report("training cities", done, len(missing))
    return folders


def _make_in(plan: PackPlan, root: Path, grid: ViewGrid) -> None:
    if not (root / plan.stem).exists():  # processes of a killed command end their city, and may have made it meanwhile
        make_pack(plan, root / plan.stem, grid)


def make_pack(plan: PackPlan, folder: Path, grid: ViewGrid) -> None:
    """Simulate a city and write its pack.

    The folder appears only when it is complete. Several processes may make the same city: their packs are equal, and one stays.

    Args:
        plan: the city.
        folder: folder to write.
        grid: the view grid.
    """
    city = City(seed=plan.seed, name=plan.name, size_m=plan.size_m)
    rng = np.random.default_rng([104729, plan.seed, plan.places])
    model, clear = LIDARS[plan.lidar], CONDITIONS["clear"]
    lidar_rays = model.rays()
    along = stations(city, 1.2, lane_m=0.0)
    chosen = [along[k] for k in rng.permutation(len(along))[: plan.places]]
    survey = Scene(joined([city.static, city.occupants(0)]))
    panoramas = np.zeros((len(chosen), grid.rows, grid.around), np.float16)
    intensities = np.zeros(panoramas.shape, np.uint8)
    places = np.zeros((len(chosen), 4))
    for k, station in enumerate(chosen):
        aside = rng.uniform(-2.2, 2.2)
        x, y = station.x + aside * np.sin(station.heading), station.y - aside * np.cos(station.heading)
        moved = type(station)(x, y, station.heading + (np.pi if rng.random() < 0.5 else 0.0), station.travelled)
        T = lidar_pose(city, moved, rng, height_m=plan.lidar_height_m + rng.normal(0, 0.08))
        points = scan(survey, city.ground, model, lidar_rays, T, clear, rng)
        level = level_scan(points[:, :3])
        levelled = np.c_[points[:, :3] @ level.R_level_sensor.T.astype(np.float32), points[:, 3]]
        panoramas[k], intensity = panorama_from_points(levelled, grid)
        intensities[k] = np.rint(255 * np.sqrt(intensity))
        R_map_level = T[:3, :3] @ level.R_level_sensor.T
        places[k] = (x, y, heading_of_body(np.vstack([np.c_[R_map_level, [0, 0, 0]], [0, 0, 0, 1]])), level.height_m)
    del survey
    arrays: dict[str, NDArray[np.generic]] = {
        "panoramas": panoramas,
        "intensities": intensities,
        "places": places,
        "rows_seen": rows_seen_by(panoramas),
    }
    arrays |= (_matched_queries if plan.rigs else _queries)(city, plan, places, grid, rng)
    part = folder.with_name(f"{folder.name}.{secrets.token_hex(4)}.part")
    part.mkdir(parents=True)
    try:
        for name, array in arrays.items():
            np.save(part / f"{name}.npy", array)
        part.rename(folder)
    except OSError:
        if not folder.exists():  # else another process has made the pack, and perhaps removed the folder of this one
            raise
    finally:
        shutil.rmtree(part, ignore_errors=True)
    for left in folder.parent.glob(f"{escape(folder.name)}.*part"):  # of killed processes
        shutil.rmtree(left, ignore_errors=True)


def _matched_queries(
    city: City, plan: PackPlan, places: NDArray[np.float64], grid: ViewGrid, rng: np.random.Generator
) -> dict[str, NDArray[np.generic]]:
    """Ranges and colour of stereo rigs. Every ``DRIVE_VIEWS`` views get new rectification errors."""
    total = len(places) * plan.queries_a_place
    ranges, queries = np.zeros((total, grid.rows, grid.columns), np.float16), np.zeros((total, 4))
    rgb, seen = np.zeros((*ranges.shape, 3), np.uint8), np.zeros(ranges.shape, np.bool_)
    order = rng.permutation(np.repeat(np.arange(len(places)), plan.queries_a_place))
    scene, traversal = Scene(joined([city.static])), -1
    for row, place in enumerate(order):
        if row % DRIVE_VIEWS == 0:
            rig = plan.rigs[row // DRIVE_VIEWS % len(plan.rigs)]
            if row * plan.queries_a_place // total != traversal:
                traversal = row * plan.queries_a_place // total
                scene = Scene(joined([city.static, city.occupants(OWN_DRIVES + traversal)]))
            drive = TraversalRig(rig, scene, city, rng)
        for _ in range(6):
            x, y, heading = _near(places[place], rng)
            roll, pitch = np.deg2rad(rng.normal(0, 0.6, 2))
            R = upright_on(city, x, y, heading) @ rotation_y(pitch) @ rotation_x(roll)
            T = transform_from(R, np.array([x, y, city.height(x, y) + rng.uniform(*rig.height_m)]))
            distances_m = scene.distances(T[:3, 3], (_COARSE @ R.T).astype(np.float32))
            distances_m = distances_m[distances_m > 0]
            if len(distances_m) and np.percentile(distances_m, 40) > 1.5:
                break
        view = drive.view(T, grid)
        ranges[row], rgb[row], seen[row] = view.ranges, view.rgb, view.seen
        queries[row] = (x, y, view.heading_rad, view.height_m)
    return {"ranges": ranges, "rgb": rgb, "queries": queries, "seen": seen}


def _queries(
    city: City, plan: PackPlan, places: NDArray[np.float64], grid: ViewGrid, rng: np.random.Generator
) -> dict[str, NDArray[np.generic]]:
    """Clean ranges and colour of query views: one ray per cell, near the cell's centre."""
    drives = max(1, plan.queries_a_place)
    total = len(places) * plan.queries_a_place
    ranges = np.zeros((total, grid.rows, grid.columns), np.float16)
    rgb = np.zeros((total, grid.rows, grid.columns, 3), np.uint8)
    queries = np.zeros((total, 4))
    cells = grid.rays_level().reshape(-1, 3)
    row = 0
    for drive in range(OWN_DRIVES, OWN_DRIVES + drives):  # each traversal has other vehicles, people, sun and clouds
        scene = Scene(joined([city.static, city.occupants(drive)]))
        light, clear = Light.of(CONDITIONS["clear"], rng), CONDITIONS["clear"]
        for place in places:
            for _ in range(6):
                x, y, heading = _near(place, rng)
                height = np.exp(rng.uniform(*np.log(plan.camera_height_m)))
                roll, pitch, yaw = np.deg2rad(rng.normal(0, [0.6, 0.6, 0.0]))
                R = upright_on(city, x, y, heading) @ rotation_z(yaw) @ rotation_y(pitch) @ rotation_x(roll)
                origin = np.array([x, y, city.height(x, y) + height])
                shaken = cells + rng.normal(0, 0.002, cells.shape)
                rays = (shaken @ R.T).astype(np.float32)
                hits = scene.hits(origin, rays)
                met = hits.distance[hits.distance > 0]
                if len(met) and np.percentile(met, 40) > 1.5:
                    break
            linear = shade(scene, city.ground, origin, rays, hits, light, clear, forward=R[:, 0])
            gain = rng.uniform(0.25, 0.6) / (float(linear.min(axis=1).mean()) + 1e-4)
            shape = (grid.rows, grid.columns)
            ranges[row] = np.where(hits.distance < 150, hits.distance, 0).reshape(shape)
            rgb[row] = np.clip(to_srgb(linear, gain), 0, 255).reshape(*shape, 3)
            queries[row] = (x, y, heading, height)
            row += 1
    return {"ranges": ranges, "rgb": rgb, "queries": queries}


def _near(place: NDArray[np.float64], rng: np.random.Generator) -> tuple[float, float, float]:
    """A query pose within 2 m of a place, mostly along the street in either direction."""
    angle, distance = rng.uniform(0, 2 * np.pi), 2.0 * np.sqrt(rng.random())
    x, y = place[0] + distance * np.cos(angle), place[1] + distance * np.sin(angle)
    heading = rng.uniform(-np.pi, np.pi)
    if rng.random() < 0.7:
        heading = place[2] + rng.choice([0.0, np.pi]) + np.deg2rad(rng.uniform(-20, 20))
    return float(x), float(y), float(heading)
