"""Find KITTI traversals below a folder, and list those that the protocols lack."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

PUBLISHED = ("00", "02", "05", "06", "07", "08")
#: Sequences that return to earlier places more than a minute later.
LOOPS = ("00", "05", "06")
#: The same street on another day: the map's traversal, the queries' traversal, and their overlap.
OTHER_DAY = (
    ("2011_09_30_drive_0027", "2011_10_03_drive_0027", "196 m, same direction"),
    ("2011_09_30_drive_0028", "2011_10_03_drive_0027", "152 m, same direction"),
)

#: Drives that we leave out of some runs, and why.
RESERVED = {
    "2011_09_26_drive_0013": "it serves reports only and may be measured at most once a day, so that no choice adapts to it (issue 36); "
    "`make evaluate-real` measures it (rows `real.kitti_0013.*`)"
}


@dataclass(frozen=True, slots=True)
class Drive:
    """A recorded traversal.

    Attributes:
        name: two digits for an odometry sequence; date and number for a raw traversal and for KITTI-360.
        kind: importer that reads it.
        folder: folder for the importer.
        packed: whether it must be unpacked first (``unpack.py`` beside it).
    """

    name: str
    kind: Literal["kitti-odometry", "kitti-raw", "kitti-360"]
    folder: Path
    packed: bool = False


def drives_below(root: Path) -> list[Drive]:
    """Find odometry sequences (``sequences/NN``), raw traversals (``*_sync``) and KITTI-360, by name and without duplicates.

    Args:
        root: folder to search.
    """
    found = dict[str, Drive]()

    def has_pair(folder: Path, *right: str) -> bool:
        """Return whether the right camera of a colour or grey pair is there, as the importers need it."""
        return any((folder / name).is_dir() for name in right)

    for folder in sorted(root.rglob("sequences/[0-9][0-9]")):
        if (folder / "velodyne").is_dir() and has_pair(folder, "image_3", "image_1"):
            found.setdefault(folder.name, Drive(folder.name, "kitti-odometry", folder))
    for folder in sorted(root.rglob("data_3d_raw/*_sync")):
        beside = folder.parent.parent
        pictures = beside / "data_2d_raw" / folder.name / "image_01" / "data_rect"
        if pictures.is_dir() and (beside / "data_poses" / folder.name / "poses.txt").is_file():
            name = folder.name.removesuffix("_sync")
            found.setdefault(name, Drive(name, "kitti-360", folder))
    for folder in sorted(root.rglob("*_sync")):
        scans = folder / "velodyne_points" / "data"
        if not scans.is_dir() or not has_pair(folder, "image_03", "image_01") or not (folder / "oxts").is_dir():
            continue
        packed = any(scans.glob("*.xz"))
        name = folder.name.removesuffix("_sync")
        if packed:
            # unpack.py takes the folder above the day's folder
            found.setdefault(name, Drive(name, "kitti-raw", folder.parent.parent, packed=True))
        else:
            found.setdefault(name, Drive(name, "kitti-raw", folder))
    return [found[name] for name in sorted(found)]


def left_out(drives: Sequence[Drive], chosen: Sequence[Drive]) -> list[str]:
    """Describe the recordings that are there and were not measured.

    Args:
        drives: traversals that were found.
        chosen: those that are measured.
    """
    names = {drive.name for drive in chosen}
    rest = (drive.name for drive in drives if drive.name not in names)
    return [f"{name}: {RESERVED.get(name, 'not chosen by --only')}" for name in rest]


def missing(drives: Sequence[Drive]) -> list[str]:
    """Describe the recordings that the protocols need and that are absent.

    Args:
        drives: traversals that were found.
    """
    names = {drive.name for drive in drives}
    lines = [
        f"odometry sequence {name} (velodyne, image_2, image_3, calib.txt, poses)"
        for name in PUBLISHED
        if name not in names
    ]
    wanted = dict.fromkeys(name for mapped, asked, _ in OTHER_DAY for name in (mapped, asked))
    lines += [f"raw drive {name} (velodyne_points, image_02, image_03, oxts)" for name in wanted if name not in names]
    if not any(drive.kind == "kitti-360" for drive in drives):
        lines.append(
            "any drive of KITTI-360 (data_3d_raw, data_2d_raw with image_00 and image_01, data_poses, calibration)"
        )
    return lines
