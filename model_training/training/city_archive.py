"""A training city as a tar file that follows WebDataset: a *city archive*.

In WebDataset, a sample consists of the files with one key. The key is the path up to the first dot of the file name. The files of a sample
lie one after another. The archive of a pack has these samples in the folder ``STEM``:

- ``city``: ``.json`` with the numbers of the city. It comes first.
- ``place-000000``: ``.json``, ``.panorama.npy``, ``.intensity.npy``.
- ``query-000000``: ``.json``, ``.ranges.npy``, ``.rgb.npy``, and ``.seen.npy`` with stereo-matched depth.

The JSON file of a place or query has its pose, and CRC-32 of its parts. One pack always gives the same bytes.
"""

import io
import json
import math
import os
import tarfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from model_training.training.packs import Pack, PackPlan
from service.imaging.view_grid import ViewGrid

#: Version of the format.
FORMAT = 1
#: Key of the first sample, and the beginnings of the keys of places and queries.
CITY, PLACE, QUERY = "city", "place", "query"


@dataclass(frozen=True, slots=True)
class Kind:
    """Samples of one kind.

    Attributes:
        name: beginning of their keys.
        poses: field of ``Pack`` with their poses.
        fields: field of ``Pack`` for each file extension.
    """

    name: str
    poses: str
    fields: Mapping[str, str]

    def key(self, number: int) -> str:
        """Return the key of a sample, without the folder.

        Args:
            number: index of the sample in the arrays of the pack.
        """
        return f"{self.name}-{number:06d}"


@dataclass(frozen=True, slots=True)
class ArrayShape:
    """Type and shape of an array.

    Attributes:
        dtype: type of its elements.
        shape: its shape.
    """

    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    @property
    def content_bytes(self) -> int:
        """Size without a header, bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


class City(BaseModel):
    """Content of ``city.json``.

    Attributes:
        format: version of the format.
        pack: name of the pack.
        places: number of places.
        queries: number of queries.
        grid: fields of the view grid.
        rows_seen: rows that the LiDAR covers (rows).
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    format: int
    pack: str
    places: int = Field(ge=1)
    queries: int = Field(ge=1)
    grid: dict[str, float]
    rows_seen: list[bool]


class Sample(BaseModel):
    """Content of the JSON file of a place or query.

    Attributes:
        pose: x, y (m), heading (rad), height (m), as in ``Pack``.
        crc32: CRC-32 of each array file by its extension, and of ``pose`` as float64.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    pose: list[float] = Field(min_length=4, max_length=4)
    crc32: dict[str, int]


def archive_name(plan: PackPlan) -> str:
    """Return the file name of the archive of a city.

    Args:
        plan: the city.
    """
    return f"{plan.stem}.tar"


def kinds_of(plan: PackPlan) -> tuple[Kind, Kind]:
    """Return the kinds of samples of a city: its places and its queries.

    Args:
        plan: the city.
    """
    seen = {"seen.npy": "seen"} if plan.rigs else {}
    return (
        Kind(PLACE, "places", {"panorama.npy": "panoramas", "intensity.npy": "intensities"}),
        Kind(QUERY, "queries", {"ranges.npy": "ranges", "rgb.npy": "rgb"} | seen),
    )


def shape_of(extension: str, grid: ViewGrid) -> ArrayShape:
    """Return type and shape of an array of a sample.

    Args:
        extension: its file extension.
        grid: the view grid.
    """
    around, view = (grid.rows, grid.around), (grid.rows, grid.columns)
    return {
        "panorama.npy": ArrayShape(np.dtype(np.float16), around),
        "intensity.npy": ArrayShape(np.dtype(np.uint8), around),
        "ranges.npy": ArrayShape(np.dtype(np.float16), view),
        "rgb.npy": ArrayShape(np.dtype(np.uint8), (*view, 3)),
        "seen.npy": ArrayShape(np.dtype(np.bool_), view),
    }[extension]


def numbers_of(grid: ViewGrid) -> dict[str, float]:
    """Return the fields of a view grid for ``city.json``.

    Args:
        grid: the view grid.
    """
    return {name: float(value) for name, value in asdict(grid).items()}


def crc_of_pose(pose: Sequence[float]) -> int:
    """Return the CRC-32 of a pose as float64.

    Args:
        pose: its numbers (4).
    """
    return zlib.crc32(np.array(pose, "<f8").tobytes())


def write_archive(pack: Path, plan: PackPlan, grid: ViewGrid, target: Path) -> None:
    """Write the archive of a pack.

    Args:
        pack: folder of the pack.
        plan: its city.
        grid: the view grid.
        target: file to write. It must not exist.

    Raises:
        DatasetError: the pack is damaged.
        OSError: the file cannot be written.
    """
    opened = Pack.open(pack)
    city = City(
        format=FORMAT,
        pack=plan.stem,
        places=len(opened.places),
        queries=len(opened.queries),
        grid=numbers_of(grid),
        rows_seen=opened.rows_seen.tolist(),
    )
    with target.open("xb") as file:
        with tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT) as tar:
            _add(tar, f"{plan.stem}/{CITY}.json", city.model_dump_json().encode())
            for kind in kinds_of(plan):
                _add_samples(tar, plan.stem, kind, opened)
        file.flush()
        os.fsync(file.fileno())


def _add_samples(tar: tarfile.TarFile, folder: str, kind: Kind, pack: Pack) -> None:
    """Add all samples of a kind, in order."""
    arrays = {extension: getattr(pack, field) for extension, field in kind.fields.items()}
    for number, pose in enumerate(getattr(pack, kind.poses).tolist()):
        key = f"{folder}/{kind.key(number)}"
        files = {extension: _npy_bytes(array[number]) for extension, array in arrays.items()}
        crc32 = {"pose": crc_of_pose(pose)} | {extension: zlib.crc32(content) for extension, content in files.items()}
        _add(tar, f"{key}.json", json.dumps({"pose": pose, "crc32": crc32}).encode())
        for extension, content in files.items():
            _add(tar, f"{key}.{extension}", content)


def _npy_bytes(array: NDArray[np.generic]) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=False)
    return file.getvalue()


def _add(tar: tarfile.TarFile, name: str, content: bytes) -> None:
    """Add an entry. A new ``TarInfo`` has no owner and the time 0, so equal cities give equal bytes."""
    entry = tarfile.TarInfo(name)
    entry.size = len(content)
    tar.addfile(entry, io.BytesIO(content))
