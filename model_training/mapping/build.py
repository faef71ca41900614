"""Dataset + encoder -> map bundle: level by PCA, cut the view fan, encode, gather the cloud, write the bundle."""

import math
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from model_training.mapping.calibration_file import calibration_for
from model_training.mapping.preview import preview_webp
from model_training.mapping.site_check import HeldScan, held_out, site_of
from model_training.mapping.voxel_map import Surfels, VoxelMap
from model_training.stock import CALIBRATION
from service.errors import BundleError, DatasetError
from service.geometry.rigid import heading_of_body, transform_from, transform_points
from service.imaging.pca import Level, level_scan, principal_heading
from service.imaging.view_grid import (
    LidarView,
    ViewGrid,
    panorama_from_points,
    survey_planes,
    view_from_panorama,
)
from service.imaging.weather import remove_weather_noise
from service.localization.encoder import Encoder
from service.maps.content import BundleContent
from service.maps.manifest import NAME, Manifest
from service.maps.streets import Streets
from service.maps.writer import write_bundle
from service.registration.surfel_map import SurfelMap

Report = Callable[[str, int, int], None]

SEEN_SHARE = 0.02  # a row of the grid is the survey's if at least this share of its cells is measured
CLOUD_REACH_M = 40.0


@dataclass(frozen=True, slots=True)
class BuildSettings:
    """How a map is built; all of it is in the manifest.

    Raises:
        DatasetError: a number makes no sense, naming the field.
    """

    name: str
    spacing_m: float = 1.0
    headings: int = 24
    voxel_m: float = 0.3
    expected_lidar_height_m: float = 1.8
    remove_weather: bool = False
    licence: str = ""
    calibration: Path | None = CALIBRATION

    def __post_init__(self) -> None:
        """Refuse what would end in an empty fan or a cloud without voxels."""
        lowest = {"spacing_m": 0.0, "headings": 1, "voxel_m": 0.01, "expected_lidar_height_m": 0.1}
        for field, least in lowest.items():
            value = getattr(self, field)
            if not least <= value < math.inf:
                raise DatasetError(f"{field}: {value:g} is not {least:g} or more; give a number that is", field=field)


@dataclass(frozen=True, slots=True)
class LevelledScan:
    """One kept scan: its number, level points with intensity (n, 4), level, and the principal heading that its fan starts at (rad)."""

    number: int
    points: NDArray[np.float32]
    level: Level
    start_rad: float


def build_map(
    dataset: Dataset, encoder_file: Path, out: Path, settings: BuildSettings, *, overwrite: bool = False,
    threads: int | None = None, report: Report = lambda *_: None,
) -> Manifest:  # fmt: skip
    """Build a map bundle.

    Args:
        dataset: with a survey.
        encoder_file: ONNX; it goes into the bundle.
        out: folder of the bundle; it appears whole or not at all.
        settings: spacing, fan, voxel.
        overwrite: replace a bundle that is there.
        threads: of the encoder; by default one a core.
        report: told after every place.

    Raises:
        DatasetError: the survey is empty or damaged.
        EncoderError: the encoder cannot be used.
        BundleError: ``out`` exists and ``overwrite`` is not given.
    """
    if out.exists() and not overwrite:  # said before the work, not after it
        raise BundleError(
            f"{out}: there is something of that name already; choose another, or overwrite it", field="out"
        )
    if not re.fullmatch(NAME, settings.name):
        raise DatasetError(
            f"name: {settings.name!r} cannot name a map; give --name of letters, digits, '.', '_' and '-'", field="name"
        )
    encoder = Encoder.open(encoder_file, threads=threads or os.cpu_count() or 1)
    grid = ViewGrid(rows=encoder.rows, columns=encoder.columns)
    poses = dataset.survey_poses()
    if not len(poses):
        raise DatasetError(
            f"{dataset.folder}/survey/poses.txt is empty: there is nothing to build a map of", field="survey"
        )
    kept = thinned(poses, settings.spacing_m)
    rows_seen = _rows_seen(dataset, kept, grid, settings)
    cloud = VoxelMap(settings.voxel_m, np.round(poses[:, :3, 3].mean(axis=0)))
    turns = fan(settings.headings)
    calibration = calibration_for(settings.calibration, encoder.sha256)
    apart = set() if calibration is None else held_out(len(kept))
    held: list[HeldScan] = []
    T_map_level = np.zeros((len(kept), 4, 4))
    heights, headings, descriptors = np.zeros(len(kept)), [], []
    for k, scan in enumerate(levelled_scans(dataset, kept, settings)):
        T = poses[scan.number] @ transform_from(scan.level.R_level_sensor.T, np.zeros(3))
        planes = np.stack([
            survey_planes(view, sensor_height_m=scan.level.height_m, rows_seen=rows_seen, grid=grid)
            for view in _fan_views(scan, turns, grid)
        ])  # fmt: skip
        descriptors.append(encoder.encode(planes, "survey"))
        headings.append((heading_of_body(T) + scan.start_rad + turns + np.pi) % (2 * np.pi) - np.pi)
        if k in apart:
            held.append(HeldScan(k, scan.points, T))
        else:
            cloud.add(_near(scan.points, T))
        T_map_level[k], heights[k] = T, scan.level.height_m
        report("places", k + 1, len(kept))
    lidar_height_m = float(np.median(heights))
    T_map_level[:, 2, 3] += lidar_height_m - heights  # so that the ground under each place lies that far below it
    streets = dataset.streets()
    content = BundleContent(
        name=settings.name, grid=grid, headings=settings.headings, spacing_m=settings.spacing_m, rows_seen=rows_seen,
        T_map_place=T_map_level, place_street=_streets_of(streets, T_map_level),
        view_place=np.repeat(np.arange(len(kept), dtype=np.int32), settings.headings), view_heading_rad=np.concatenate(headings),
        descriptors=np.concatenate(descriptors), encoder=encoder_file.read_bytes(), streets=streets,
        georeference=dataset.description.georeference,
        calibration={"calibrated": False, "why": "no calibration fits this map's encoder; answers carry confidence null"},
        parameters={
            "lidar_height_m": lidar_height_m, "voxel_m": settings.voxel_m, "weather_removed": float(settings.remove_weather),
            "expected_lidar_height_m": settings.expected_lidar_height_m, "survey_scans": float(len(poses)),
        },
        licence=settings.licence,
        tool_versions={name: version(name) for name in ("streetfix", "numpy", "faiss-cpu", "onnxruntime")},
    )  # fmt: skip
    if calibration is not None:
        site = None
        if held:
            site = site_of(replace(content, cloud=_prepared(cloud)), held, calibration, report)
            for scan_apart in held:
                cloud.add(_near(scan_apart.points, scan_apart.T_map_level))
        content = replace(content, calibration=calibration.model_copy(update={"site": site}).model_dump(mode="json"))
    surfels = cloud.surfels()
    preview = preview_webp(surfels.positions, surfels.normals, T_map_level[:, :3, 3])
    content = replace(content, cloud=_prepared(cloud, surfels), preview_webp=preview)
    return write_bundle(out, content, overwrite=overwrite)


def _near(points: NDArray[np.float32], T_map_level: NDArray[np.float64]) -> NDArray[np.float64]:
    """What of a levelled scan goes into the cloud, map frame."""
    xyz = points[:, :3]
    return transform_points(T_map_level, xyz[np.linalg.norm(xyz, axis=1) < CLOUD_REACH_M].astype(np.float64))


def _prepared(cloud: VoxelMap, surfels: Surfels | None = None) -> SurfelMap | None:
    found = cloud.surfels() if surfels is None else surfels
    return SurfelMap.prepare(cloud.origin, *cloud.tiles(found)) if len(found.positions) else None


def _streets_of(streets: dict[str, Any] | None, T_map_level: NDArray[np.float64]) -> NDArray[np.int32]:
    """Number of the street's feature under each place, -1 for none."""
    if streets is None:
        return np.full(len(T_map_level), -1, np.int32)
    polygons = Streets.from_geojson(streets)
    return np.array([polygons.index_at(xy) for xy in T_map_level[:, :2, 3]], np.int32)


def fan(headings: int) -> NDArray[np.float64]:
    """Turns of a place's views against its principal heading, radians."""
    return 2 * np.pi * np.arange(headings) / headings


def view_ranges(
    dataset: Dataset, settings: BuildSettings, grid: ViewGrid, rows_seen: NDArray[np.bool_]
) -> Iterator[NDArray[np.float32]]:
    """Range views (headings, rows, columns) of every place of the map that these settings build, in its order."""
    kept = thinned(dataset.survey_poses(), settings.spacing_m)
    turns = fan(settings.headings)
    for scan in levelled_scans(dataset, kept, settings):
        yield np.stack([view[0] for view in _fan_views(scan, turns, grid)]) * rows_seen[:, None]


def _fan_views(scan: LevelledScan, turns: NDArray[np.float64], grid: ViewGrid) -> Iterator[LidarView]:
    panorama = panorama_from_points(scan.points, grid)
    for turn in turns:
        yield view_from_panorama(panorama, scan.start_rad + float(turn), grid)


def thinned(poses: NDArray[np.float64], spacing_m: float) -> NDArray[np.int64]:
    """Numbers of the poses that stand ``spacing_m`` of travel, less a tenth for noisy poses, after the last one kept."""
    travelled = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))]
    kept, last = [0], 0.0
    for k in range(1, len(poses)):
        if travelled[k] - last >= 0.9 * spacing_m:
            kept.append(k)
            last = travelled[k]
    return np.array(kept)


def levelled_scans(dataset: Dataset, numbers: NDArray[np.int64], settings: BuildSettings) -> Iterator[LevelledScan]:
    """Scans one at a time, levelled by PCA, each with its principal heading."""
    for number in numbers:
        points = dataset.scan(int(number))
        if settings.remove_weather:
            points = points[remove_weather_noise(points[:, :3])]
        level = level_scan(points[:, :3], expected_height_m=settings.expected_lidar_height_m)
        levelled = np.c_[points[:, :3] @ level.R_level_sensor.T.astype(np.float32), points[:, 3]]
        yield LevelledScan(int(number), levelled, level, principal_heading(levelled[:, :3], height_m=level.height_m))


def _rows_seen(
    dataset: Dataset, kept: NDArray[np.int64], grid: ViewGrid, settings: BuildSettings, *, sample: int = 100
) -> NDArray[np.bool_]:
    """Rows that the survey's sensor covers, from a sample of its scans; what it never sees is cut from queries too."""
    chosen = kept[:: max(1, len(kept) // sample)]
    measured = np.zeros(grid.rows)
    for scan in levelled_scans(dataset, chosen, settings):
        measured += (panorama_from_points(scan.points, grid)[0] > 0).mean(axis=1)
    seen: NDArray[np.bool_] = measured / len(chosen) > SEEN_SHARE
    if not seen.any():
        raise DatasetError(
            f"{dataset.folder}: the scans have no points between {grid.elevation_bottom_deg:g} and {grid.elevation_top_deg:g} degrees "
            f"of elevation within {grid.max_range_m:g} m: check units and axes (metres, z up)", field="survey",
        )  # fmt: skip
    return seen


def describe(manifest: Manifest) -> str:
    """One line about a bundle, for people."""
    counts = manifest.counts
    return (
        f"map {manifest.name}, version {manifest.version}: {counts.places} places, {counts.views} views, "
        f"{counts.cloud_points} cloud points, {counts.streets} street classes"
    )
