"""Find the drives near a folder that is none itself, for error messages of KITTI's importers."""

from collections.abc import Callable, Iterable
from pathlib import Path

from service.errors import DatasetError

#: Levels of folders that are searched below the given one.
LEVELS = 3
#: Largest number of folders that a message names.
MOST_NAMED = 20


def below(source: Path, inside: str, is_drive: Callable[[Path], bool] = lambda _: True) -> list[Path]:
    """Return the folders up to ``LEVELS`` below ``source`` that contain a folder of a given name, sorted.

    Args:
        source: folder to search; a missing folder has none.
        inside: name of the folder that makes its parent a drive, such as ``velodyne_points``.
        is_drive: additional test of the parent.
    """
    found = (path.parent for level in range(1, LEVELS + 1) for path in source.glob("*/" * level + inside))
    return sorted(path for path in found if (path / inside).is_dir() and is_drive(path))


def above(source: Path, is_drive: Callable[[Path], bool]) -> list[Path]:
    """Return the nearest folder up to ``LEVELS`` above ``source`` that is a drive; empty if there is none.

    Args:
        source: a folder, perhaps one inside a drive.
        is_drive: test of a folder.
    """
    return [path for path in list(source.absolute().parents)[:LEVELS] if is_drive(path)][:1]


def wrong_folder(source: Path, wanted: str, drives: Iterable[Path], otherwise: str) -> DatasetError:
    """Return the error for a folder that is no drive. It lists the drives near the folder.

    Args:
        source: the given folder.
        wanted: description of the folder that the importer takes.
        drives: drives near the folder.
        otherwise: what the message says if there are no drives.
    """
    found = list(drives)
    if not found:
        return DatasetError(f"{source}: expected {wanted}; {otherwise}", field="source")
    named = ", ".join(map(str, found[:MOST_NAMED]))
    more = f" and {len(found) - MOST_NAMED} more" if len(found) > MOST_NAMED else ""
    choice = "give one of these" if len(found) > 1 else "give this one"
    return DatasetError(f"{source}: expected {wanted}; {choice}: {named}{more}", field="source")
