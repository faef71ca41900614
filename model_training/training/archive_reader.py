"""Unpack a city archive (``city_archive``) into the pack that it was written from.

The plan of the city bounds the size of every entry before it is read. So no number of a damaged file decides how much memory is allocated.
"""

import io
import tarfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from model_training.datasets.files import reading, size_of
from model_training.training.city_archive import (
    CITY,
    FORMAT,
    PLACE,
    QUERY,
    ArrayShape,
    City,
    Kind,
    Sample,
    crc_of_pose,
    kinds_of,
    numbers_of,
    shape_of,
)
from model_training.training.packs import PackPlan
from service.errors import DatasetError
from service.imaging.npy_header import NPY_HEADER_ERRORS
from service.imaging.view_grid import ViewGrid

#: Largest JSON file and largest header of an array, bytes.
_MOST_JSON_BYTES, _MOST_HEADER_BYTES = 64 << 10, 1 << 10
#: A tar file consists of blocks of this size, bytes. Each entry begins with a block about it, and its content fills whole blocks.
_BLOCK = 512

#: Files of a sample by extension.
_Files = dict[str, bytes]


def unpack_archive(archive: Path, plan: PackPlan, grid: ViewGrid, folder: Path, *, name: str = "") -> None:
    """Write the pack of an archive. Its files have the same bytes as those of the pack that the archive was written from.

    Args:
        archive: the tar file. Its samples may have any order, but ``city.json`` comes first.
        plan: its city.
        grid: the view grid.
        folder: folder of the pack, which does not exist yet. It is incomplete if the function raises.
        name: name of the archive in errors; empty for its path.

    Raises:
        DatasetError: the archive is missing or damaged, or belongs to another city or view grid.
        OSError: the pack cannot be written.
    """
    opened = _Archive(archive, plan, grid, name or str(archive))
    opened.require_size()
    samples = opened.samples()
    city = opened.city(next(samples, None))
    counts = {PLACE: city.places, QUERY: city.queries}
    poses = {kind.name: np.zeros((counts[kind.name], 4)) for kind in opened.kinds}
    missing = {kind.key(number): (kind, number) for kind in opened.kinds for number in range(counts[kind.name])}
    folder.mkdir()
    with ExitStack() as stack:
        files = {
            (kind.name, extension): stack.enter_context(
                _NewArray(folder / f"{field}.npy", counts[kind.name], shape_of(extension, grid))
            )
            for kind in opened.kinds
            for extension, field in kind.fields.items()
        }
        for key, found in samples:
            if key not in missing:
                raise opened.damaged(key, "this sample is there twice, or the city has no sample of this name")
            kind, number = missing.pop(key)
            poses[kind.name][number] = opened.sample(key, found, kind).pose
            for extension in kind.fields:
                files[kind.name, extension].put(number, opened.array(key, extension, found[extension]))
    if missing:
        raise opened.damaged(f"{next(iter(missing))}.json", f"it is missing; missing samples: {len(missing)}")
    for kind in opened.kinds:
        np.save(folder / f"{kind.poses}.npy", poses[kind.name])
    np.save(folder / "rows_seen.npy", np.array(city.rows_seen, np.bool_))


class _Archive:
    """An archive that is read, with the checks of its parts.

    Args:
        path: the tar file.
        plan: its city.
        grid: the view grid.
        name: name of the archive in errors.
    """

    def __init__(self, path: Path, plan: PackPlan, grid: ViewGrid, name: str) -> None:
        self._path, self._plan, self._grid, self._name = path, plan, grid, name
        self.kinds = kinds_of(plan)

    def damaged(self, entry: str, what: str) -> DatasetError:
        """Return the error for an entry.

        Args:
            entry: name of the entry; empty for the whole file.
            what: what is wrong.
        """
        where = f"{self._name}: entry {entry}" if entry else self._name
        return DatasetError(
            f"{where}: {what}; delete the file and make it again (streetfix simulate-training), or copy it again",
            field=entry or self._name,
        )

    def require_size(self) -> None:
        """Refuse a file that is larger than any archive of the city."""
        counts = {PLACE: self._plan.places, QUERY: self._plan.places * self._plan.queries_a_place}
        most = _MOST_JSON_BYTES + tarfile.RECORDSIZE
        for kind in self.kinds:
            shapes = [shape_of(extension, self._grid) for extension in kind.fields]
            arrays = sum(shape.content_bytes + _MOST_HEADER_BYTES + 2 * _BLOCK for shape in shapes)
            most += counts[kind.name] * (arrays + 4 * _BLOCK)
        if (size := size_of(self._path)) > most:
            raise self.damaged("", f"it has {size:,} bytes, but an archive of this city has at most {most:,}")

    def samples(self) -> Iterator[tuple[str, _Files]]:
        """Yield key and files of each sample: entries one after another with one key."""
        key, found, last = "", _Files(), ""
        try:
            with reading(self._path), tarfile.open(self._path, "r:") as tar:
                for entry in tar:
                    last = entry.name
                    of, extension = self._checked(entry)
                    if of != key and found:
                        yield key, found
                        found = {}
                    key = of
                    if extension in found:
                        raise self.damaged(entry.name, "it is there twice")
                    opened = tar.extractfile(entry)
                    found[extension] = b"" if opened is None else opened.read()
                    if len(found[extension]) != entry.size:
                        read = len(found[extension])
                        raise self.damaged(entry.name, f"it ends after {read:,} of {entry.size:,} bytes")
        except (tarfile.TarError, EOFError, ValueError, OverflowError) as error:
            raise self.damaged(last, f"it is {'damaged' if last else 'no tar file'} ({error})") from error
        if found:
            yield key, found

    def _checked(self, entry: tarfile.TarInfo) -> tuple[str, str]:
        """Check name, kind and size of an entry before it is read. Return its key without the folder, and its extension."""
        folder, _, name = entry.name.rpartition("/")
        key, _, extension = name.partition(".")
        if folder != self._plan.stem:
            raise self.damaged(entry.name, f"it does not belong to the city {self._plan.stem}")
        if not entry.isreg() or entry.issparse():
            raise self.damaged(entry.name, "it is no normal file")
        if extension == "json":
            most = _MOST_JSON_BYTES
        elif any(extension in kind.fields for kind in self.kinds):
            most = shape_of(extension, self._grid).content_bytes + _MOST_HEADER_BYTES
        else:
            raise self.damaged(entry.name, "no sample of this city has a file of this kind")
        if entry.size > most:
            raise self.damaged(entry.name, f"it has {entry.size:,} bytes, more than {most:,}")
        return key, extension

    def city(self, first: tuple[str, _Files] | None) -> City:
        """Check the first sample, and return its content.

        Args:
            first: key and files of the sample; None if there is none.
        """
        entry = f"{CITY}.json"
        if first is None or first[0] != CITY or set(first[1]) != {"json"}:
            raise self.damaged(entry, "it is not the first entry")
        try:
            city = City.model_validate_json(first[1]["json"])
        except ValidationError as error:
            raise self.damaged(entry, _first_of(error)) from error
        plan = self._plan
        if city.format != FORMAT:
            raise self.damaged(entry, f"format is {city.format}, but this release reads {FORMAT}")
        if city.pack != plan.stem:
            raise self.damaged(entry, f"pack is {city.pack!r} instead of {plan.stem!r}")
        if city.grid != numbers_of(self._grid) or len(city.rows_seen) != self._grid.rows:
            raise self.damaged(entry, f"grid and rows_seen do not belong to {self._grid}")
        if city.places > plan.places or city.queries != city.places * plan.queries_a_place:
            raise self.damaged(
                entry,
                f"places is {city.places} and queries is {city.queries}, but the city has up to {plan.places} places with "
                f"{plan.queries_a_place} queries each",
            )
        return city

    def sample(self, key: str, found: _Files, kind: Kind) -> Sample:
        """Check the files of a place or query, and return the content of its JSON file.

        Args:
            key: key of the sample.
            found: its files.
            kind: the kind that it must have.
        """
        for extension in ("json", *kind.fields):
            if extension not in found:
                raise self.damaged(f"{key}.{extension}", "it is missing, or not beside the other files of its sample")
        try:
            sample = Sample.model_validate_json(found["json"])
        except ValidationError as error:
            raise self.damaged(f"{key}.json", _first_of(error)) from error
        if sample.crc32.get("pose") != crc_of_pose(sample.pose):
            raise self.damaged(f"{key}.json", "its pose does not match its CRC-32")
        for extension in kind.fields:
            if sample.crc32.get(extension) != zlib.crc32(found[extension]):
                raise self.damaged(f"{key}.{extension}", f"it does not match the CRC-32 in {key}.json")
        return sample

    def array(self, key: str, extension: str, content: bytes) -> NDArray[np.generic]:
        """Return an array of a sample without a copy. Its header is checked first.

        Args:
            key: key of the sample.
            extension: file extension of the array.
            content: its file.
        """
        expected, end = shape_of(extension, self._grid), content.find(b"\n", 0, _MOST_HEADER_BYTES) + 1
        try:
            shape, is_fortran, dtype = _header_of(content[:end])
        except NPY_HEADER_ERRORS as error:
            raise self.damaged(f"{key}.{extension}", f"it has no header of NPY 1.0 ({error})") from error
        if (
            (shape, dtype) != (expected.shape, expected.dtype)
            or is_fortran
            or len(content) - end != expected.content_bytes
        ):
            raise self.damaged(
                f"{key}.{extension}",
                f"it holds {len(content) - end:,} bytes of {dtype} with the shape {shape}, but {expected.content_bytes:,} bytes of "
                f"{expected.dtype} with the shape {expected.shape} in C order are expected",
            )
        return np.frombuffer(content, dtype, offset=end).reshape(shape)


def _first_of(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_input=False)[0]
    return f"{'.'.join(str(part) for part in first['loc']) or 'the file'}: {first['msg']}"


@lru_cache(maxsize=64)  # all arrays of one kind have the same header
def _header_of(header: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    file = io.BytesIO(header)
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError("another version")
    return np.lib.format.read_array_header_1_0(file, max_header_size=_MOST_HEADER_BYTES)


class _NewArray:
    """A new ``.npy`` file whose rows are written in any order. In the end it has the bytes that ``np.save`` writes.

    Args:
        path: file to write.
        rows: number of rows.
        row: type and shape of a row.
    """

    def __init__(self, path: Path, rows: int, row: ArrayShape) -> None:
        self._file = path.open("xb")
        shape = (rows, *row.shape)
        described = {"descr": np.lib.format.dtype_to_descr(row.dtype), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(self._file, described)
        self._start = self._file.tell()

    def put(self, number: int, row: NDArray[np.generic]) -> None:
        """Write a row.

        Args:
            number: index of the row.
            row: its elements.
        """
        self._file.seek(self._start + number * row.nbytes)
        self._file.write(row.tobytes())

    def __enter__(self) -> "_NewArray":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
