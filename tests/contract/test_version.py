"""The version is written where people look for it, and it is the same everywhere."""

import re
import tomllib
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).parents[2]


def declared() -> str:
    return str(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"])


def test_the_changelogs_newest_release_is_the_declared_version() -> None:
    # "## Unreleased" may stand above it.
    releases = re.findall(r"^## \[?v?(\d+\.\d+\.\d+\S*?)\]?(?:\s|$)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert releases
    assert releases[0] == declared()


def test_the_installed_version_is_the_declared_one() -> None:
    assert version("streetfix") == declared()
