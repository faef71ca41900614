"""Times of a recording in KITTI's raw layouts: one line per frame, also for frames that an extract leaves out."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from model_training.datasets.files import read_bytes
from model_training.importing.kitti_sequence import RATE_HZ
from model_training.importing.spinning import period_of
from service.errors import DatasetError


def turn_of(times: Path) -> float:
    """Return the time of one turn of the LiDAR, seconds, from the stamps of all scans of the recording.

    An extract has fewer scans than lines. A scan that was not recorded may have a blank line.

    Args:
        times: the file ``timestamps.txt``; if it is missing, the result is 1 / ``RATE_HZ``.
    """
    lines = times.read_bytes().rstrip().splitlines() if times.is_file() else []
    stamps = stamps_of(times, [number for number, line in enumerate(lines) if line.strip()]) or {}
    return period_of(np.array([stamps[n] for n in sorted(stamps)]), otherwise_s=1 / RATE_HZ)


def stamps_of(path: Path, numbers: list[int]) -> dict[int, float] | None:
    """Read the times of frames, seconds by the frame's number; None if the file is missing.

    Args:
        path: the file ``timestamps.txt``.
        numbers: of the frames, rising.

    Raises:
        DatasetError: a line is no time, or there are fewer lines than frames.
    """
    if not path.is_file():
        return None
    lines = read_bytes(path).decode("ascii", errors="replace").rstrip().splitlines()
    if numbers and numbers[-1] >= len(lines):
        raise DatasetError(
            f"{path} has {len(lines)} lines, but there is a frame {numbers[-1]:010d}; copy the file from the "
            "recording again",
            field=path.name,
        )
    stamps = {}
    for number in numbers:
        text = lines[number].strip()
        try:
            whole, _, nanoseconds = text.partition(".")
            moment = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
            stamps[number] = moment.timestamp() + float(f"0.{nanoseconds or 0}")
        except ValueError as error:
            raise DatasetError(f"{path}, line {number + 1}: not a time: {text[:40]!r}", field=path.name) from error
    return stamps
