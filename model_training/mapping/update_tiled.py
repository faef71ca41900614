"""``streetfix map update`` of a tiled map: a new survey changes only the tiles that it reaches. The other tiles stay the same files."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from model_training.datasets.dataset import Dataset
from model_training.datasets.survey_part import SurveyPart
from model_training.mapping.area import Area
from model_training.mapping.build import tool_versions
from model_training.mapping.cloud import with_cloud
from model_training.mapping.join import joined_streets, of_places
from model_training.mapping.places import Drive
from model_training.mapping.settings import BuildSettings
from model_training.mapping.stages import ResumedStages
from model_training.mapping.stored_map import content_of, streets_of_bundle, voxel_edge_m, voxels_of
from model_training.mapping.survey import kept_scans
from model_training.mapping.tiled_care import Square, tiles_of
from model_training.mapping.tiles import TILE_MARGIN_M, TilePart, tile_parts
from model_training.mapping.update import Replacement, require_frame, require_rows, updated, without
from model_training.mapping.voxel_map import VoxelMap, lattice_origin
from model_training.mapping.work import Work, key_of, work_beside
from service.errors import BundleError, DatasetError
from service.maps.content import BundleContent
from service.maps.manifest import FILE, Manifest
from service.maps.reader import MapBundle
from service.maps.tiled_writer import write_tiled
from service.maps.tiles import TiledMap
from service.maps.writer import write_bundle
from service.retrieval.encoder import Encoder

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]
#: Start of the name of a tile's folder among the parts of an update.
_TILE = "tile_"
#: Parameters of a tile that count something.
_COUNTED = ("survey_scans", "places_between")


def update_tiled(
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
    """Add a survey to a tiled map, or replace a part of the map with it; return the new manifest.

    Each tile within reach of the survey is updated as ``update_map`` updates a bundle, with the scans that it reads. A square without a
    tile gets one if the survey has a place there. A tile without a place left is dropped. All other tiles stay the same files. A killed
    update continues at the tile where it stopped.

    Args:
        old: folder of the tiled map. It is not changed.
        dataset: the dataset with the survey. Its poses must be in the map frame.
        out: folder of the new map. It appears complete or not at all.
        replace_covered: replace the part that the survey covered.
        replace_area: GeoJSON file of a polygon, metres, map frame; replace the part inside it. None replaces no polygon.
        passes_vote: remove voxels that more passes of the survey see through than hit. The map counts as one pass that hit its voxels.
        overwrite: replace an existing map at ``out``.
        threads: number of threads of the encoder; None uses one per core.
        report: called after every scan of each stage, with the tile in the name of the stage.

    Raises:
        BundleError: the map is damaged, ``out`` exists and ``overwrite`` is False, streets contradict each other, or another process
            works on ``out``.
        DatasetError: the survey is empty, damaged or in another frame. Its LiDAR misses too many rows that the map's LiDAR sees. The
            polygon file is not valid. None of the new places lies in the area to replace, or the map would have no place left.
    """
    if out.exists() and not overwrite:
        raise BundleError(f"{out}: already exists; choose another --out, or pass --overwrite", field="out")
    whole = TiledMap.open(old)
    require_frame(dataset, whole)
    replacement = Replacement.of(replace_covered, replace_area)
    # The streets of an updated tile must be those of the other tiles, so a survey cannot change a street here.
    joined_streets(streets_of_bundle(whole), dataset.streets())
    settings = BuildSettings.of_map(whole.manifest, passes_vote=passes_vote)
    threads = threads or os.cpu_count() or 1
    encoder = Encoder.open(whole.encoder_bytes(), threads=threads)
    poses, kept = kept_scans(dataset, settings)
    replacement.require_places(poses[kept])
    tiles, tile_m = tiles_of(whole.manifest), whole.manifest.tile_m or 0.0
    key = key_of(
        dataset, encoder.sha256, settings, threads=threads, map=whole.manifest.version, replaced=replacement.key
    )
    with work_beside(out, key, also=_is_of_tile) as work:
        seen = ResumedStages(work, dataset, kept, settings, report).rows_seen(whole.grid)
        require_rows(seen, whole, dataset)
        folders: dict[Square, Path | None] = {square: old / tile.folder for square, tile in tiles.items()}
        likeness = old / next(iter(tiles.values())).folder
        changed = [
            part
            for part in tile_parts(poses, kept, tile_m=tile_m, between_m=settings.between_m, also=tiles)
            if len(part.order) or _has_any(old / tiles[_square(part)].folder, replacement.inside)
        ]
        for number, part in enumerate(changed, 1):
            own, numbers = tiles.get(_square(part)), kept[part.order]
            tile = _Tile(
                None if own is None else old / own.folder,
                [old / tile.folder for square, tile in tiles.items() if _touch(square, _square(part))] or [likeness],
                SurveyPart(dataset.folder, numbers, poses[numbers]),
                part,
                settings,
                encoder,
                replacement,
                threads,
            )
            folders[_square(part)] = tile.updated(work.folder, _named(report, f"tile {number} of {len(changed)}: "))
        left = {square: folder for square, folder in folders.items() if folder is not None}
        if not left:
            raise DatasetError(
                f"{replace_area}: the map would have no place left; draw a smaller polygon", field="area"
            )
        rig = None if whole.calibration is None else whole.calibration.rig
        report("joining tiles", 0, 1)
        manifest = write_tiled(out, left, tile_m, name=whole.manifest.name, overwrite=overwrite, rig=rig)
        report("joining tiles", 1, 1)
        return manifest


@dataclass(frozen=True, slots=True, eq=False)
class _Tile:
    """The update of one tile.

    Attributes:
        old: folder of the tile; None if the square has none yet.
        beside: folders of the tiles around a square without a tile; at least one tile of the map. A new tile takes the settings of the
            first, and the old survey's points in its margin from all.
        dataset: the scans of the survey that the tile reads.
        part: which places and which points of these scans the tile has.
        settings: settings of the map.
        encoder: encoder of the map.
        replacement: what the survey replaces.
        threads: number of threads of the encoder.
    """

    old: Path | None
    beside: list[Path]
    dataset: SurveyPart
    part: TilePart
    settings: BuildSettings
    encoder: Encoder
    replacement: Replacement
    threads: int

    def updated(self, store: Path, report: Report) -> Path | None:
        """Return the folder of the new tile, which may be finished already; None if no place is left.

        Args:
            store: folder of the parts of the update.
            report: progress callback.
        """
        bundle = MapBundle.open(self.beside[0] if self.old is None else self.old)
        key = key_of(
            self.dataset,
            self.encoder.sha256,
            self.settings,
            threads=self.threads,
            tile=repr((self.part.square, self.old is None)),
            map=bundle.manifest.version if self.old is not None else " ".join(path.name for path in self.beside),
            replaced=self.replacement.key,
        )
        folder = store / f"{_TILE}{self.part.square.column}_{self.part.square.row}_{key}"
        if (folder / FILE).is_file():
            return folder
        with work_beside(folder, key) as work:
            content, cloud = self._content(bundle, work, report)
            if not len(content.T_map_place):
                return None
            write_bundle(folder, with_cloud(replace(content, tool_versions=tool_versions()), cloud))
        return folder

    def _content(self, bundle: MapBundle, work: Work, report: Report) -> tuple[BundleContent, VoxelMap]:
        """Return the content of the new tile without a cloud, and its voxels."""
        content, cloud = (content_of(bundle), voxels_of(bundle)) if self.old is not None else self._nothing(bundle)
        poses, kept = self.dataset.survey_poses(), np.arange(len(self.part.order))
        if not len(kept):  # only the polygon reaches the tile
            area = self.replacement.inside
            return (content if area is None else without(content, cloud, area)), cloud
        stages = ResumedStages(work, self.dataset, kept, self.settings, report, self.part)
        drive = Drive(
            self.dataset,
            stages.poses(poses),
            kept,
            self.settings,
            self.encoder,
            bundle.grid,
            bundle.rows_seen,
            self.part,
        )
        return updated(stages, drive, content, cloud, self.replacement)

    def _nothing(self, bundle: MapBundle) -> tuple[BundleContent, VoxelMap]:
        """Return the content of a new tile before the update: no place, and the points that the tiles around it have in its margin."""
        content = content_of(bundle)
        content = of_places(content, np.zeros(len(content.T_map_place), np.bool_))
        edge = voxel_edge_m(bundle)
        origin = lattice_origin(edge, self.dataset.survey_poses()[:, :3, 3].mean(axis=0))
        cloud = VoxelMap(edge, origin)
        for path in self.beside:
            other = VoxelMap(edge, origin)
            other.add_statistics(voxels_of(MapBundle.open(path)).statistics())
            keys, moments = other.sums()
            # Tiles store the points near their edges each on its own, so those of one tile are enough.
            wanted = self.part.square.within(TILE_MARGIN_M, other.means()) & ~np.isin(keys, cloud.sums()[0])
            cloud.add_sums(keys[wanted], moments[wanted])
        return replace(content, parameters={**content.parameters, **dict.fromkeys(_COUNTED, 0.0)}), cloud


def _touch(one: Square, other: Square) -> bool:
    """Return whether two squares have an edge or a corner in common."""
    return max(abs(one[0] - other[0]), abs(one[1] - other[1])) <= 1


def _square(part: TilePart) -> Square:
    return part.square.column, part.square.row


def _is_of_tile(name: str) -> bool:
    """Return whether a name among the parts of an update is that of a tile, or of the parts of a tile."""
    return name.removeprefix(".").startswith(_TILE)


def _has_any(tile: Path, area: Area | None) -> bool:
    """Return whether a tile has a place or a surfel in an area."""
    if area is None:
        return False
    bundle = MapBundle.open(tile, verify=False)
    cloud = bundle.cloud
    of_cloud = np.zeros((0, 2)) if cloud is None else cloud.surfels["xyz"][:, :2] + cloud.origin_m[:2]
    return bool(area(np.concatenate([bundle.T_map_place[:, :2, 3], of_cloud])).any())


def _named(report: Report, tile: str) -> Report:
    return lambda stage, done, steps: report(tile + stage, done, steps)
