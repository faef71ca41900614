"""``streetfix map update`` of a tiled map: a new survey changes only the tiles that it reaches. The other tiles stay the same files."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from model_training.datasets.dataset import Dataset
from model_training.datasets.stored_survey import source_of
from model_training.mapping.area import Area
from model_training.mapping.build_tile import THREADS
from model_training.mapping.join import joined_streets
from model_training.mapping.settings import BuildSettings
from model_training.mapping.stages import ResumedStages
from model_training.mapping.stored_map import streets_of_bundle
from model_training.mapping.survey import kept_scans
from model_training.mapping.tile_tasks import finish_tiles, folder_of, is_of_tile
from model_training.mapping.tiled_care import ColumnRow, tiles_of
from model_training.mapping.tiles import TilePart, places_xy, tile_parts
from model_training.mapping.update import Replacement, in_frame_of, require_rows
from model_training.mapping.update_tile import TileUpdate, UpdateTask, memory_of, update_tile
from model_training.mapping.work import key_of, work_beside
from model_training.tasks.engines import Engine, require_engine
from service.errors import BundleError
from service.maps.manifest import Manifest, read_manifest
from service.maps.reader import MapBundle
from service.maps.tiled_writer import require_lattice, write_tiled
from service.maps.tiles import TiledMap
from service.retrieval.encoder import Encoder

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]


def update_tiled(
    old: Path,
    dataset: Dataset,
    out: Path,
    *,
    replace_covered: bool = False,
    replace_area: Path | None = None,
    passes_vote: bool = False,
    overwrite: bool = False,
    engine: Engine = "local",
    workers: int | None = None,
    report: Report = lambda *_: None,
    warn: Callable[[str], None] = lambda _: None,
) -> Manifest:
    """Add a survey to a tiled map, or replace a part of the map with it; return the new manifest.

    Each tile within reach of the survey is updated as ``update_map`` updates a bundle, with the scans that it reads. A square without a
    tile gets one if the survey has a place there. A tile without a place left is dropped. All other tiles stay the same files. A killed
    update keeps its finished tiles. The number of processes and the engine do not change the result.

    Args:
        old: folder of the tiled map. It is not changed.
        dataset: the dataset with the survey. If it has another georeference than the map, it is moved into the frame of the map.
        out: folder of the new map. It appears complete or not at all.
        replace_covered: replace the part that the survey covered.
        replace_area: GeoJSON file of a polygon, metres, map frame; replace the part inside it. None replaces no polygon.
        passes_vote: remove voxels that more passes of the survey see through than hit. The map counts as one pass that hit its voxels.
        overwrite: replace an existing map at ``out``.
        engine: updates the tiles: ``local`` in processes of this machine, ``ray`` as tasks of Ray.
        workers: number of tiles at the same time; None takes as many as cores and memory allow.
        report: progress callback.
        warn: called with a line of text if a process dies.

    Raises:
        BundleError: the map is damaged, ``out`` exists and ``overwrite`` is False, streets contradict each other, or another process
            works on ``out``. The tiles differ in ``voxel_m`` or ``between_m``. The processes of a tile died.
        DatasetError: the survey is empty, damaged or without a known place in the map. Its LiDAR misses too many rows that the map's
            LiDAR sees. The polygon file is not valid. None of the new places lies in the area to replace. ``engine`` or ``workers`` is not
            valid.
        ExtraMissingError: the engine is not installed.
    """
    if out.exists() and not overwrite:
        raise BundleError(f"{out}: already exists; choose another --out, or pass --overwrite", field="out")
    require_engine(engine, workers)
    whole = TiledMap.open(old)
    dataset = in_frame_of(dataset, whole)
    _require_common(whole)
    require_lattice(
        [old / tile.folder for tile in whole.manifest.tiles[:1]]
    )  # the writer has checked those of several tiles
    replacement = Replacement.of(replace_covered, replace_area)
    # The streets of an updated tile must be those of the other tiles, so a survey cannot change a street here.
    streets = joined_streets(streets_of_bundle(whole), dataset.streets())
    settings = BuildSettings.of_map(whole.manifest, passes_vote=passes_vote)
    encoder = Encoder.open(whole.encoder_bytes(), threads=THREADS)
    poses, kept = kept_scans(dataset, settings)
    replacement.require_places(places_xy(poses[kept], settings.between_m))
    tiles, tile_m, path = tiles_of(whole.manifest), whole.manifest.tile_m or 0.0, old.resolve()
    key = key_of(
        dataset, encoder.sha256, settings, threads=THREADS, map=whole.manifest.version, replaced=replacement.key
    )
    with work_beside(out, key, also=is_of_tile) as work:
        seen = ResumedStages(work, dataset, kept, settings, report).rows_seen(whole.grid)
        require_rows(seen, whole, dataset)

        def planned(present: Iterable[ColumnRow]) -> list[UpdateTask]:
            """Plan the tiles that change, if these squares have a tile after the update."""
            parts = tile_parts(
                poses, kept, tile_m=tile_m, between_m=settings.between_m, voxel_m=settings.voxel_m, also=present
            )
            changed = [
                part
                for part in parts
                if len(part.order)
                or (_square(part) in tiles and _has_any(old / tiles[_square(part)].folder, replacement.inside))
            ]
            found = []
            for done, part in enumerate(changed):
                own, numbers = tiles.get(_square(part)), kept[part.order]
                folder = path / (own or whole.manifest.tiles[0]).folder
                update = TileUpdate(
                    old=folder,
                    beside=None
                    if own
                    else tuple(path / tiles[each].folder for each in tiles if part.area.may_share(each)),
                    source=source_of(dataset, numbers),
                    settings=BuildSettings.of_map(read_manifest(folder), passes_vote=passes_vote),
                    numbers=numbers,
                    poses=poses[numbers],
                    part=part,
                    replace_covered=replace_covered,
                    replace_area=None if replace_area is None else replace_area.resolve(),
                    streets=streets,
                )
                tile_key = update.key(update.survey(dataset.folder))
                found.append(UpdateTask(update, tile_key, folder_of(work, part.square, tile_key)))
                report("planning tiles", done + 1, len(changed))
            return found

        def finish(tasks: list[UpdateTask]) -> None:
            finish_tiles(
                engine,
                tasks,
                update_tile,
                work,
                memory_of=memory_of,
                remedy="give fewer --workers",
                workers=workers,
                report=report,
                warn=warn,
            )

        tasks = planned(tiles)
        finish(tasks)
        if dropped := {_square(task.update.part) for task in tasks if task.no_place_left.is_file()}:
            # The tiles around a dropped one were updated as if it had the surfaces of its square.
            known = {task.key for task in tasks}
            again = [task for task in planned(tiles.keys() - dropped) if task.key not in known]
            replaced = dropped | {_square(task.update.part) for task in again}
            if again:
                finish([*tasks, *again])
            tasks = [task for task in tasks if _square(task.update.part) not in replaced] + again
        folders = {square: old / tile.folder for square, tile in tiles.items() if square not in dropped}
        folders |= {_square(task.update.part): task.folder for task in tasks}
        report("joining tiles", 0, 1)
        manifest = write_tiled(
            out, folders, tile_m, name=whole.manifest.name, overwrite=overwrite, corrected=whole.calibration
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


def _square(part: TilePart) -> ColumnRow:
    return part.square.column, part.square.row


def _has_any(tile: Path, area: Area | None) -> bool:
    """Return whether a tile has a place or a surfel in an area."""
    if area is None:
        return False
    bundle = MapBundle.open(tile, verify=False)
    cloud = bundle.cloud
    of_cloud = np.zeros((0, 2)) if cloud is None else cloud.unpacked(np.s_[:])["xyz"][:, :2] + cloud.origin_m[:2]
    return bool(area(np.concatenate([bundle.T_map_place[:, :2, 3], of_cloud])).any())
