"""The served page equals the built page, and it loads nothing from other hosts."""

import gzip
import re
from pathlib import Path

import pytest

from service.console.built import main, note_of
from service.console.page import CONTENT_SECURITY_POLICY, INDEX, built_files

MOST_KB = 1000


def test_every_file_that_the_page_names_is_there() -> None:
    files = built_files()
    named = re.findall(r'(?:src|href)="\./([^"]+)"', files[INDEX].content.decode())
    assert len(named) >= 3
    assert set(named) <= set(files)


def test_the_page_is_small() -> None:
    assert sum(len(file.compressed) for file in built_files().values()) <= 1000 * MOST_KB


def test_changed_files_get_new_names_and_others_are_revalidated() -> None:
    files = built_files()
    assert not files[INDEX].lasts
    assert all(file.lasts and re.search(r"-[\w-]{8}\.", name) for name, file in files.items() if name != INDEX)
    assert all(gzip.decompress(file.compressed) == file.content for file in files.values())


def test_nothing_inline_is_needed_and_nothing_inline_is_allowed() -> None:
    page = built_files()[INDEX].content.decode()
    assert not re.search(r"<script(?![^>]*\ssrc=)|<style|\sstyle=|\son\w+=", page)
    assert "unsafe" not in CONTENT_SECURITY_POLICY
    assert CONTENT_SECURITY_POLICY.startswith("default-src 'none'")


def test_the_build_is_that_of_the_sources(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--check"]) == 0, capsys.readouterr().err


def test_a_changed_source_or_file_is_noticed(tmp_path: Path) -> None:
    web, static = tmp_path / "web", tmp_path / "static"
    (web / "src").mkdir(parents=True)
    static.mkdir()
    (web / "src" / "main.ts").write_text("1")
    (static / "index.html").write_text("1")
    before = note_of(web, static)
    (web / "src" / "main.ts").write_text("2")
    between = note_of(web, static)
    (static / "index.html").write_text("2")
    after = note_of(web, static)
    assert before["sources"] != between["sources"] == after["sources"]
    assert before["files"] == between["files"] != after["files"]


def test_a_folder_without_a_build_has_no_files(tmp_path: Path) -> None:
    assert built_files(tmp_path) == {}
