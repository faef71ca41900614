"""Build a map bundle from a dataset and an encoder.

The build levels each scan by PCA, renders its map views, encodes them, accumulates the cloud and writes the bundle.
Finished parts stay beside the output (``work``). A build that was killed continues from them and ends with the same bundle.
"""

import os
import re
from collections.abc import Callable, Set
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from model_training.datasets.dataset import Dataset, Transforms
from model_training.mapping.calibration_file import calibration_for
from model_training.mapping.cloud import prepared, with_cloud
from model_training.mapping.join import of_places
from model_training.mapping.places import Places, SurveyTraversal, streets_of, views_of
from model_training.mapping.settings import BuildSettings
from model_training.mapping.site_check import HeldScan, held_out, site_of
from model_training.mapping.stages import ResumedStages
from model_training.mapping.survey import kept_scans, levelled_scans, require_poses_within
from model_training.mapping.tile_area import overlap_m
from model_training.mapping.voxel_map import VoxelMap, lattice_origin
from model_training.mapping.work import key_of, work_beside
from service.errors import BundleError, DatasetError
from service.heap import trim
from service.imaging.view_grid import ViewGrid
from service.maps import inverted_file
from service.maps.calibration import Calibration, Site
from service.maps.content import BundleContent
from service.maps.manifest import NAME, Manifest
from service.maps.writer import write_bundle
from service.retrieval.encoder import Encoder

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]


def build_map(
    dataset: Dataset,
    encoder_file: Path,
    out: Path,
    settings: BuildSettings,
    *,
    overwrite: bool = False,
    threads: int | None = None,
    report: Report = lambda *_: None,
) -> Manifest:
    """Build a map bundle, or continue a killed build with the same inputs; return the manifest.

    Args:
        dataset: the dataset with the survey.
        encoder_file: the encoder, ONNX. The bundle gets a copy.
        out: folder of the bundle. It appears complete or not at all.
        settings: settings of the map.
        overwrite: replace an existing bundle.
        threads: number of threads of the encoder; None uses one per core.
        report: called after every place, and after every step of the other stages.

    Raises:
        DatasetError: the survey is empty or damaged, or ``settings.name`` is not a valid map name.
        EncoderError: the encoder cannot be used.
        BundleError: ``out`` exists and ``overwrite`` is False, or another process is building it.
    """
    require_new(out, settings.name, overwrite=overwrite)
    threads = threads or os.cpu_count() or 1
    encoder = Encoder.open(encoder_file, threads=threads)
    poses, kept = kept_scans(dataset, settings)
    require_poses_within(_cloud_around(poses, settings), poses, dataset)
    calibration = calibration_for(settings.calibration, encoder.sha256)
    apart: Set[int] = set() if calibration is None else held_out(len(kept))
    key = key_of(dataset, encoder.sha256, settings, threads=threads, held_out=len(apart))
    with work_beside(out, key) as work:
        dataset.fetch(kept, report)  # each stage reads them again
        stages = ResumedStages(work, dataset, kept, settings, report)
        # Rows of the view grid, and poses of the scans.
        grid = ViewGrid(rows=encoder.rows, columns=encoder.columns)
        rows_seen = stages.rows_seen(grid)
        poses = stages.poses(poses)
        drive = SurveyTraversal(dataset, poses, kept, settings, encoder, grid, rows_seen)
        return write_from(stages, drive, encoder_file, out, calibration, apart, overwrite=overwrite)


def write_from(
    stages: ResumedStages,
    drive: SurveyTraversal,
    encoder_file: Path,
    out: Path,
    calibration: Calibration | None,
    apart: Set[int],
    *,
    lidar_height_m: float | None = None,
    overwrite: bool = False,
) -> Manifest:
    """Build a bundle from a traversal with its final poses; return the manifest.

    Args:
        stages: the stages of the build.
        drive: the traversal, or the part of it that becomes a tile.
        encoder_file: the encoder, ONNX.
        out: folder of the bundle.
        calibration: the calibration of the encoder; None for a map without calibration.
        apart: indices of the kept scans that the site check holds out.
        lidar_height_m: height of the LiDAR above the ground, metres; None takes the median of the places.
        overwrite: replace an existing bundle.

    Raises:
        DatasetError: a scan is damaged.
        BundleError: the bundle cannot be written.
    """
    # 1. Places with their map views, and the voxel map of the points.
    places, cloud = stages.places(drive, _cloud_around(drive.poses, drive.settings), apart=apart)
    content = _content(drive, places, encoder_file, lidar_height_m)
    trim()  # reading the scans leaves much free memory between used blocks, and the grid needs large ones
    # 2. Confidence on this site, checked with scans that are not in the map yet.
    if calibration is not None:
        site = _checked(stages, drive, places, content, cloud, calibration, apart)
        checked = calibration.model_copy(update={"site": site})
        content = replace(content, calibration=checked.model_dump(mode="json"))
    # 3. Dynamic objects: traffic first, then what other passes see through.
    for wanted, each_scan in ((drive.settings.traffic_vote, True), (drive.settings.passes_vote, False)):
        if wanted:
            dynamic = stages.dynamic_voxels(cloud, drive.poses, each_scan=each_scan)
            cloud.keep(~np.isin(cloud.sums()[0], dynamic))
    # 4. The bundle.
    trim()
    stages.report("writing", 0, 2)
    content = with_cloud(content, cloud, None if drive.part is None else drive.part.area)
    stages.report("writing", 1, 2)
    manifest = write_bundle(out, content, overwrite=overwrite)
    stages.report("writing", 2, 2)
    return manifest


def require_new(out: Path, name: str, *, overwrite: bool) -> None:
    """Refuse an output or a name before the work, not after it.

    Args:
        out: folder of the bundle.
        name: name of the map.
        overwrite: whether an existing bundle may be replaced.

    Raises:
        BundleError: the folder exists.
        DatasetError: the name is not valid.
    """
    if out.exists() and not overwrite:
        raise BundleError(f"{out}: already exists; choose another --out, or pass --overwrite", field="out")
    if not re.fullmatch(NAME, name):
        raise DatasetError(
            f"name: {name!r} cannot name a map; give --name of letters, digits, '.', '_' and '-'", field="name"
        )


def _cloud_around(poses: Transforms, settings: BuildSettings) -> VoxelMap:
    """Return an empty voxel map with its origin in the middle of the survey."""
    return VoxelMap(settings.voxel_m, lattice_origin(settings.voxel_m, poses[:, :3, 3].mean(axis=0)))


def _content(drive: SurveyTraversal, places: Places, encoder_file: Path, lidar_height_m: float | None) -> BundleContent:
    """Return the content of the map without its cloud and its calibration."""
    dataset, settings, part = drive.dataset, drive.settings, drive.part
    if lidar_height_m is None:
        lidar_height_m = float(np.median(places.height_m))
    T_map_place = places.at_height(lidar_height_m)
    streets = dataset.streets()
    votes = {"passes_vote": settings.passes_vote, "traffic_vote": settings.traffic_vote}
    done = {name: 1.0 for name, wanted in {**votes, "survey_aligned": settings.align_survey}.items() if wanted}
    return BundleContent(
        name=settings.name,
        grid=drive.grid,
        headings=settings.headings,
        spacing_m=settings.spacing_m,
        rows_seen=drive.rows_seen,
        T_map_place=T_map_place,
        place_street=streets_of(streets, T_map_place),
        view_place=views_of(len(T_map_place), settings.headings),
        view_heading_rad=places.heading_rad.ravel(),
        descriptors=places.descriptors,
        encoder=encoder_file.read_bytes(),
        streets=streets,
        georeference=dataset.description.georeference,
        calibration={
            "calibrated": False,
            "why": "no calibration exists for the encoder of this map, so answers have no confidence",
        },
        parameters={
            "lidar_height_m": lidar_height_m,
            "voxel_m": settings.voxel_m,
            "weather_removed": float(settings.remove_weather),
            "expected_lidar_height_m": settings.expected_lidar_height_m,
            "survey_scans": float(len(drive.poses) if part is None else part.survey_scans),
            "between_m": settings.between_m,
            "places_between": float(places.between),
            **({} if part is None else {"tile_overlap_m": overlap_m(settings.voxel_m)}),
            **settings.survey_accuracy(dataset.description.survey_accuracy),
            **done,
        },
        licence=settings.licence,
        tool_versions=tool_versions(),
    )


def tool_versions() -> dict[str, str]:
    """Return the version of each package that builds a map, by name."""
    return {name: version(name) for name in ("streetfix", "numpy", "faiss-cpu", "onnxruntime")}


def _checked(
    stages: ResumedStages,
    drive: SurveyTraversal,
    places: Places,
    content: BundleContent,
    cloud: VoxelMap,
    calibration: Calibration,
    apart: Set[int],
) -> Site | None:
    """Run the site check on the map without the held-out scans, then add these scans to the cloud; None if none is held out."""
    if not apart:
        return None
    numbers = np.array(sorted(apart))
    scans = list(levelled_scans(drive.dataset, drive.kept[numbers], drive.settings))
    held = [HeldScan(scan.points, scan.T_map_level(drive.poses[scan.number])) for scan in scans]

    def rest() -> BundleContent:
        return replace(of_places(content, ~places.rendered_from(apart)), cloud=prepared(cloud))

    site = stages.site(calibration, lambda: site_of(rest, held, calibration, stages.report))
    for scan in scans:
        cloud.add(*drive.cloud_points(scan.points, scan.T_map_level(drive.poses[scan.number])))
    return site


def describe(manifest: Manifest) -> str:
    """Return one line of text about a bundle.

    Args:
        manifest: manifest of the bundle.
    """
    counts, recall = manifest.counts, manifest.parameters.get(inverted_file.RECALL)
    finds = manifest.parameters.get(inverted_file.FINDS_TILE)
    search = "" if recall is None else f", search index with recall@10 of {recall:.3f} against exact search"
    search += "" if finds is None else f" and the right tile among those that it chooses for {finds:.3f} of the queries"
    tiles = "" if manifest.tile_m is None else f", tiles of {manifest.tile_m:g} m: {len(manifest.tiles)}"
    return (
        f"map {manifest.name}, version {manifest.version}: {counts.places} places, {counts.views} views, "
        f"{counts.cloud_points} cloud points, {counts.streets} street classes{search}{tiles}"
    )
