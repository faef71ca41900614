"""How well the tiles of a map agree: each aligns its own scans, and neighbours share those near their edges."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

#: Differences above this are reported as a warning, metres. A query near an edge may then be off by as much.
LARGE_M = 0.05


@dataclass(frozen=True, slots=True)
class Seams:
    """Differences between the positions that two tiles give to the same scan.

    Attributes:
        scans: number of scans that several tiles have.
        median_m: median of the differences, metres.
        largest_m: largest difference, metres.
    """

    scans: int
    median_m: float
    largest_m: float

    def __str__(self) -> str:
        """Return a line of text."""
        return (
            f"tiles: {self.scans} scans are in several tiles; their aligned positions differ by {self.median_m * 100:.1f} cm (median), "
            f"{self.largest_m * 100:.1f} cm at most"
        )

    @property
    def warning(self) -> str | None:
        """What is wrong, and the remedy; None if all tiles agree."""
        if self.largest_m <= LARGE_M:
            return None
        return (
            f"the tiles disagree by up to {self.largest_m * 100:.0f} cm: the poses of the survey are too inaccurate to align each tile "
            "alone, and answers near the edges of tiles may be off by as much; give the survey better poses (import --align, or "
            "--odometry), or larger tiles (--tile-m)"
        )


def seams_of(tiles: Sequence[tuple[NDArray[np.int64], NDArray[np.float64]]]) -> Seams | None:
    """Compare the positions of the scans that several tiles have; None if there are none.

    Args:
        tiles: for each tile the indices of its scans in the survey (n,), and their aligned positions (n, 3), map frame, metres.
    """
    if not tiles:
        return None
    scan = np.concatenate([numbers for numbers, _ in tiles])
    xyz_m = np.concatenate([positions_m for _, positions_m in tiles])
    order = np.argsort(scan, kind="stable")
    scan, xyz_m = scan[order], xyz_m[order]
    first = np.searchsorted(scan, scan)  # the first tile that has the scan
    again = np.flatnonzero(first < np.arange(len(scan)))
    if not len(again):
        return None
    apart_m = np.linalg.norm(xyz_m[again] - xyz_m[first[again]], axis=1)
    return Seams(len(np.unique(scan[again])), float(np.median(apart_m)), float(apart_m.max()))


def write_positions(file: Path, positions_m: NDArray[np.float64]) -> None:
    """Write the aligned positions of a tile's scans.

    Args:
        file: of the tile; it appears complete.
        positions_m: of its scans (n, 3), map frame, metres.

    Raises:
        OSError: the file cannot be written.
    """
    partial = file.with_name(f".{file.name}")
    with partial.open("wb") as stream:
        np.save(stream, positions_m)
    partial.replace(file)


def read_positions(file: Path) -> NDArray[np.float64] | None:
    """Return the aligned positions of a tile's scans (n, 3); None if an earlier release has built the tile.

    Args:
        file: as ``write_positions`` wrote it.
    """
    if not file.exists():
        return None
    positions_m: NDArray[np.float64] = np.load(file)
    return positions_m
