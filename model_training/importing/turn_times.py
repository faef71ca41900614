"""Give the points of a spinning LiDAR times if the recording contains none.

The order of the points shows where a turn begins and which way the LiDAR turns. It does not show which moment of the turn the stamp of a
scan means: drivers stamp the begin, the middle or the end. So the user names this moment.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from model_training.datasets.dataset import LidarSensor
from model_training.importing.recording import Event, Notes, RecordedScan, Recording, Unusable
from model_training.importing.spinning import LONGEST_TURN_S, SHORTEST_TURN_S, period_of
from model_training.importing.trajectory import Trajectory
from service.errors import DatasetError

TurnStamp = Literal["begin", "middle", "end"]
#: Share of the turn that has passed at the stamp of a scan.
STAMPS: dict[TurnStamp, float] = {"begin": 0.0, "middle": 0.5, "end": 1.0}
#: Scans at the begin of a recording that tell the time of a turn.
_FIRST_SCANS = 50
#: Turns of one scan: some drivers leave sectors out, others repeat a few degrees.
_FEWEST_TURNS, _MOST_TURNS = 0.5, 1.15
#: Greatest turn back between points in order, turns: the beams of one firing look up to 30 degrees apart.
_MOST_BACK = 30 / 360
_FEWEST_POINTS = 100
_NO_ORDER = "its points are not in the order of one turn, so they have no times by azimuth"


def turned_at(points: Float32[NDArray[np.float32], "N 4"]) -> Float64[NDArray[np.float64], " N"] | str:
    """Return the turns from the first point of a scan to each point (N,), or why the scan is not one turn in order.

    The z axis of the LiDAR is the axis of rotation. Both directions of rotation count as forwards. Points without a direction (NaN, or the
    origin) get 0.

    Args:
        points: of one scan in the order of measurement: x, y, z (m, LiDAR frame) and intensity.
    """
    xy = points[:, :2].astype(np.float64)
    has_direction = np.isfinite(xy).all(axis=1) & (np.abs(xy) > 0).any(axis=1)
    if has_direction.sum() < _FEWEST_POINTS:
        return f"it has fewer than {_FEWEST_POINTS} points, so they have no times by azimuth"
    azimuth = np.arctan2(xy[has_direction, 1], xy[has_direction, 0])
    steps = (np.diff(azimuth) + np.pi) % (2 * np.pi) - np.pi
    turns = np.r_[0.0, np.cumsum(steps)] / (2 * np.pi)
    if turns[-1] < 0:
        turns = -turns
    back = np.maximum.accumulate(turns) - turns
    if not _FEWEST_TURNS <= turns[-1] <= _MOST_TURNS or back.max() > _MOST_BACK:
        return _NO_ORDER
    of_all = np.zeros(len(points))
    of_all[has_direction] = turns
    return of_all


@dataclass(frozen=True, slots=True)
class TurnTimes:
    """A recording whose scans get times by azimuth.

    Attributes:
        recording: without times of points.
        stamp: moment of the turn that the stamp of a scan means.
        turn_s: time of one turn, seconds.
    """

    recording: Recording
    stamp: TurnStamp
    turn_s: float

    @property
    def kind(self) -> str:
        """Name of the format."""
        return self.recording.kind

    @property
    def lidar(self) -> LidarSensor:
        """The LiDAR."""
        return self.recording.lidar

    @property
    def georeference(self) -> dict[str, Any] | None:
        """Georeference of the recording's poses, or None."""
        return self.recording.georeference

    @property
    def has_images(self) -> bool:
        """Whether the recording has images."""
        return self.recording.has_images

    @property
    def notes(self) -> Notes:
        """Those of the recording, and how times follow from azimuths."""
        own = self.recording.notes
        line = f"points' times by azimuth, {self.turn_s:.4f} s per turn; a scan's stamp is the {self.stamp} of its turn"
        source = {"point_times": "azimuth", "turn_s": self.turn_s, "turn_stamp": self.stamp}
        return replace(own, lines=(*own.lines, line), source=own.source | source)

    def count(self) -> int:
        """Count scans and images."""
        return self.recording.count()

    def trajectory(self) -> Trajectory | None:
        """Return T_map_vehicle of the recording, or None."""
        return self.recording.trajectory()

    def events(self, *, pictures: bool = True) -> Iterator[Event]:
        """Yield the events of the recording. A scan that is not one turn in order keeps its motion, and an event before it says so.

        Args:
            pictures: yield images too.
        """
        for event in self.recording.events(pictures=pictures):
            if not isinstance(event, RecordedScan):
                yield event
                continue
            turns = turned_at(event.points)
            if isinstance(turns, str):
                yield Unusable("de-skew", event.name, turns)
                yield event
            else:
                at_stamp = STAMPS[self.stamp] * turns.max()
                yield replace(event, offsets_s=(turns - at_stamp) * self.turn_s)


def with_turn_times(recording: Recording, stamp: TurnStamp, *, source: str) -> TurnTimes:
    """Return a recording of a spinning LiDAR with times of points.

    Args:
        recording: opened.
        stamp: moment of the turn that the stamp of a scan means.
        source: name of the recording, for errors.

    Raises:
        DatasetError: the points have times already, the first scan is not one turn in order, or the times between scans are no turns.
    """
    events = recording.events(pictures=False)
    first = list(islice((event for event in events if isinstance(event, RecordedScan)), _FIRST_SCANS))
    if any(scan.offsets_s is not None for scan in first):
        raise DatasetError(
            f"--turn-stamp {stamp}: the points of {source} have times already; omit this option", field="turn-stamp"
        )
    if first and isinstance(why := turned_at(first[0].points), str):
        raise DatasetError(
            f"--turn-stamp {stamp}: {first[0].name}: {why}; omit this option, and record clouds with a time for each point",
            field="turn-stamp",
        )
    turn_s = period_of(np.array([scan.stamp_s for scan in first]), otherwise_s=np.nan)
    if not np.isfinite(turn_s):
        raise DatasetError(
            f"--turn-stamp {stamp}: the first scans of {source} are not {SHORTEST_TURN_S:g} to {LONGEST_TURN_S:g} s apart, so the time of "
            "a turn is not known; record every turn, or omit this option",
            field="turn-stamp",
        )
    return TurnTimes(recording, stamp, turn_s)
