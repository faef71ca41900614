"""Build a tiled map: plan the tiles, build each of them, and put them together."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from model_training.datasets.dataset import Dataset
from model_training.datasets.stored_survey import source_of
from model_training.mapping.build import Report, require_new
from model_training.mapping.build_tile import THREADS, CommonValues, TileTask, build_tile, key_of_tile
from model_training.mapping.calibration_file import calibration_for
from model_training.mapping.engines import memory_of
from model_training.mapping.seams import read_positions, seams_of
from model_training.mapping.settings import BuildSettings
from model_training.mapping.survey import kept_scans, sampled_survey
from model_training.mapping.tile_tasks import finish_tiles, folder_of, is_of_tile
from model_training.mapping.tiles import require_tile_edge, tile_parts
from model_training.mapping.work import BuildCache, key_of, work_beside
from model_training.tasks.engines import Engine, require_engine
from service.imaging.view_grid import ViewGrid
from service.maps.manifest import Manifest
from service.maps.tiled_writer import write_tiled
from service.retrieval.encoder import Encoder


def build_tiled(
    dataset: Dataset,
    encoder_file: Path,
    out: Path,
    settings: BuildSettings,
    *,
    tile_m: float,
    engine: Engine = "local",
    workers: int | None = None,
    overwrite: bool = False,
    report: Report = lambda *_: None,
    warn: Callable[[str], None] = lambda _: None,
    tell: Callable[[str], None] = lambda _: None,
) -> Manifest:
    """Build a tiled map, or continue a killed build; return the manifest.

    The finished tiles stay beside the output until the map is complete. A tile is built again only if its own scans, the settings or
    the code have changed. The number of processes and the engine do not change the result.

    Args:
        dataset: the dataset with the survey.
        encoder_file: the encoder, ONNX. The map gets a copy.
        out: folder of the map. It appears complete or not at all.
        settings: settings of the map.
        tile_m: edge of the tiles, metres.
        engine: runs the tiles: ``local`` in processes of this machine, ``ray`` as tasks of Ray.
        workers: number of tiles at the same time; None takes as many as cores and memory allow.
        overwrite: replace an existing map.
        report: progress callback.
        warn: called with a line of text if a process dies, or if the tiles do not agree.
        tell: called with a line of text that says how well the tiles agree.

    Raises:
        DatasetError: the survey is empty or damaged, or ``tile_m``, ``workers`` or the name is not valid.
        ExtraMissingError: the engine is not installed.
        EncoderError: the encoder cannot be used.
        BundleError: ``out`` exists and ``overwrite`` is False, another process is building it, or the processes of a tile died.
    """
    require_new(out, settings.name, overwrite=overwrite)
    require_tile_edge(tile_m)
    require_engine(engine, workers)
    encoder = Encoder.open(encoder_file, threads=THREADS)
    calibration_for(settings.calibration, encoder.sha256)  # refuse a damaged file before the work
    with work_beside(out, key_of(dataset, encoder.sha256, settings, threads=THREADS), also=is_of_tile) as work:
        tasks = _tasks(dataset, encoder, encoder_file, settings, tile_m, work, report)
        finish_tiles(
            engine,
            tasks,
            build_tile,
            work,
            memory_of=memory_of,
            remedy="give fewer --workers or a smaller --tile-m",
            workers=workers,
            report=report,
            warn=warn,
        )
        report("joining tiles", 0, 1)
        if settings.align_survey:
            _compare(tasks, warn, tell)
        tiles = {(task.part.square.column, task.part.square.row): task.folder for task in tasks}
        manifest = write_tiled(out, tiles, tile_m, name=settings.name, overwrite=overwrite)
        report("joining tiles", 1, 1)
        return manifest


def _compare(tasks: Sequence[TileTask], warn: Callable[[str], None], tell: Callable[[str], None]) -> None:
    """Say how far the tiles disagree about the positions of scans that several of them have."""
    found = [(task.numbers, read_positions(task.positions_file)) for task in tasks]
    seams = seams_of([(numbers, positions_m) for numbers, positions_m in found if positions_m is not None])
    if seams is not None:
        tell(str(seams))
        if seams.warning is not None:
            warn(seams.warning)


def _tasks(
    dataset: Dataset,
    encoder: Encoder,
    encoder_file: Path,
    settings: BuildSettings,
    tile_m: float,
    work: BuildCache,
    report: Report,
) -> list[TileTask]:
    """Plan the tiles: which scans and places each of them has, and what all have in common."""
    poses, kept = kept_scans(dataset, settings)
    parts = list(tile_parts(poses, kept, tile_m=tile_m, between_m=settings.between_m, voxel_m=settings.voxel_m))
    grid = ViewGrid(rows=encoder.rows, columns=encoder.columns)

    def sampled() -> dict[str, Any]:
        seen, height_m = sampled_survey(dataset, kept, grid, settings)
        return {"rows_seen": seen, "lidar_height_m": np.array(height_m)}

    found = work.part("common", sampled)
    common = CommonValues(found["rows_seen"], float(found["lidar_height_m"]))
    tasks = []
    for done, part in enumerate(parts):
        numbers = kept[part.order]
        source = source_of(dataset, numbers)
        of_tile = source.part(numbers, poses[numbers], scratch=dataset.folder)
        key = key_of_tile(of_tile, encoder.sha256, settings, part, common)
        tasks.append(
            TileTask(
                source,
                encoder_file.resolve(),
                settings,
                numbers,
                poses[numbers],
                part,
                common,
                key,
                folder_of(work, part.square, key),
            )
        )
        report("planning tiles", done + 1, len(parts))
    return tasks
