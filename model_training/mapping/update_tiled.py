"""``streetfix map update`` of a tiled map: a new survey changes only the tiles that it reaches. The other tiles stay the same files."""

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from model_training.datasets.dataset import Dataset
from model_training.datasets.survey_part import SurveyPart
from model_training.mapping.area import Area
from model_training.mapping.build import tool_versions
from model_training.mapping.build_tile import Share, shares_of_stages
from model_training.mapping.build_tiled import TILE_PREFIX
from model_training.mapping.cloud import with_cloud
from model_training.mapping.join import joined_streets, of_places
from model_training.mapping.places import SurveyTraversal, streets_of
from model_training.mapping.settings import BuildSettings
from model_training.mapping.stages import ResumedStages
from model_training.mapping.stored_map import content_of, streets_of_bundle, voxel_edge_m, voxels_of
from model_training.mapping.survey import kept_scans
from model_training.mapping.tiled_care import Square, tiles_of
from model_training.mapping.tiles import TILE_MARGIN_M, TilePart, places_xy, tile_parts
from model_training.mapping.update import Replacement, in_frame_of, require_rows, updated, without
from model_training.mapping.voxel_map import MOMENTS, VoxelMap, lattice_origin
from model_training.mapping.work import BuildCache, key_of, work_beside
from service.errors import BundleError
from service.maps.content import BundleContent
from service.maps.manifest import FILE, Manifest, read_manifest
from service.maps.reader import MapBundle
from service.maps.tiled_writer import write_tiled
from service.maps.tiles import TiledMap
from service.maps.writer import write_bundle
from service.retrieval.encoder import Encoder

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]
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
        dataset: the dataset with the survey. If it has another georeference than the map, it is moved into the frame of the map.
        out: folder of the new map. It appears complete or not at all.
        replace_covered: replace the part that the survey covered.
        replace_area: GeoJSON file of a polygon, metres, map frame; replace the part inside it. None replaces no polygon.
        passes_vote: remove voxels that more passes of the survey see through than hit. The map counts as one pass that hit its voxels.
        overwrite: replace an existing map at ``out``.
        threads: number of threads of the encoder; None uses one per core.
        report: progress callback.

    Raises:
        BundleError: the map is damaged, ``out`` exists and ``overwrite`` is False, streets contradict each other, or another process
            works on ``out``. The tiles differ in ``voxel_m`` or ``between_m``.
        DatasetError: the survey is empty, damaged or without a known place in the map. Its LiDAR misses too many rows that the map's
            LiDAR sees. The polygon file is not valid. None of the new places lies in the area to replace.
    """
    if out.exists() and not overwrite:
        raise BundleError(f"{out}: already exists; choose another --out, or pass --overwrite", field="out")
    whole = TiledMap.open(old)
    dataset = in_frame_of(dataset, whole)
    _require_common(whole)
    replacement = Replacement.of(replace_covered, replace_area)
    # The streets of an updated tile must be those of the other tiles, so a survey cannot change a street here.
    streets = joined_streets(streets_of_bundle(whole), dataset.streets())
    settings = BuildSettings.of_map(whole.manifest, passes_vote=passes_vote)
    threads = threads or os.cpu_count() or 1
    encoder = Encoder.open(whole.encoder_bytes(), threads=threads)
    poses, kept = kept_scans(dataset, settings)
    replacement.require_places(places_xy(poses[kept], settings.between_m))
    tiles, tile_m = tiles_of(whole.manifest), whole.manifest.tile_m or 0.0
    key = key_of(
        dataset, encoder.sha256, settings, threads=threads, map=whole.manifest.version, replaced=replacement.key
    )
    with work_beside(out, key, also=_is_of_tile) as work:
        seen = ResumedStages(work, dataset, kept, settings, report).rows_seen(whole.grid)
        require_rows(seen, whole, dataset)
        folders: dict[Square, Path | None] = {square: old / tile.folder for square, tile in tiles.items()}
        changed = [
            part
            for part in tile_parts(poses, kept, tile_m=tile_m, between_m=settings.between_m, also=tiles)
            if len(part.order) or _has_any(old / tiles[_square(part)].folder, replacement.inside)
        ]
        progress = _Progress(changed, report)
        for part in changed:
            own, numbers = tiles.get(_square(part)), kept[part.order]
            tile = _Tile(
                old / (own or whole.manifest.tiles[0]).folder,
                None if own else [old / each.folder for square, each in tiles.items() if _touch(square, part)],
                SurveyPart(dataset.folder, numbers, poses[numbers]).moved(dataset.frame),
                part,
                passes_vote,
                encoder,
                replacement,
                streets,
                threads,
            )
            folders[_square(part)] = tile.updated(work.folder, progress)
            progress.finished(part)
        left = {square: folder for square, folder in folders.items() if folder is not None}
        report("joining tiles", 0, 1)
        manifest = write_tiled(
            out, left, tile_m, name=whole.manifest.name, overwrite=overwrite, corrected=whole.calibration
        )
        report("joining tiles", 1, 1)
        return manifest


def _require_common(whole: TiledMap) -> None:
    """Refuse a map whose tiles were built with different voxels or distances between places."""
    for name in ("voxel_m", "between_m"):
        values = {read_manifest(whole.path / tile.folder).parameters.get(name) for tile in whole.manifest.tiles}
        if len(values) > 1 or (name == "voxel_m" and values == {None}):
            found = ", ".join(sorted("none" if value is None else f"{value:g}" for value in values))
            raise BundleError(
                f"{whole.path}: its tiles have different {name} ({found}), so no survey can be added; build the map again with one value",
                field=name,
            )


@dataclass(frozen=True, slots=True, eq=False)
class _Tile:
    """The update of one tile.

    Attributes:
        old: folder of the tile. For a square without a tile, that of a tile to take the settings from.
        beside: None for a tile of the map. For a new one, folders of the tiles whose clouds reach into its margin.
        dataset: the scans of the survey that the tile reads.
        part: which places and which points of these scans the tile has.
        passes_vote: whether passes of the survey vote.
        encoder: encoder of the map.
        replacement: what the survey replaces.
        streets: streets of the map with those of the survey; None if there are none.
        threads: number of threads of the encoder.
    """

    old: Path
    beside: list[Path] | None
    dataset: SurveyPart
    part: TilePart
    passes_vote: bool
    encoder: Encoder
    replacement: Replacement
    streets: dict[str, Any] | None
    threads: int

    def updated(self, store: Path, share: Share) -> Path | None:
        """Return the folder of the new tile, which may be finished already; None if no place is left.

        Args:
            store: folder of the parts of the update.
            share: called with the finished share of the tile, 0 to 1.
        """
        bundle, part = MapBundle.open(self.old), self.part
        settings = BuildSettings.of_map(bundle.manifest, passes_vote=self.passes_vote)
        planned = (part.square, part.survey_scans, part.order.tolist(), part.travelled_m.tolist())
        places = (part.plan.at_scan.tolist(), sorted(part.plan.on_way.items()))
        key = key_of(
            self.dataset,
            self.encoder.sha256,
            settings,
            threads=self.threads,
            tile=repr((planned, places, self.passes_vote)),
            map=" ".join(path.name for path in (self.old, *(self.beside or ()))) + f" {self.beside is None}",
            replaced=self.replacement.key,
            streets=json.dumps(self.streets, sort_keys=True),
        )
        folder = store / f"{TILE_PREFIX}{part.square.column}_{part.square.row}_{key}"
        if (folder / FILE).is_file():
            return folder
        with work_beside(folder, key) as work:
            content, cloud = self._content(bundle, settings, work, shares_of_stages(settings, share))
            if not len(content.T_map_place):
                return None
            write_bundle(folder, with_cloud(replace(content, tool_versions=tool_versions()), cloud))
        return folder

    def _content(
        self, bundle: MapBundle, settings: BuildSettings, work: BuildCache, report: Report
    ) -> tuple[BundleContent, VoxelMap]:
        """Return the content of the new tile without a cloud, and its voxels."""
        poses, kept = self.dataset.survey_poses(), np.arange(len(self.part.order))
        content = replace(content_of(bundle), streets=self.streets)
        if self.beside is None:
            cloud = voxels_of(bundle)
        else:
            content = _without_places(content)
            origin = lattice_origin(voxel_edge_m(bundle), poses[:, :3, 3].mean(axis=0))
            cloud = _in_margin(self.beside, self.part, VoxelMap(voxel_edge_m(bundle), origin))
        if not len(kept):  # only the polygon reaches the tile
            area = self.replacement.inside
            content = content if area is None else without(content, cloud, area)
            return replace(content, place_street=streets_of(self.streets, content.T_map_place)), cloud
        stages = ResumedStages(work, self.dataset, kept, settings, report, self.part)
        drive = SurveyTraversal(
            self.dataset, stages.poses(poses), kept, settings, self.encoder, bundle.grid, bundle.rows_seen, self.part
        )
        return updated(stages, drive, content, cloud, self.replacement)


def _without_places(content: BundleContent) -> BundleContent:
    """Return the settings of a tile as the content of a new tile: without places, and without what was counted on them."""
    nothing = of_places(content, np.zeros(len(content.T_map_place), np.bool_))
    checked = content.calibration
    return replace(
        nothing,
        parameters={**content.parameters, **dict.fromkeys(_COUNTED, 0.0)},
        calibration={**checked, "site": None} if checked["calibrated"] else checked,
    )


def _in_margin(tiles: list[Path], part: TilePart, empty: VoxelMap) -> VoxelMap:
    """Return the voxels that some tiles have in the cloud of another one.

    Tiles store the points near their edges each on its own. So of a voxel that several have, the one with the most points is taken.
    """
    keys, moments = [np.zeros(0, np.int64)], [np.zeros((0, MOMENTS), np.float32)]
    for path in tiles:
        other = VoxelMap(empty.voxel_m, empty.origin)
        other.add_statistics(voxels_of(MapBundle.open(path)).statistics())
        inside = part.is_in_cloud(other.means())
        keys.append(other.sums()[0][inside])
        moments.append(other.sums()[1][inside])
    of_all, sums = np.concatenate(keys), np.concatenate(moments)
    order = np.lexsort((-sums[:, 0], of_all))
    first = order[np.unique(of_all[order], return_index=True)[1]]
    empty.add_sums(of_all[first], sums[first])
    return empty


class _Progress:
    """Add up the progress of the tiles, in scans.

    Args:
        parts: the tiles to update.
        report: progress callback.
    """

    def __init__(self, parts: list[TilePart], report: Report) -> None:
        self._report, self._stage = report, f"scans of {len(parts)} tiles"
        self._total, self._before = sum(len(part.order) for part in parts), 0
        self._scans = [len(part.order) for part in parts]

    def __call__(self, share: float) -> None:
        """Report the progress of the tile at work.

        Args:
            share: its finished share, 0 to 1.
        """
        self._report(self._stage, self._before + int(share * self._scans[0]), self._total)

    def finished(self, part: TilePart) -> None:
        """Go on to the next tile.

        Args:
            part: the finished tile.
        """
        self._before += len(part.order)
        self._scans.pop(0)
        self._report(self._stage, self._before, self._total)


def _touch(square: Square, part: TilePart) -> bool:
    """Return whether the cloud of a square's tile reaches into that of another tile."""
    away = max(abs(square[0] - part.square.column), abs(square[1] - part.square.row)) - 1
    return away * part.square.tile_m < 2 * TILE_MARGIN_M


def _square(part: TilePart) -> Square:
    return part.square.column, part.square.row


def _is_of_tile(name: str) -> bool:
    """Return whether a name among the parts of an update is that of a tile, or of the parts of a tile."""
    return name.removeprefix(".").startswith(TILE_PREFIX)


def _has_any(tile: Path, area: Area | None) -> bool:
    """Return whether a tile has a place or a surfel in an area."""
    if area is None:
        return False
    bundle = MapBundle.open(tile, verify=False)
    cloud = bundle.cloud
    of_cloud = np.zeros((0, 2)) if cloud is None else cloud.unpacked(np.s_[:])["xyz"][:, :2] + cloud.origin_m[:2]
    return bool(area(np.concatenate([bundle.T_map_place[:, :2, 3], of_cloud])).any())
