"""Checks of options that name the folder of a map. Several commands share them."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import typer

#: A path that was a URL: pathlib makes one slash of two.
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/")

Given = TypeVar("Given", bound=Path | str | Sequence[Path] | None)


def folder_of_map(given: Given) -> Given:
    """Refuse a URL where a command reads a map from a folder.

    Args:
        given: value of the option or argument, or all values of one that may be repeated.

    Raises:
        BadParameter: a value is a URL. The message names the option. It does not repeat the URL, which may have credentials.
    """
    return _without_urls(
        given,
        "is a URL, but this command reads a folder; copy the map first (streetfix map pull URL FOLDER), and name that folder",
    )


def folder_of_new_map(given: Given) -> Given:
    """Refuse a URL where a command writes a map into a folder.

    Args:
        given: value of the option or argument.

    Raises:
        BadParameter: the value is a URL. The message names the option. It does not repeat the URL, which may have credentials.
    """
    return _without_urls(
        given,
        "is a URL, but this command writes a folder; name a folder, and copy the map afterwards (streetfix map push FOLDER URL)",
    )


def _without_urls(given: Given, problem: str) -> Given:
    values = [given] if isinstance(given, Path | str) or given is None else [*given]
    for each in values:
        if found := _URL.match(str(each)):
            raise typer.BadParameter(f"{found[1]}://... {problem}")
    return given
