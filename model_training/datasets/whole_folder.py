"""A folder that is there when it is whole, and not before."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from service.errors import DatasetError


@contextmanager
def whole_or_not_at_all(out: Path) -> Iterator[Path]:
    """Give a folder beside ``out`` to write into, which takes its name when all went well, and goes when not.

    Raises:
        DatasetError: ``out`` is there and not empty.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out} exists and is not empty; name another folder, or remove it first", field="out")
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
