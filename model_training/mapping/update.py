"""``streetfix map update``: add a new survey to a map, or replace part of the map with it."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from model_training.mapping.area import Area, covered_by, polygon_of
from model_training.mapping.build import tool_versions
from model_training.mapping.cloud import with_cloud
from model_training.mapping.join import joined, joined_streets, of_places
from model_training.mapping.places import Places, SurveyTraversal, views_of
from model_training.mapping.settings import BuildSettings
from model_training.mapping.stages import ResumedStages
from model_training.mapping.stored_map import content_of, empty_voxels_of, streets_of_bundle, voxels_of
from model_training.mapping.survey import kept_scans, require_poses_within
from model_training.mapping.voxel_map import VoxelMap
from model_training.mapping.work import key_of, work_beside
from service.errors import BundleError, DatasetError
from service.maps.content import BundleContent
from service.maps.manifest import Manifest
from service.maps.map import Map
from service.maps.reader import MapBundle
from service.maps.writer import write_bundle
from service.retrieval.encoder import Encoder

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class Replacement:
    """What a survey replaces in a map.

    Attributes:
        covered: the part that it covered.
        polygon: GeoJSON file of a polygon, metres, map frame; the part inside it. None for no polygon.
        inside: the area of the polygon; None without one.
    """

    covered: bool
    polygon: Path | None
    inside: Area | None

    @classmethod
    def of(cls, covered: bool, polygon: Path | None) -> "Replacement":
        """Read the polygon.

        Args:
            covered: replace the part that the survey covered.
            polygon: GeoJSON file; None for no polygon.

        Raises:
            DatasetError: the file is not valid.
        """
        return cls(covered, polygon, None if polygon is None else polygon_of(polygon))

    @property
    def replaces(self) -> bool:
        """Whether the survey replaces anything."""
        return self.covered or self.polygon is not None

    @property
    def key(self) -> str:
        """Text that identifies it in the key of a build."""
        return str(self.covered) if self.polygon is None else self.polygon.read_text()

    def require_places(self, positions: NDArray[np.float64]) -> None:
        """Refuse a polygon that the survey would leave empty.

        Args:
            positions: of the new places, metres, map frame, (P, 2) or (P, 3).

        Raises:
            DatasetError: none of them lies in the polygon.
        """
        if self.inside is not None and not self.inside(positions[:, :2]).any():
            raise DatasetError(
                f"{self.polygon}: no place of the new survey lies in the polygon, so the polygon would become empty; "
                "draw a polygon around the new survey, in metres of the map frame",
                field="area",
            )

    def area(self, points: NDArray[np.float64], track: NDArray[np.float64]) -> Area | None:
        """Return the area that is replaced; None if nothing is.

        Args:
            points: means of the survey's voxels, metres, map frame (n, 3).
            track: positions of its places and scans, metres, map frame (P, 3).
        """
        return self.inside if self.inside is not None or not self.covered else covered_by(points, track)


def update_map(
    old: Path,
    dataset: Dataset,
    out: Path,
    *,
    replace_covered: bool = False,
    replace_area: Path | None = None,
    passes_vote: bool = False,
    overwrite: bool = False,
    threads: int | None = None,
    report: Report = lambda *_: None,
) -> Manifest:
    """Add a survey to a map, with the encoder and the settings that the map was built with; return the new manifest.

    Without replacement, new places are added that keep the spacing to the old ones, and the new points are added to the cloud.
    With replacement, the old places and voxels are first removed where the new survey covered the ground, or inside the polygon. The
    mean of a voxel decides. Old views elsewhere still show the replaced part as it was. A killed update continues where it stopped.

    Args:
        old: folder of the bundle. It is not changed.
        dataset: the dataset with the survey. If it has another georeference than the map, it is moved into the frame of the map.
        out: folder of the new bundle. It appears complete or not at all.
        replace_covered: replace the part that the survey covered.
        replace_area: GeoJSON file of a polygon, metres, map frame; replace the part inside it. None replaces no polygon.
        passes_vote: remove voxels that more passes of the survey see through than hit. The map counts as one pass that hit its voxels.
        overwrite: replace an existing bundle at ``out``.
        threads: number of threads of the encoder; None uses one per core.
        report: called after every place, and after every step of the other stages.

    Raises:
        BundleError: the bundle is damaged, ``out`` exists and ``overwrite`` is False, streets contradict each other, or another process
            works on ``out``.
        DatasetError: the survey is empty, damaged, too far away or without a known place in the map. Its LiDAR misses too many rows that
            the map's LiDAR sees. The polygon file is not valid. None of the new places lies in the area to replace.
    """
    if out.exists() and not overwrite:
        raise BundleError(f"{out}: already exists; choose another --out, or pass --overwrite", field="out")
    bundle = MapBundle.open(old)
    dataset = in_frame_of(dataset, bundle)
    replacement = Replacement.of(replace_covered, replace_area)
    # Refuse contradicting streets before the work, not at its end.
    joined_streets(streets_of_bundle(bundle), dataset.streets(), newer=replacement.replaces)
    settings = BuildSettings.of_map(bundle.manifest, passes_vote=passes_vote)
    threads = threads or os.cpu_count() or 1
    encoder = Encoder.open(bundle.encoder_bytes(), threads=threads)
    poses, kept = kept_scans(dataset, settings)
    require_poses_within(empty_voxels_of(bundle), poses, dataset)
    key = key_of(
        dataset,
        encoder.sha256,
        settings,
        threads=threads,
        map=bundle.manifest.version,
        replaced=replacement.key,
    )
    with work_beside(out, key) as work:
        dataset.fetch(kept, report)  # each stage reads them again
        stages = ResumedStages(work, dataset, kept, settings, report)
        require_rows(stages.rows_seen(bundle.grid), bundle, dataset)
        drive = SurveyTraversal(dataset, stages.poses(poses), kept, settings, encoder, bundle.grid, bundle.rows_seen)
        content, cloud = updated(stages, drive, content_of(bundle), voxels_of(bundle), replacement)
        report("writing", 0, 2)
        whole = with_cloud(replace(content, tool_versions=tool_versions()), cloud)
        report("writing", 1, 2)
        manifest = write_bundle(out, whole, overwrite=overwrite)
        report("writing", 2, 2)
        return manifest


def updated(
    stages: ResumedStages, drive: SurveyTraversal, content: BundleContent, cloud: VoxelMap, replacement: Replacement
) -> tuple[BundleContent, VoxelMap]:
    """Add a survey to the content of a map, or to that of a tile; return the new content, without a cloud, and its voxels.

    Args:
        stages: the stages of the build.
        drive: the survey, or the part of it that belongs to a tile.
        content: content of the map without its cloud.
        cloud: voxels of the map. They are changed.
        replacement: what the survey replaces.

    Raises:
        BundleError: streets or calibrations contradict each other.
        DatasetError: a scan is damaged, or a polygon has no place of the survey.
    """
    places, fresh = stages.places(drive, VoxelMap(cloud.voxel_m, cloud.origin))
    if drive.part is None:  # a tile may have none in the polygon
        replacement.require_places(places.T_map_level[:, :3, 3])
    if drive.settings.traffic_vote:
        dynamic = stages.dynamic_voxels(fresh, drive.poses, each_scan=True)
        fresh.keep(~np.isin(fresh.sums()[0], dynamic))
    track = np.concatenate([places.T_map_level[:, :3, 3], drive.poses[drive.kept][:, :3, 3]])
    area = replacement.area(fresh.means(), track)
    if area is not None:
        content = without(content, cloud, area)
    earlier = cloud.sums()[0].copy()
    cloud.add_sums(*fresh.sums())
    if drive.settings.passes_vote:
        dynamic = stages.dynamic_voxels(cloud, drive.poses, each_scan=False, earlier=earlier)
        cloud.keep(~np.isin(cloud.sums()[0], dynamic))
    return joined(content, _content(drive, places, content), newer_streets=replacement.replaces), cloud


def without(content: BundleContent, cloud: VoxelMap, area: Area) -> BundleContent:
    """Return the content of a map without its places in an area, and remove its voxels there from ``cloud``.

    Args:
        content: content of the map.
        cloud: voxels of the map.
        area: the area.
    """
    cloud.keep(~area(cloud.means()[:, :2]))
    return of_places(content, ~area(content.T_map_place[:, :2, 3]))


def in_frame_of(dataset: Dataset, bundle: Map) -> Dataset:
    """Return a survey in the frame of a map.

    Args:
        dataset: the dataset with the survey.
        bundle: the map.

    Raises:
        DatasetError: the position on the Earth is known of one of the two only.
    """
    of_map, of_drive = bundle.manifest.georeference, dataset.description.georeference
    if (of_map is None) != (of_drive is None):
        raise DatasetError(
            f"{dataset.place}: the georeference of the dataset is {of_drive or 'missing'}, that of the map {bundle.path} is "
            f"{of_map or 'missing'}, so the survey has no known place in the map. If its poses are in the frame of the map, write the "
            "georeference of the map into dataset.json. Else import the survey with its georeference",
            field="georeference",
        )
    return dataset.in_frame(of_map)


def require_rows(rows_seen: NDArray[np.bool_], bundle: Map, dataset: Dataset) -> None:
    """Refuse a survey whose LiDAR misses more than a tenth of the rows that the map uses.

    A few rows at the upper and lower edge depend on chance. With more missing rows, the views would look like those of another sensor.

    Args:
        rows_seen: True for the rows of the view grid that the survey's LiDAR covers (rows,).
        bundle: the map.
        dataset: the dataset with the survey, for the error message.

    Raises:
        DatasetError: too many rows are missing.
    """
    missing = int((bundle.rows_seen & ~rows_seen).sum())
    if missing > 0.1 * bundle.rows_seen.sum():
        raise DatasetError(
            f"{dataset.place}: the LiDAR of the survey does not see {missing} of the {int(bundle.rows_seen.sum())} rows of the view grid "
            "that the map uses; use a LiDAR with at least the same vertical field of view, or build a separate map (build-map)",
            field="survey",
        )


def _content(drive: SurveyTraversal, places: Places, old: BundleContent) -> BundleContent:
    """Return the new traversal as a map of its own, with the encoder and the settings of the old map."""
    lidar_height_m = float(np.median(places.height_m)) if len(places.height_m) else old.parameters["lidar_height_m"]
    T_map_place = places.at_height(lidar_height_m)
    voted = {"passes_vote": 1.0} if drive.settings.passes_vote else {}
    return replace(
        old,
        T_map_place=T_map_place,
        place_street=np.full(len(T_map_place), -1, np.int32),
        streets=drive.dataset.streets(),
        view_place=views_of(len(T_map_place), old.headings),
        view_heading_rad=places.heading_rad.ravel(),
        descriptors=places.descriptors,
        parameters={
            **{name: value for name, value in old.parameters.items() if name != "passes_vote"},
            "lidar_height_m": lidar_height_m,
            "survey_scans": float(len(drive.poses) if drive.part is None else drive.part.survey_scans),
            "places_between": float(places.between),
            **voted,
        },
        calibration={**old.calibration, "site": None} if old.calibration["calibrated"] else old.calibration,
    )
