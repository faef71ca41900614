"""Code blocks of documents: a failing block counts as failed."""

from pathlib import Path

import pytest

from benchmarks import docs_blocks


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(docs_blocks, "PAGES", ("page.md",))
    monkeypatch.setattr(docs_blocks, "pages", lambda: [tmp_path / "page.md"])
    return tmp_path / "page.md"


def test_blocks_share_a_folder_and_failures_are_counted(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page.write_text(
        '<!-- file: a.json -->\n```json\n{"a": 1}\n```\n```sh\ntest -f a.json\nstreetfix --version | grep streetfix\n```\n'
        "```sh\nfalse | cat\n```\n```json\n{\n```\n```python\nimport json; assert json.load(open('a.json')) == {'a': 1}\n```\n"
        "<!-- not run: dear -->\n```sh\nfalse\n```\n```text\nnothing\n```\n"
    )
    assert docs_blocks.code_blocks_run(("page.md",)) == (3, 5)
    told = capsys.readouterr().out
    assert "page.md:9 sh: FAILED" in told
    assert "page.md:12 json: FAILED" in told


def test_a_service_that_does_not_start_fails_its_block(page: Path) -> None:
    page.write_text("```sh\nstreetfix serve maps/none\necho asked\n```\n")
    assert docs_blocks.code_blocks_run(("page.md",)) == (0, 1)
