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


def test_a_block_that_asks_over_grpc_gets_a_service(page: Path, bundle_path: Path) -> None:
    program = (
        "from streetfix import GrpcClient\n"
        "with GrpcClient('127.0.0.1:50051') as client: assert [each.name for each in client.maps()] == ['tiny']\n"
    )
    page.write_text(f"```sh\nmkdir maps\ncp -r {bundle_path} maps/small\n```\n```python\n{program}```\n")
    assert docs_blocks.code_blocks_run(("page.md",)) == (2, 2)
