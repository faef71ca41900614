"""The hosted workflow: nobody runs it here, so what it says is compared with the repository."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[2]
WORKFLOW = ROOT / ".github" / "workflows" / "ci.yml"


@pytest.fixture(scope="module")
def jobs() -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = yaml.safe_load(WORKFLOW.read_text())["jobs"]
    return found


@pytest.fixture(scope="module")
def pythons() -> list[str]:
    """That the package says it is for."""
    classifiers = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["classifiers"]
    return re.findall(r"Python :: (3\.\d+)", "\n".join(classifiers))


@pytest.mark.parametrize("job", ["test", "test-aarch64"])
def test_every_python_that_the_package_names_is_tested(
    jobs: dict[str, dict[str, Any]], pythons: list[str], job: str
) -> None:
    assert jobs[job]["strategy"]["matrix"]["python"] == pythons
    assert pythons == ["3.11", "3.12", "3.13", "3.14"]


def test_aarch64_is_tested_and_built(jobs: dict[str, dict[str, Any]]) -> None:
    assert jobs["test-aarch64"]["runs-on"].endswith("-arm")
    for job in ("wheels", "image"):
        assert any(runner.endswith("-arm") for runner in jobs[job]["strategy"]["matrix"]["runner"])


def test_every_make_target_is_one_of_the_makefile(jobs: dict[str, dict[str, Any]]) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    asked = {command.split()[-1] for command in commands if command.startswith("make ")}
    assert asked <= targets
    assert asked >= {"check", "test", "test-service", "sanitize", "sbom", "audit"}


def test_every_action_is_pinned_by_commit_and_names_its_release() -> None:
    used = re.findall(r"uses: (.*)", WORKFLOW.read_text())
    assert used
    assert all(re.fullmatch(r"[a-z-]+/[a-z-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", each) for each in used)
    assert len({each.partition("@")[0] for each in used}) == len(set(used))  # one release of each


def test_it_may_read_and_nothing_else() -> None:
    told = yaml.safe_load(WORKFLOW.read_text())
    assert told["permissions"] == {"contents": "read"}
    assert not any("permissions" in job for job in told["jobs"].values())


def test_wheels_are_built_where_the_service_is_supported() -> None:
    told = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["cibuildwheel"]
    assert told["build"] == "cp311-*"  # one build serves every Python
    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["scikit-build"]["wheel"]["py-api"] == "py3"
    assert {name for name in told["linux"] if name.endswith("-image")} == {
        "manylinux-x86_64-image",
        "manylinux-aarch64-image",
    }
    assert told["macos"]["archs"] == ["arm64"]


def test_the_checks_of_everybody_run_the_sanitizers_in_earnest() -> None:
    lines = (ROOT / ".ci" / "run").read_text().splitlines()
    assert "CI=true make sanitize" in lines
    assert {"make check", "make test", "make sbom"} <= set(lines)
