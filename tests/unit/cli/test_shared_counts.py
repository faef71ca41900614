"""Shared counts: the blocks of a file are allocated before workers count in it."""

import os
import subprocess
import sys
from pathlib import Path

from prometheus_client.mmap_dict import MmapedDict

from service.cli.shared_counts import RESERVED_BYTES, release, reserve


def test_every_file_has_its_blocks(tmp_path: Path) -> None:
    assert reserve(tmp_path) is None
    paths = sorted(tmp_path.iterdir())
    assert [path.name for path in paths] == [
        f"{kind}_{os.getpid()}.db" for kind in ("counter", "gauge_livesum", "histogram")
    ]
    assert all(path.stat().st_size == RESERVED_BYTES for path in paths)
    assert all(path.stat().st_blocks * 512 >= RESERVED_BYTES for path in paths)


def test_the_library_counts_in_them(tmp_path: Path) -> None:
    assert reserve(tmp_path) is None
    path = str(tmp_path / f"counter_{os.getpid()}.db")
    counts = MmapedDict(path)
    counts.write_value("a", 3.0, 0.0)
    counts.close()
    assert reserve(tmp_path) is None
    assert [(key, value) for key, value, *_ in MmapedDict.read_all_values_from_file(path)] == [("a", 3.0)]


def test_a_process_that_has_ended_leaves_what_it_counted_and_no_more(tmp_path: Path) -> None:
    assert reserve(tmp_path) is None
    counted = tmp_path / f"counter_{os.getpid()}.db"
    counts = MmapedDict(str(counted))
    counts.write_value("a", 3.0, 0.0)
    counts.close()
    release(tmp_path, os.getpid())
    assert [path.name for path in tmp_path.iterdir()] == [counted.name]
    assert counted.stat().st_size < 100
    assert [(key, value) for key, value, *_ in MmapedDict.read_all_values_from_file(counted)] == [("a", 3.0)]


def test_a_process_that_ended_before_it_counted_leaves_nothing(tmp_path: Path) -> None:
    assert reserve(tmp_path) is None
    (tmp_path / f"histogram_{os.getpid()}.db").unlink()
    (tmp_path / f"counter_{os.getpid()}.db").write_bytes(b"")
    release(tmp_path, os.getpid())
    assert [path.stat().st_size for path in tmp_path.iterdir()] == [0]


def test_without_disk_space_nothing_is_left_and_the_reason_is_reported(tmp_path: Path) -> None:
    code = f"""
import resource, pathlib
from service.cli.shared_counts import RESERVED_BYTES, reserve
resource.setrlimit(resource.RLIMIT_FSIZE, (RESERVED_BYTES // 2, resource.RLIM_INFINITY))
print(reserve(pathlib.Path({str(tmp_path)!r})).strerror)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "File too large\n"
    assert not list(tmp_path.iterdir())
