"""The exception tree, the table of the REST face and the documentation say the same."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest

from service import errors
from service.errors import Kind, StreetfixError
from service.http.problems import CODE_OF_STATUS, STATUS_OF_KIND, title_of

ROOT = Path(__file__).parents[2]


def tree(root: type[StreetfixError]) -> Iterator[type[StreetfixError]]:
    yield root
    for child in root.__subclasses__():
        yield from tree(child)


CLASSES = list(tree(StreetfixError))


def documented_codes() -> set[str]:
    text = (ROOT / "docs" / "problems.md").read_text()
    return set(re.findall(r"^\| `([a-z-]+)` \|", text, flags=re.MULTILINE))


def test_codes_are_unique() -> None:
    codes = [each.code for each in CLASSES]
    assert len(codes) == len(set(codes))


def test_every_code_is_documented_and_nothing_else() -> None:
    assert documented_codes() == {each.code for each in CLASSES} | set(CODE_OF_STATUS.values())


def test_every_kind_has_a_status_and_nothing_else() -> None:
    assert set(STATUS_OF_KIND) == set(get_args(Kind)) >= {each.kind for each in CLASSES}


@pytest.mark.parametrize("error", CLASSES, ids=lambda error: error.__name__)
def test_the_tree_in_the_docstring_has_the_class_with_its_code_and_kind(error: type[StreetfixError]) -> None:
    if error is not StreetfixError:
        assert re.search(rf"─ {error.__name__} +{error.code} +{error.kind} ", errors.__doc__ or "")


@pytest.mark.parametrize("error", CLASSES, ids=lambda error: error.__name__)
def test_every_class_has_a_title_of_its_own(error: type[StreetfixError]) -> None:
    assert title_of(error)
    assert [title_of(each) for each in CLASSES].count(title_of(error)) == 1


@pytest.mark.parametrize("status", STATUS_OF_KIND.values())
def test_documented_statuses_are_those_of_the_table(status: int) -> None:
    assert f"| {status} |" in (ROOT / "docs" / "problems.md").read_text()
