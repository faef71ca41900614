"""Convert a recording to a dataset folder: match times, remove motion and distortion, split into survey and queries.

This takes one pass over the recording, one frame at a time. Unusable frames are counted by reason; the rest is kept.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import DatasetDescription, Sensors, write_description
from model_training.datasets.whole_folder import whole_or_not_at_all
from model_training.importing.deskew import MOST_OFFSET_S, deskewed, times_fit
from model_training.importing.dropped import Dropped
from model_training.importing.lidar_depth import depth_from_scan
from model_training.importing.recording import RecordedPicture, RecordedScan, Recording, Unusable
from model_training.importing.rectify import rectified
from model_training.importing.trajectory import Sync, Trajectory
from model_training.importing.write_queries import QueryWriter
from model_training.importing.write_survey import SurveyWriter
from service.errors import DatasetError
from service.geometry.rigid import Transform, inverse

Report = Callable[[str, int, int], None]

#: Scans that are kept while images wait for their nearest scan.
_RECENT_SCANS = 3
#: Greatest number of images that wait for a later scan. Beyond it the oldest image uses the earlier scans.
_MOST_WAITING = 32


@dataclass(frozen=True, slots=True)
class TakeSettings:
    """How a recording becomes a dataset.

    Attributes:
        queries: name of the query set of the images; empty leaves images out.
        depth: ``recorded`` keeps the recorded depth, ``lidar`` takes the scan nearest in time.
        sync: how the pose at a frame's time is found.
        tolerance_s: greatest time between a frame and its pose, or the scan of its depth, seconds.
        deskew: remove the vehicle's motion from scans with point times.
        hold_out: one of this many scans is left out of the survey; 0 leaves none out. Then an image becomes a query only if
            its nearest scan was left out. So the map does not contain the time of a query. Other images are counted.
        hold_out_first: number of the first scan that is left out, from 0; None for the last scan of each group.
        max_points: a scan with more points is left out.
        georeference: of the frame of the trajectory, as in ``dataset.json``. None takes that of the recording, if ``own_frame``.
        own_frame: the trajectory is in the frame of the recording's own poses. False: found by odometry.
    """

    queries: str = "recorded"
    depth: Literal["recorded", "lidar"] = "recorded"
    sync: Sync = "interpolate"
    tolerance_s: float = 0.1
    deskew: bool = True
    hold_out: int = 0
    hold_out_first: int | None = None
    max_points: int = 5_000_000
    georeference: Mapping[str, Any] | None = None
    own_frame: bool = True

    def __post_init__(self) -> None:
        """Check the settings.

        Raises:
            DatasetError: a setting is invalid; the error names it.
        """
        if self.hold_out == 1 or self.hold_out < 0:
            raise DatasetError("hold_out: 1 would leave no survey; give 0, or 2 or more", field="hold_out")
        if self.hold_out_first is not None and not 0 <= self.hold_out_first < self.hold_out:
            raise DatasetError(
                f"hold_out_first: {self.hold_out_first} is not valid; it must be 0 to {self.hold_out - 1}",
                field="hold_out_first",
            )
        if not 0 <= self.tolerance_s < np.inf:
            raise DatasetError(
                f"tolerance_s: {self.tolerance_s:g} is not valid; it must be seconds, 0 or more", field="tolerance_s"
            )

    def holds_out(self, number: int) -> bool:
        """Check whether a usable scan is left out of the survey.

        Args:
            number: of the scan among the usable scans, from 0.
        """
        if not self.hold_out:
            return False
        first = self.hold_out - 1 if self.hold_out_first is None else self.hold_out_first
        return number % self.hold_out == first


@dataclass(frozen=True, slots=True)
class TakeSummary:
    """What was taken, and what was left out.

    Attributes:
        scans: scans in the survey.
        held_out: scans that were left out on purpose (``hold_out``).
        pictures: image pairs in the query set.
        points_without_numbers: points with coordinates that are not finite.
        dropped: dropped frames by kind and reason, with the first name of each.
        notes: what the reader found and assumed.
        deskewed: scans from which the vehicle's motion was removed.
    """

    scans: int
    held_out: int
    pictures: int
    points_without_numbers: int
    dropped: tuple[str, ...]
    notes: tuple[str, ...]
    deskewed: int = 0


def take(
    recording: Recording, trajectory: Trajectory, out: Path, settings: TakeSettings, *, report: Report = lambda *_: None
) -> TakeSummary:
    """Write a recording as a dataset.

    Args:
        recording: opened.
        trajectory: T_map_vehicle: the recording's own, or from odometry.
        out: the dataset to write; it appears only when it is complete.
        settings: what goes where.
        report: called after every frame with the stage, the frames done and all frames.

    Raises:
        DatasetError: nothing usable is left, or ``out`` already exists.
    """
    with whole_or_not_at_all(out) as part:
        taking = _Taking(recording, trajectory, part, settings)
        of = recording.count()
        for done, event in enumerate(recording.events(pictures=bool(settings.queries)), 1):
            if isinstance(event, Unusable):
                taking.dropped.add(event.kind, event.name, event.why)
            elif isinstance(event, RecordedScan):
                taking.scan(event)
            else:
                taking.picture(event)
            report("frames", done, max(of, done))
        return taking.finish(out.name)


class _Taking:
    """A dataset while it is written."""

    def __init__(self, recording: Recording, trajectory: Trajectory, out: Path, settings: TakeSettings) -> None:
        self.dropped = Dropped()
        self._recording, self._trajectory, self._out, self._settings = recording, trajectory, out, settings
        T = recording.lidar.T_vehicle_sensor
        self._T_vehicle_lidar: Transform = np.eye(4) if T is None else np.array(T, np.float64)
        self._survey, self._queries = SurveyWriter(out), QueryWriter(out, settings.queries)
        self._recent: deque[tuple[float, bool, NDArray[np.float32]]] = deque(maxlen=_RECENT_SCANS)
        self._waiting: deque[RecordedPicture] = deque()
        self._seen = self._held = self._without_numbers = self._deskewed = 0
        self._last_scan_s = -np.inf

    def scan(self, scan: RecordedScan) -> None:
        finite = finite_points(scan.points)
        self._without_numbers += int((~finite).sum())
        if why := self._useless(scan, finite):
            self.dropped.add("scan", scan.name, why)
            return
        T_map_vehicle = self._trajectory.at(
            scan.stamp_s, sync=self._settings.sync, tolerance_s=self._settings.tolerance_s
        )
        if isinstance(T_map_vehicle, str):
            self.dropped.add("scan", scan.name, T_map_vehicle)
            return
        clean = scan if finite.all() else _only(scan, finite)
        if self._settings.deskew and not times_fit(clean):
            self.dropped.add(
                "de-skew", scan.name, f"its points' times are more than {MOST_OFFSET_S:g} s from its stamp"
            )
            clean = replace(clean, offsets_s=None)
        points = clean.points
        if self._settings.deskew and clean.offsets_s is not None:
            points = deskewed(clean, self._trajectory, self._T_vehicle_lidar)
            self._deskewed += 1
        self._last_scan_s = scan.stamp_s
        is_held = self._settings.holds_out(self._seen)
        self._seen += 1
        self._recent.append((scan.stamp_s, is_held, points))
        if is_held:
            self._held += 1
        else:
            self._survey.add(scan.stamp_s, T_map_vehicle @ self._T_vehicle_lidar, points)
        self._answer_waiting(until_s=scan.stamp_s)

    def picture(self, picture: RecordedPicture) -> None:
        if self._needs_scans():
            self._waiting.append(picture)
            if len(self._waiting) > _MOST_WAITING:
                self._answer(self._waiting.popleft())
        else:
            self._query(picture, None)

    def finish(self, name: str) -> TakeSummary:
        self._answer_waiting(until_s=np.inf)
        recording, settings = self._recording, self._settings
        if not self._survey.count:
            why = "; ".join(self.dropped.lines()) or "the recording has none"
            where = recording.notes.source.get("path", recording.kind)
            raise DatasetError(
                f"{where}: no scan is usable ({why}); correct the first reason, or give other poses", field="scans"
            )
        self._survey.finish()
        cameras = self._queries.finish()
        source: dict[str, Any] = {
            "kind": recording.kind,
            **recording.notes.source,
            "poses": self._trajectory.name,
            "sync": settings.sync,
            "scans_deskewed": self._deskewed,
            "hold_out": settings.hold_out,
            "dropped": self.dropped.lines(),
        }
        own = recording.georeference if settings.own_frame else None
        description = DatasetDescription(
            name=name,
            source=source,
            sensors=Sensors(lidars=[recording.lidar], cameras=cameras),
            georeference=own if settings.georeference is None else dict(settings.georeference),
        )
        write_description(self._out, description)
        return TakeSummary(
            self._survey.count,
            self._held,
            self._queries.count,
            self._without_numbers,
            tuple(self.dropped.lines()),
            recording.notes.lines,
            self._deskewed,
        )

    def _useless(self, scan: RecordedScan, finite: NDArray[np.bool_]) -> str | None:
        if not finite.any():
            return "no finite points"
        if len(scan.points) > self._settings.max_points:
            return f"more than {self._settings.max_points} points"
        if not scan.stamp_s > self._last_scan_s:  # true for NaN too
            return "its time is not later than that of the scan before"
        return None

    def _needs_scans(self) -> bool:
        return self._settings.depth == "lidar" or self._settings.hold_out > 0

    def _answer_waiting(self, *, until_s: float) -> None:
        """Process the images up to a time. They wait for a later scan, so that their nearest scan is known."""
        while self._waiting and self._waiting[0].stamp_s <= until_s:
            self._answer(self._waiting.popleft())

    def _answer(self, picture: RecordedPicture) -> None:
        """Add an image with its nearest scan, or count why not."""
        if not self._recent:
            self.dropped.add("image", picture.name, "no scan near it in time")
            return
        stamp_s, is_held, points = min(self._recent, key=lambda scan: abs(scan[0] - picture.stamp_s))
        if self._settings.depth == "lidar" and abs(stamp_s - picture.stamp_s) > self._settings.tolerance_s:
            self.dropped.add("image", picture.name, f"no scan within {self._settings.tolerance_s:g} s")
        elif self._settings.hold_out and not is_held:
            self.dropped.add("image", picture.name, "the scan nearest to it is in the survey (--hold-out)")
        else:
            self._query(picture, (stamp_s, points))

    def _query(self, picture: RecordedPicture, scan: tuple[float, NDArray[np.float32]] | None) -> None:
        T_map_vehicle = self._trajectory.at(
            picture.stamp_s, sync=self._settings.sync, tolerance_s=self._settings.tolerance_s
        )
        if isinstance(T_map_vehicle, str):
            self.dropped.add("image", picture.name, T_map_vehicle)
            return
        pinhole = rectified(picture)
        if self._settings.depth == "lidar" and scan is not None:
            pinhole = replace(pinhole, depth=self._lidar_depth(pinhole, *scan))
        if pinhole.depth is None:
            self.dropped.add("image", picture.name, "no depth in the recording; --depth lidar takes it from the scans")
            return
        if why := self._queries.add(pinhole, T_map_vehicle @ picture.T_vehicle_camera):
            self.dropped.add("image", picture.name, why)

    def _lidar_depth(
        self, picture: RecordedPicture, stamp_s: float, points: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Depth from the scan's points, moved to the camera frame at the time of the image."""
        T_then, T_now = self._trajectory.between(np.array([stamp_s, picture.stamp_s]))
        T_camera_lidar = inverse(T_now @ picture.T_vehicle_camera) @ T_then @ self._T_vehicle_lidar
        return depth_from_scan(points[:, :3].astype(np.float64), T_camera_lidar, picture.camera)


def _only(scan: RecordedScan, chosen: NDArray[np.bool_]) -> RecordedScan:
    offsets = None if scan.offsets_s is None else scan.offsets_s[chosen]
    return replace(scan, points=scan.points[chosen], offsets_s=offsets)


def finite_points(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which points have finite coordinates (N,). Clouds that are not dense mark missing returns by NaN.

    Args:
        points: x y z and more (N, 4).
    """
    return np.asarray(np.isfinite(points[:, :3]).all(axis=1), np.bool_)


def scans_of(recording: Recording) -> Iterator[RecordedScan]:
    """Yield the usable scans of a recording, as odometry needs them.

    Points that are not finite are removed, and so are point times of another clock.

    Args:
        recording: opened.
    """
    last_s = -np.inf
    for event in recording.events(pictures=False):
        if isinstance(event, RecordedScan) and event.stamp_s > last_s:
            finite = finite_points(event.points)
            if finite.any():
                last_s = event.stamp_s
                clean = event if finite.all() else _only(event, finite)
                yield clean if times_fit(clean) else replace(clean, offsets_s=None)
