"""The decision log: every file has the form that ``docs/contributing.md`` gives, and the index is that of the files."""

import re
from pathlib import Path

import pytest

from benchmarks.decisions import FOLDER, INDEX, TOPICS, Decision, decisions, index_of, read_decision

HEAD = """# 0007. Is it so?

- Date: 2026-11-25
- Status: in use
- Topic: retrieval
- Answer: Yes: 0.9 instead of 0.8
  of 26 queries.

## Measured
Nothing else.

## Reopen if
There are more queries.
"""


def written(folder: Path, text: str = HEAD, name: str = "0007-is-it-so.md") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_a_head_is_read_field_by_field(tmp_path: Path) -> None:
    assert read_decision(written(tmp_path)) == Decision(
        "0007-is-it-so.md",
        "0007",
        "Is it so?",
        "2026-11-25",
        "in use",
        "retrieval",
        "Yes: 0.9 instead of 0.8 of 26 queries.",
    )


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("- Date: 2026-11-25\n", "", "head"),
        ("0007. Is", "0008. Is", "0008"),
        ("in use", "undecided", "undecided"),
        ("retrieval", "weather", "weather"),
        ("## Reopen if\n", "## Later\n", "Reopen if"),
        ("There are more queries.\n", "", "Reopen if"),
    ],
)
def test_a_wrong_form_is_named(tmp_path: Path, old: str, new: str, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        read_decision(written(tmp_path, HEAD.replace(old, new)))


def test_numbers_are_unique_and_a_replacement_exists(tmp_path: Path) -> None:
    written(tmp_path)
    other = written(tmp_path, name="0007-again.md")
    with pytest.raises(ValueError, match="0007 occurs twice"):
        decisions(tmp_path)
    other.unlink()
    written(tmp_path, HEAD.replace("in use", "replaced by 0009"))
    with pytest.raises(ValueError, match="0009"):
        decisions(tmp_path)


def test_the_index_lists_newest_first_by_topic(tmp_path: Path) -> None:
    written(tmp_path)
    written(tmp_path, HEAD.replace("0007", "0008").replace("Is it", "Was it"), "0008-was-it-so.md")
    lines = index_of(decisions(tmp_path)).splitlines()
    assert [line for line in lines if line.startswith("| [")] == [
        "| [0008. Was it so?](0008-was-it-so.md) | 2026-11-25 | in use |",
        "| [0007. Is it so?](0007-is-it-so.md) | 2026-11-25 | in use |",
    ]
    assert [line for line in lines if line.startswith("## ")] == ["## Retrieval"]


def test_the_log_has_the_form_and_its_index_is_current() -> None:
    found = decisions()
    assert len(found) > 100
    assert {decision.topic for decision in found} <= set(TOPICS)
    assert INDEX.read_text() == index_of(found), "run `make reports`"


def test_no_line_of_the_documents_is_too_long() -> None:
    """The markers of figures do not count: a row of a table with several of them cannot be wrapped."""
    root = FOLDER.parents[1]
    for page in [root / "README.md", *sorted((root / "docs").rglob("*.md"))]:
        for number, marked in enumerate(page.read_text().splitlines(), 1):
            line = re.sub(r"<!-- /?figure.*?-->", "", marked)
            assert len(line) <= 200, f"{page.relative_to(root)}, line {number}: {len(line)} characters"
