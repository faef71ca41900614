from pathlib import Path

import numpy as np
import pytest
import zstandard

from service.maps.byte_planes import Columns, read_records, write_records

RECORD = np.dtype([("cell", "<i4", (3,)), ("sum", "<f4")])


def records_of(count: int) -> np.ndarray:
    found = np.zeros(count, RECORD)
    found["cell"] = np.arange(3 * count).reshape(count, 3)
    found["sum"] = np.random.default_rng(0).normal(size=count)
    return found


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_records_are_read_as_they_were_written(tmp_path: Path, count: int) -> None:
    write_records(tmp_path / "r", Columns.of(records_of(count)[::-1]))
    found = read_records(tmp_path / "r", RECORD)
    assert found.dtype == RECORD
    np.testing.assert_array_equal(found, records_of(count)[::-1])


def test_a_file_of_cells_is_much_smaller_than_the_cells(tmp_path: Path) -> None:
    records = records_of(100_000)
    write_records(tmp_path / "r", Columns.of(records))
    assert (tmp_path / "r").stat().st_size < 0.5 * records.nbytes


@pytest.mark.parametrize(
    ("damage", "what"),
    [
        (lambda _: b"", "not a valid zstd frame"),
        (lambda _: b"no frame at all", "not a valid zstd frame"),
        (lambda frame: frame[:-5], "not a valid zstd frame"),
        (lambda frame: frame + b"more", "not a valid zstd frame"),
        (
            lambda _: zstandard.ZstdCompressor().compress(bytes(17)),
            "17 bytes is not a multiple of the record size, 16 bytes",
        ),
        (
            lambda _: zstandard.ZstdCompressor(write_content_size=False).compress(bytes(16)),
            "zstd frame|not a multiple of the record size",
        ),
    ],
)
def test_a_damaged_file_is_refused(tmp_path: Path, damage, what: str) -> None:
    write_records(tmp_path / "r", Columns.of(records_of(50)))
    (tmp_path / "r").write_bytes(damage((tmp_path / "r").read_bytes()))
    with pytest.raises(ValueError, match=what):
        read_records(tmp_path / "r", RECORD)
