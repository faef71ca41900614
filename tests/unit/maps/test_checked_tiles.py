"""What a process remembers of the tiles that it has checked."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from service.maps import checked_tiles
from service.maps.checked_tiles import Checked, CheckedTiles, mark_of


@pytest.fixture
def tile(tmp_path: Path) -> Path:
    (tmp_path / "tile" / "cloud").mkdir(parents=True)
    (tmp_path / "tile" / "views.npy").write_bytes(b"views")
    (tmp_path / "tile" / "cloud" / "surfels.npy").write_bytes(b"surfels")
    return tmp_path / "tile"


def _replace(file: Path) -> None:
    """Another file of the same content, size and time, as a copy with preserved times makes it."""
    shutil.copy2(file, file.with_name("new"))
    file.with_name("new").replace(file)


@pytest.mark.parametrize(
    "change",
    [
        lambda tile: (tile / "views.npy").write_bytes(b"longer views"),
        lambda tile: os.utime(tile / "views.npy", ns=(0, 1)),  # as a write of the same size leaves it
        lambda tile: _replace(tile / "cloud" / "surfels.npy"),
        lambda tile: (tile / "more").touch(),
        lambda tile: (tile / "views.npy").unlink(),
        lambda tile: (tile / "views.npy").rename(tile / "other.npy"),
    ],
    ids=["size", "time", "inode", "added", "removed", "renamed"],
)
def test_a_change_of_a_file_changes_the_mark(tile: Path, change: Callable[[Path], object]) -> None:
    before = mark_of(tile)
    assert mark_of(tile) == before
    change(tile)
    assert mark_of(tile) != before


def test_a_renamed_folder_and_links_to_its_files_have_the_same_mark(tile: Path, tmp_path: Path) -> None:
    before = mark_of(tile)
    shutil.copytree(tile, tmp_path / "linked", copy_function=os.link)
    shutil.copytree(tile, tmp_path / "copied")
    assert mark_of(tmp_path / "linked") == mark_of(tile) == before
    assert mark_of(tmp_path / "copied") != before
    assert mark_of(tile.rename(tmp_path / "renamed")) == before
    assert mark_of(tmp_path / "missing") != before


def test_only_the_same_version_and_mark_are_known() -> None:
    known = CheckedTiles()
    assert known.get("v1", b"a") == Checked.NOTHING
    known.add("v1", b"a", Checked.HASHES)
    assert known.get("v1", b"a") == Checked.HASHES
    assert known.get("v2", b"a") == known.get("v1", b"b") == Checked.NOTHING
    known.add("v1", b"a", Checked.ALL)
    known.add("v1", b"a", Checked.HASHES)  # checked less once more
    assert known.get("v1", b"a") == Checked.ALL


def test_the_oldest_entries_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checked_tiles, "MOST_REMEMBERED", 2)
    known = CheckedTiles()
    for version in ("v1", "v2", "v1", "v3"):
        known.add(version, b"a", Checked.ALL)
    assert [known.get(version, b"a") for version in ("v1", "v2", "v3")] == [Checked.ALL, Checked.NOTHING, Checked.ALL]
