"""The long stages of a map build. Each is a pure function; here, and only here, a finished result is read from the store instead."""

from collections.abc import Callable, Set
from dataclasses import dataclass
from functools import partial
from hashlib import sha256

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from model_training.mapping.align_survey import aligned
from model_training.mapping.passes import Vote
from model_training.mapping.places import Places, SurveyTraversal, gathered
from model_training.mapping.settings import BuildSettings
from model_training.mapping.survey import sampled_survey
from model_training.mapping.tiles import TilePart
from model_training.mapping.voxel_map import VoxelMap
from model_training.mapping.work import Arrays, BuildCache
from service.imaging.view_grid import ViewGrid
from service.maps.calibration import Calibration, Site

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class ResumedStages:
    """The stages of one build, with its store.

    Attributes:
        work: store for the finished parts.
        dataset: the dataset with the survey.
        kept: indices of the scans that become places (P,).
        settings: settings of the map.
        report: called after every scan of each stage.
        part: the part of the survey that becomes a tile; None for all of it.
    """

    work: BuildCache
    dataset: Dataset
    kept: NDArray[np.int64]
    settings: BuildSettings
    report: Report
    part: TilePart | None = None

    def rows_seen(self, grid: ViewGrid) -> NDArray[np.bool_]:
        """Return which rows of the view grid the LiDAR covers (rows,).

        Args:
            grid: the view grid.
        """
        return self.work.part(
            "rows", lambda: {"seen": sampled_survey(self.dataset, self.kept, grid, self.settings)[0]}
        )["seen"]

    def poses(self, given: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return T_map_lidar of all scans (n, 4, 4), aligned if the settings say so.

        Args:
            given: poses of the survey (n, 4, 4).
        """
        if not self.settings.align_survey:
            return given
        return self.work.part(
            "poses", lambda: {"aligned": aligned(self.dataset, given, self.kept, report=self.report)}
        )["aligned"]

    def places(
        self, drive: SurveyTraversal, empty: VoxelMap, *, apart: Set[int] = frozenset()
    ) -> tuple[Places, VoxelMap]:
        """Return the places of the survey and the voxel map of its points.

        Args:
            drive: the traversal.
            empty: an empty voxel map, whose lattice the points are gathered in.
            apart: indices of the kept scans whose points stay out of the voxel map.
        """
        report = partial(self._report_stage, "places")
        make = partial(drive.chunk, empty=empty, apart=apart, report=report)
        return gathered(self.work.chunks("places", len(self.kept), make, report), empty)

    def dynamic_voxels(
        self, cloud: VoxelMap, poses: NDArray[np.float64], *, each_scan: bool, earlier: NDArray[np.int64] | None = None
    ) -> NDArray[np.int64]:
        """Return the keys of the voxels that a visibility vote finds dynamic, ascending (m,).

        Args:
            cloud: the voxel map of all scans.
            poses: T_map_lidar of all scans (n, 4, 4).
            each_scan: every scan votes on its own, not with its pass. This finds traffic.
            earlier: keys of the voxels that were in the map before this survey (k,).
        """
        vote = Vote.of(cloud, self.dataset, poses, self.kept, self.settings, each_scan=each_scan, part=self.part)
        name, stage = ("traffic", "traffic") if each_scan else ("votes", "passes")
        report = partial(self._report_stage, stage)
        return vote.removed(self.work.chunks(name, len(self.kept), partial(vote.votes, report=report), report), earlier)

    def site(self, calibration: Calibration, check: Callable[[], Site]) -> Site:
        """Return the result of the site check.

        Args:
            calibration: the calibration that is checked.
            check: runs the check.
        """

        def made() -> Arrays:
            return {"site": np.frombuffer(check().model_dump_json().encode(), np.uint8)}

        name = f"site-{sha256(calibration.model_dump_json().encode()).hexdigest()[:16]}"
        return Site.model_validate_json(self.work.part(name, made)["site"].tobytes())

    def _report_stage(self, stage: str, done: int) -> None:
        self.report(stage, done, len(self.kept))
