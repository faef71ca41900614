"""Dataset + encoder -> map bundle: level by PCA, cut the view fan, encode, gather the cloud, write the bundle.

What is finished is kept beside the output (``work``), so that a build that was killed goes on where it was and ends with the
bundle that it would have ended with.
"""

import os
import re
from collections.abc import Callable, Set
from dataclasses import replace
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path

import numpy as np

from model_training.datasets.dataset import Dataset, Transforms
from model_training.mapping.align_survey import aligned
from model_training.mapping.calibration_file import calibration_for
from model_training.mapping.cloud import near, prepared, with_cloud
from model_training.mapping.passes import moved
from model_training.mapping.places import Drive, Places, streets_of, views_of
from model_training.mapping.settings import BuildSettings
from model_training.mapping.site_check import HeldScan, held_out, site_of
from model_training.mapping.survey import (
    LevelledScan,
    fan,
    kept_scans,
    levelled_scans,
    require_poses_within,
    rows_seen_by,
    thinned,
    view_ranges,
)
from model_training.mapping.voxel_map import VoxelMap, lattice_origin
from model_training.mapping.work import Arrays, Work, key_of, work_beside
from service.errors import BundleError, DatasetError
from service.imaging.view_grid import ViewGrid
from service.localization.encoder import Encoder
from service.maps.calibration import Calibration, Site
from service.maps.content import BundleContent
from service.maps.manifest import NAME, Manifest
from service.maps.writer import write_bundle

__all__ = [
    "BuildSettings", "LevelledScan", "build_map", "describe", "fan", "levelled_scans", "thinned", "tool_versions", "view_ranges",
]  # fmt: skip

Report = Callable[[str, int, int], None]


def build_map(
    dataset: Dataset, encoder_file: Path, out: Path, settings: BuildSettings, *, overwrite: bool = False,
    threads: int | None = None, report: Report = lambda *_: None,
) -> Manifest:  # fmt: skip
    """Build a map bundle, or go on with a build of the same that was killed.

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
        BundleError: ``out`` exists and ``overwrite`` is not given, or another process is building it.
    """
    if out.exists() and not overwrite:  # said before the work, not after it
        raise BundleError(
            f"{out}: there is something of that name already; choose another, or overwrite it", field="out"
        )
    if not re.fullmatch(NAME, settings.name):
        raise DatasetError(
            f"name: {settings.name!r} cannot name a map; give --name of letters, digits, '.', '_' and '-'", field="name"
        )
    threads = threads or os.cpu_count() or 1
    encoder = Encoder.open(encoder_file, threads=threads)
    poses, kept = kept_scans(dataset, settings)
    require_poses_within(_cloud_around(poses, settings), poses, dataset)
    calibration = calibration_for(settings.calibration, encoder.sha256)
    apart: Set[int] = set() if calibration is None else held_out(len(kept))
    key = key_of(dataset, encoder.sha256, settings, threads=threads, held_out=len(apart))
    with work_beside(out, key) as work:
        grid = ViewGrid(rows=encoder.rows, columns=encoder.columns)
        rows_seen = work.part("rows", lambda: {"seen": rows_seen_by(dataset, kept, grid, settings)})["seen"]
        if settings.align_survey:
            given = poses
            poses = work.part("poses", lambda: {"aligned": aligned(dataset, given, kept, report=report)})["aligned"]
        drive = Drive(dataset, poses, kept, settings, encoder, grid, rows_seen)
        cloud = _cloud_around(poses, settings)
        places = drive.places(cloud, work, apart=apart, report=report)
        content = _content(drive, places, encoder_file)
        if calibration is not None:
            site = _checked(drive, places, content, cloud, calibration, apart, work, report)
            checked = calibration.model_copy(update={"site": site})
            content = replace(content, calibration=checked.model_dump(mode="json"))
        if settings.traffic_vote:
            gone = moved(cloud, dataset, poses, kept, settings, work, each_scan=True, report=report)
            cloud.keep(~np.isin(cloud.sums()[0], gone))
        if settings.passes_vote:
            gone = moved(cloud, dataset, poses, kept, settings, work, report=report)
            cloud.keep(~np.isin(cloud.sums()[0], gone))
        report("writing", 0, 2)
        content = with_cloud(content, cloud)
        report("writing", 1, 2)
        manifest = write_bundle(out, content, overwrite=overwrite)
        report("writing", 2, 2)
        return manifest


def _cloud_around(poses: Transforms, settings: BuildSettings) -> VoxelMap:
    """An empty cloud in the middle of a survey."""
    return VoxelMap(settings.voxel_m, lattice_origin(settings.voxel_m, poses[:, :3, 3].mean(axis=0)))


def _content(drive: Drive, places: Places, encoder_file: Path) -> BundleContent:
    """The map without its cloud and its calibration."""
    dataset, settings = drive.dataset, drive.settings
    lidar_height_m = float(np.median(places.height_m))
    T_map_place = places.at_height(lidar_height_m)
    streets = dataset.streets()
    votes = {"passes_vote": settings.passes_vote, "traffic_vote": settings.traffic_vote}
    done = {name: 1.0 for name, wanted in {**votes, "survey_aligned": settings.align_survey}.items() if wanted}
    return BundleContent(
        name=settings.name, grid=drive.grid, headings=settings.headings, spacing_m=settings.spacing_m, rows_seen=drive.rows_seen,
        T_map_place=T_map_place, place_street=streets_of(streets, T_map_place),
        view_place=views_of(len(T_map_place), settings.headings), view_heading_rad=places.heading_rad.ravel(),
        descriptors=places.descriptors, encoder=encoder_file.read_bytes(), streets=streets,
        georeference=dataset.description.georeference,
        calibration={"calibrated": False, "why": "no calibration fits this map's encoder; answers carry confidence null"},
        parameters={
            "lidar_height_m": lidar_height_m, "voxel_m": settings.voxel_m, "weather_removed": float(settings.remove_weather),
            "expected_lidar_height_m": settings.expected_lidar_height_m, "survey_scans": float(len(drive.poses)), **done,
        },
        licence=settings.licence,
        tool_versions=tool_versions(),
    )  # fmt: skip


def tool_versions() -> dict[str, str]:
    """What a map is made with."""
    return {name: version(name) for name in ("streetfix", "numpy", "faiss-cpu", "onnxruntime")}


def _checked(
    drive: Drive, places: Places, content: BundleContent, cloud: VoxelMap, calibration: Calibration, apart: Set[int], work: Work,
    report: Report,
) -> Site | None:  # fmt: skip
    """What the map without the scans apart says of its own confidence; then they go into the cloud."""
    if not apart:
        return None
    numbers = np.array(sorted(apart))
    scans = levelled_scans(drive.dataset, drive.kept[numbers], drive.settings)
    held = [HeldScan(int(k), scan.points, places.T_map_level[k]) for k, scan in zip(numbers, scans, strict=True)]

    def asked() -> Arrays:
        site = site_of(replace(content, cloud=prepared(cloud)), held, calibration, report)
        return {"site": np.frombuffer(site.model_dump_json().encode(), np.uint8)}

    name = f"site-{sha256(calibration.model_dump_json().encode()).hexdigest()[:16]}"
    site = Site.model_validate_json(work.part(name, asked)["site"].tobytes())
    for scan in held:
        cloud.add(*near(scan.points, scan.T_map_level))
    return site


def describe(manifest: Manifest) -> str:
    """One line about a bundle, for people."""
    counts = manifest.counts
    return (
        f"map {manifest.name}, version {manifest.version}: {counts.places} places, {counts.views} views, "
        f"{counts.cloud_points} cloud points, {counts.streets} street classes"
    )
