"""Compressed files of records: zstd over byte planes. Such a file is smaller than an NPY file, but cannot be mapped into memory.

A file is one zstd frame. Its content is the first byte of every record, then the second byte of every record, and so on. Bytes of one
kind lie together, so they compress well.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

#: Higher levels save one hundredth more and take 30 times as long.
_LEVEL = 9
#: Largest window of a frame, bytes. The encoder of ``_LEVEL`` uses 8 MiB.
_WINDOW = 2**27


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Records as columns: an array for each number of a record. Every number has four bytes. A column may be computed when it is written.

    Attributes:
        rows: number of records.
        width: how many numbers a record has.
        each: returns the columns (rows,), in the order of a record's numbers.
    """

    rows: int
    width: int
    each: Callable[[], Iterable[NDArray[Any]]]

    @classmethod
    def of(cls, records: NDArray[Any]) -> "Columns":
        """Return the columns of records in memory.

        Args:
            records: (n,) of a type whose size is a multiple of four bytes.
        """
        width = records.dtype.itemsize // 4
        words = np.ascontiguousarray(records).view(np.uint32).reshape(len(records), width)
        return cls(len(records), width, lambda: (np.ascontiguousarray(column) for column in words.T))


def write_records(path: Path, records: Columns) -> None:
    """Write records.

    Args:
        path: the new file.
        records: the records.
    """
    # Plane by plane, so that the memory does not hold all planes.
    size = records.rows * records.width * 4
    with path.open("wb") as file, zstandard.ZstdCompressor(level=_LEVEL).stream_writer(file, size=size) as writer:
        for column in records.each():
            for plane in column.view(np.uint8).reshape(records.rows, 4).T:
                writer.write(np.ascontiguousarray(plane).data)


def read_records(path: Path, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Read the records that ``write_records`` wrote: (n,) of ``dtype``.

    Args:
        path: the file.
        dtype: type of the records.

    Raises:
        ValueError: the file is damaged, or it does not hold whole records of this size.
        OSError: the file cannot be read.
    """
    frame = path.read_bytes()
    try:
        size = zstandard.get_frame_parameters(frame).content_size
        content = zstandard.ZstdDecompressor(max_window_size=_WINDOW).decompress(
            frame, max_output_size=size, allow_extra_data=False
        )
    except (zstandard.ZstdError, MemoryError, OverflowError) as error:
        raise ValueError(f"not a valid zstd frame ({error})") from error
    if len(content) != size or size % dtype.itemsize:
        raise ValueError(f"{size} bytes is not a multiple of the record size, {dtype.itemsize} bytes")
    planes = np.frombuffer(content, np.uint8).reshape(dtype.itemsize, size // dtype.itemsize)
    found: NDArray[Any] = np.ascontiguousarray(planes.T).view(dtype).reshape(planes.shape[1])
    return found
