"""Write a folder that exists only when it is complete."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from service.errors import DatasetError


@contextmanager
def whole_or_not_at_all(out: Path) -> Iterator[Path]:
    """Yield a temporary folder beside ``out``. It is renamed to ``out`` on success and removed on an error.

    Args:
        out: folder to create.

    Raises:
        DatasetError: ``out`` exists and is not an empty folder.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out} exists and is not empty; choose another folder, or remove it first", field="out")
    part = out.with_name(f".{out.name}.part")
    if part.exists():
        shutil.rmtree(part)
    part.mkdir(parents=True)
    try:
        yield part
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    if out.exists():
        out.rmdir()
    part.rename(out)
