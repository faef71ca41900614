"""Build one tile of a tiled map. The result depends on nothing but the task, so any process on any machine may build it."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from model_training.datasets.survey_part import PartSource, SurveyPart
from model_training.mapping.build import write_from
from model_training.mapping.calibration_file import calibration_for
from model_training.mapping.places import SurveyTraversal
from model_training.mapping.seams import write_positions
from model_training.mapping.settings import BuildSettings
from model_training.mapping.site_check import held_out
from model_training.mapping.stages import ResumedStages
from model_training.mapping.tiles import TilePart
from model_training.mapping.work import key_of, work_beside
from service.errors import BundleError
from service.imaging.view_grid import ViewGrid
from service.maps.manifest import FILE
from service.retrieval.encoder import Encoder

#: Threads of a tile. More would change the order of sums, and with it the last bits. Tiles run side by side instead.
THREADS = 1
#: How long a tile waits for the process of an earlier attempt, seconds. It ends soon after its parent.
WAIT_S = 60.0
#: Share of each stage in the time of a tile, in order: 3,100 scans of a simulated city, one core.
_SHARES = {"survey": 0.2, "places": 0.5, "site check": 0.05, "traffic": 0.1, "passes": 0.1, "writing": 0.05}

#: Progress callback: finished share of the tile, 0 to 1.
Share = Callable[[float], None]


@dataclass(frozen=True, slots=True, eq=False)
class CommonValues:
    """What all tiles of a map have in common. A sample of the survey gives these values once.

    Attributes:
        rows_seen: True for the rows of the view grid that the LiDAR covers (rows,).
        lidar_height_m: nominal height of the LiDAR above the ground, metres.
    """

    rows_seen: NDArray[np.bool_]
    lidar_height_m: float


@dataclass(frozen=True, slots=True, eq=False)
class TileTask:
    """All that a process needs to build a tile. It can be pickled.

    Attributes:
        dataset: where the scans of the tile are.
        encoder_file: the encoder, ONNX.
        settings: settings of the map.
        numbers: indices of the tile's scans in the survey (K,).
        poses: their given T_map_lidar (K, 4, 4).
        part: which places and which points of these scans the tile has.
        common: what all tiles have in common.
        key: hash of all inputs (``key_of_tile``), as the process that planned the tiles found it.
        folder: folder of the finished tile's bundle. Its name contains the key.
    """

    dataset: PartSource
    encoder_file: Path
    settings: BuildSettings
    numbers: NDArray[np.int64]
    poses: NDArray[np.float64]
    part: TilePart
    common: CommonValues
    key: str
    folder: Path

    @property
    def name(self) -> str:
        """Name of the tile in messages."""
        return f"tile {self.part.square.column}, {self.part.square.row}"

    @property
    def scratch(self) -> Path:
        """Folder for scans that come from a store, while the tile is built."""
        return self.folder.with_name(f".{self.folder.name}.scans")

    @property
    def positions_file(self) -> Path:
        """File of the aligned positions of the scans, beside the folder of the tile."""
        return self.folder.with_name(f"{self.folder.name}.positions.npy")

    @property
    def is_finished(self) -> bool:
        """Whether the bundle is there."""
        return (self.folder / FILE).is_file()


def key_of_tile(
    dataset: SurveyPart, encoder_sha256: str, settings: BuildSettings, part: TilePart, common: CommonValues
) -> str:
    """Return a hash of all inputs of a tile. Scans outside its part do not count.

    Args:
        dataset: the scans of the tile.
        encoder_sha256: SHA-256 of the encoder, hexadecimal.
        settings: settings of the map.
        part: which places and which points of these scans the tile has.
        common: what all tiles have in common.

    Raises:
        DatasetError: the folder of the scans cannot be read.
    """
    made_of = (
        part.square,
        part.area.beside,
        part.survey_scans,
        part.order.tolist(),
        part.travelled_m.tolist(),
        part.plan.at_scan.tolist(),
        sorted(part.plan.on_way.items()),
        common.rows_seen.tolist(),
        common.lidar_height_m,
    )
    # What the parts of a bundle do not depend on changes the finished tile.
    whole = (settings.name, settings.licence, settings.passes_vote)
    calibration = "" if settings.calibration is None else settings.calibration.read_bytes().hex()
    return key_of(
        dataset,
        encoder_sha256,
        settings,
        threads=THREADS,
        tile=repr(made_of),
        whole=repr(whole),
        calibration=calibration,
        streets=json.dumps(dataset.streets(), sort_keys=True),
    )


def build_tile(task: TileTask, share: Share = lambda _: None) -> None:
    """Build the bundle of a tile, or continue a killed build of it.

    Args:
        task: all inputs, and the output folder.
        share: called with the finished share of the tile.

    Raises:
        DatasetError: a scan is damaged, or cannot be fetched.
        EncoderError: the encoder cannot be used.
        BundleError: the bundle cannot be written, or this process sees other inputs than the one that planned the tiles.
    """
    with threadpool_limits(limits=THREADS), work_beside(task.folder, task.key, wait_s=WAIT_S) as work:
        if task.is_finished:  # by an earlier attempt that this one has just waited for
            shutil.rmtree(task.scratch, ignore_errors=True)
            return
        dataset = task.dataset.part(task.numbers, task.poses, scratch=task.scratch)
        encoder = Encoder.open(task.encoder_file, threads=THREADS)
        found = key_of_tile(dataset, encoder.sha256, task.settings, task.part, task.common)
        require_planned(task.name, found, task.key, inputs="other scans, another encoder")
        calibration = calibration_for(task.settings.calibration, encoder.sha256)
        at_scan = np.flatnonzero(task.part.plan.at_scan)
        # The check asks the tile alone, so it holds out places whose surroundings are all in its cloud.
        inner = at_scan[task.part.area.surrounds(task.poses[at_scan][:, :2, 3])]
        apart = set() if calibration is None else set(inner[sorted(held_out(len(inner)))].tolist())
        kept = np.arange(len(task.numbers))
        dataset.prepare()
        stages = ResumedStages(work, dataset, kept, task.settings, shares_of_stages(task.settings, share), task.part)
        aligned = stages.poses(task.poses)
        write_positions(task.positions_file, aligned[:, :3, 3])
        drive = SurveyTraversal(
            dataset,
            aligned,
            kept,
            task.settings,
            encoder,
            ViewGrid(rows=encoder.rows, columns=encoder.columns),
            task.common.rows_seen,
            task.part,
        )
        write_from(
            stages,
            drive,
            task.encoder_file,
            task.folder,
            calibration,
            apart,
            lidar_height_m=task.common.lidar_height_m,
        )
        dataset.release()


def require_planned(tile: str, found: str, planned: str, *, inputs: str) -> None:
    """Refuse a tile whose inputs are not those that it was planned with.

    Args:
        tile: name of the tile.
        found: hash of all inputs, as the process of the tile finds it.
        planned: the same hash, as the process that planned the tiles found it.
        inputs: which inputs may differ, for the error.

    Raises:
        BundleError: the hashes differ.
    """
    if found != planned:
        raise BundleError(
            f"{tile}: this process reads {inputs} or another release of streetfix than the process that planned the tiles; use one "
            "release and one shared folder on all machines, and do not change the dataset until the map is complete",
            field="dataset",
        )


def shares_of_stages(settings: BuildSettings, share: Share) -> Callable[[str, int, int], None]:
    """Return a progress callback of stages that reports the share of the tile.

    Args:
        settings: settings of the map. They say which stages there are.
        share: called with the finished share of the tile, 0 to 1.
    """
    absent = {
        "survey": not settings.align_survey,
        "traffic": not settings.traffic_vote,
        "passes": not settings.passes_vote,
    }
    weights = {stage: 0.0 if absent.get(stage) else weight for stage, weight in _SHARES.items()}
    total, before, begin = sum(weights.values()), 0.0, {}
    for stage, weight in weights.items():
        begin[stage], before = before, before + weight

    def report(stage: str, done: int, steps: int) -> None:
        share((begin[stage] + weights[stage] * done / max(steps, 1)) / total)

    return report
