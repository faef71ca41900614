"""Update one tile of a tiled map. The result depends on nothing but the task, so any process on any machine may update it."""

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from model_training.datasets.survey_part import PartSource, SurveyPart
from model_training.mapping import engines
from model_training.mapping.build import Report, tool_versions
from model_training.mapping.build_tile import THREADS, WAIT_S, Share, require_planned, shares_of_stages
from model_training.mapping.cloud import with_cloud
from model_training.mapping.join import of_places
from model_training.mapping.places import SurveyTraversal, streets_of
from model_training.mapping.settings import BuildSettings
from model_training.mapping.stages import ResumedStages
from model_training.mapping.stored_map import content_of, voxel_edge_m, voxels_in, voxels_of
from model_training.mapping.tiles import TilePart
from model_training.mapping.update import Replacement, updated, without
from model_training.mapping.voxel_map import VoxelMap, lattice_origin
from model_training.mapping.work import BuildCache, key_of, work_beside
from service.maps.content import BundleContent
from service.maps.manifest import FILE, read_manifest
from service.maps.reader import MapBundle
from service.maps.writer import write_bundle
from service.retrieval.encoder import Encoder

#: Parameters of a tile that count something.
_COUNTED = ("survey_scans", "places_between")
#: Memory for each surfel of an old tile: its voxel sums, and the surfels that are made of them again, bytes (decision 0196).
SURFEL_BYTES = 512


@dataclass(frozen=True, slots=True, eq=False)
class TileUpdate:
    """All inputs of a tile's update. They can be pickled.

    Attributes:
        old: folder of the tile. For a square without a tile, that of a tile to take the settings from.
        beside: None for a tile of the map. For a new one, folders of the tiles whose clouds reach into its own.
        source: where the scans of the tile are. Their poses are in the frame of the map.
        settings: settings of the tile.
        numbers: indices of the scans that the tile reads in the survey (K,).
        poses: their given T_map_lidar (K, 4, 4).
        part: which places and which points of these scans the tile has.
        replace_covered: replace the part that the survey covered.
        replace_area: GeoJSON file of the polygon to replace; None for no polygon.
        streets: streets of the map with those of the survey; None if there are none.
    """

    old: Path
    beside: tuple[Path, ...] | None
    source: PartSource
    settings: BuildSettings
    numbers: NDArray[np.int64]
    poses: NDArray[np.float64]
    part: TilePart
    replace_covered: bool
    replace_area: Path | None
    streets: dict[str, Any] | None

    def survey(self, scratch: Path) -> SurveyPart:
        """Return the scans that the tile reads.

        Args:
            scratch: folder for files that come from a store.

        Raises:
            DatasetError: the dataset cannot be opened.
        """
        return self.source.part(self.numbers, self.poses, scratch=scratch)

    def replacement(self) -> Replacement:
        """Return what the survey replaces.

        Raises:
            DatasetError: the polygon file is not valid.
        """
        return Replacement.of(self.replace_covered, self.replace_area)

    def key(self, survey: SurveyPart) -> str:
        """Return a hash of all inputs, as this process finds them. Scans that the tile does not read do not count.

        Args:
            survey: the scans that the tile reads.

        Raises:
            DatasetError: the scans or the polygon file cannot be read.
            BundleError: the manifest of the tile cannot be read.
        """
        part = self.part
        planned = (part.square, part.area.beside, part.survey_scans, part.order.tolist(), part.travelled_m.tolist())
        places = (part.plan.at_scan.tolist(), sorted(part.plan.on_way.items()))
        return key_of(
            survey,
            read_manifest(self.old).encoder_sha256,
            self.settings,
            threads=THREADS,
            tile=repr((planned, places, self.settings.passes_vote)),
            # The name of a tile's folder is its version.
            map=" ".join(path.name for path in (self.old, *(self.beside or ()))) + f" {self.beside is None}",
            replaced=self.replacement().key,
            streets=json.dumps(self.streets, sort_keys=True),
        )


@dataclass(frozen=True, slots=True, eq=False)
class UpdateTask:
    """All that a process needs to update a tile. It can be pickled.

    Attributes:
        update: the inputs.
        key: their hash, as the process that planned the tiles found it.
        folder: folder of the finished tile's bundle. Its name contains the key.
    """

    update: TileUpdate
    key: str
    folder: Path

    @property
    def name(self) -> str:
        """Name of the tile in messages."""
        return f"tile {self.update.part.square.column}, {self.update.part.square.row}"

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Indices of the scans that the tile reads (K,)."""
        return self.update.numbers

    @property
    def scratch(self) -> Path:
        """Folder for scans that come from a store, while the tile is updated."""
        return self.folder.with_name(f".{self.folder.name}.scans")

    @property
    def no_place_left(self) -> Path:
        """File that says that the tile has no place left. Then there is no bundle."""
        return self.folder.with_name(f"{self.folder.name}.none")

    @property
    def is_finished(self) -> bool:
        """Whether the bundle is there, or no place is left."""
        return (self.folder / FILE).is_file() or self.no_place_left.is_file()


def memory_of(task: UpdateTask) -> int:
    """Return the memory that a process needs for the update of a tile, bytes: an upper estimate.

    Args:
        task: the tile.

    Raises:
        BundleError: a manifest cannot be read.
    """
    read = task.update.beside or (task.update.old,)  # one after the other
    surfels = max(read_manifest(path).counts.cloud_points for path in read)
    return engines.memory_of(task) + SURFEL_BYTES * surfels


def update_tile(task: UpdateTask, share: Share = lambda _: None) -> None:
    """Write the bundle of the new tile, or continue a killed update of it. Without a place left, there is no bundle.

    Args:
        task: all inputs, and the output folder.
        share: called with the finished share of the tile.

    Raises:
        DatasetError: a scan is damaged or cannot be fetched, or the polygon file is not valid.
        BundleError: the old tile is damaged, the new one cannot be written, or this process sees other inputs than the one that planned
            the tiles.
    """
    update = task.update
    with threadpool_limits(limits=THREADS), work_beside(task.folder, task.key, wait_s=WAIT_S) as work:
        if task.is_finished:  # by an earlier attempt that this one has just waited for
            shutil.rmtree(task.scratch, ignore_errors=True)
            return
        survey = update.survey(task.scratch)
        require_planned(task.name, update.key(survey), task.key, inputs="other scans, another map, another polygon")
        bundle = MapBundle.open(update.old)
        content, cloud = _before(update, bundle)
        if len(update.numbers):
            survey.prepare()
            report = shares_of_stages(update.settings, share)
            content, cloud = updated(
                *_traversal(update, survey, bundle, work, report), content, cloud, update.replacement()
            )
        else:
            content = _without_polygon(update, content, cloud)
        if len(content.T_map_place):
            area = update.part.area
            cloud.keep(area.is_in_cloud(cloud.means()))  # a new tile beside this one has the rest
            content = with_cloud(replace(content, tool_versions=tool_versions()), cloud, area)
            write_bundle(task.folder, content)
        else:
            task.no_place_left.touch()
        survey.release()


def _traversal(
    update: TileUpdate, survey: SurveyPart, bundle: MapBundle, work: BuildCache, report: Report
) -> tuple[ResumedStages, SurveyTraversal]:
    """Return the stages of the update, and the part of the survey that the tile reads."""
    kept = np.arange(len(update.numbers))
    stages = ResumedStages(work, survey, kept, update.settings, report, update.part)
    encoder = Encoder.open(bundle.encoder_bytes(), threads=THREADS)
    poses = stages.poses(update.poses)
    return stages, SurveyTraversal(
        survey, poses, kept, update.settings, encoder, bundle.grid, bundle.rows_seen, update.part
    )


def _before(update: TileUpdate, bundle: MapBundle) -> tuple[BundleContent, VoxelMap]:
    """Return the content of the tile before the update, without a cloud but with the new streets, and its voxels."""
    content = replace(content_of(bundle), streets=update.streets)
    if update.beside is None:
        return content, voxels_of(bundle)
    origin = lattice_origin(voxel_edge_m(bundle), update.poses[:, :3, 3].mean(axis=0))
    empty = VoxelMap(voxel_edge_m(bundle), origin)
    return _without_places(content), voxels_in(update.beside, update.part.area, empty)


def _without_polygon(update: TileUpdate, content: BundleContent, cloud: VoxelMap) -> BundleContent:
    """Return the content of a tile that only the polygon reaches: without its places there. ``cloud`` loses the voxels there."""
    area = update.replacement().inside
    content = content if area is None else without(content, cloud, area)
    return replace(content, place_street=streets_of(update.streets, content.T_map_place))


def _without_places(content: BundleContent) -> BundleContent:
    """Return the settings of a tile as the content of a new tile: without places, and without what was counted on them."""
    nothing = of_places(content, np.zeros(len(content.T_map_place), np.bool_))
    checked = content.calibration
    return replace(
        nothing,
        parameters={**content.parameters, **dict.fromkeys(_COUNTED, 0.0)},
        calibration={**checked, "site": None} if checked["calibrated"] else checked,
    )
