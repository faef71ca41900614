"""On unsupported platforms the service exits at once with one line."""

import platform
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from service import platforms
from service.errors import UnsupportedPlatformError

ROOT = Path(__file__).parents[2]
OTHERS = [("win32", "AMD64"), ("linux", "riscv64"), ("linux", "armv7l"), ("freebsd14", "x86_64"), ("darwin", "x86_64")]


@pytest.mark.parametrize(("system", "machine"), [("linux", "x86_64"), ("linux", "aarch64"), ("darwin", "arm64")])
def test_linux_and_macos_are_supported(monkeypatch, system, machine):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(platform, "machine", lambda: machine)
    platforms.require_supported()


@pytest.mark.parametrize(("system", "machine"), OTHERS)
def test_others_are_refused_by_name(monkeypatch, system, machine):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(platform, "machine", lambda: machine)
    with pytest.raises(
        UnsupportedPlatformError, match=rf"not run on {system} \({machine}\): it runs on Linux \(x86-64"
    ):
        platforms.require_supported()


def after(change: str, statement: str) -> "subprocess.CompletedProcess[str]":
    """Run a statement on a fake platform."""
    return subprocess.run(
        [sys.executable, "-c", f"import platform; {change}; {statement}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )


RISCV = "platform.machine = lambda: 'riscv64'"


def test_the_command_ends_with_one_line():
    done = after(RISCV, "from service.cli.main import main; main(['--help'])")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("streetfix: Streetfix does not run on linux (riscv64): it runs on Linux")


@pytest.mark.parametrize(
    "module", ["service.localization.localizer", "service.registration.kernel", "service.compiled"]
)
def test_the_core_cannot_be_imported(module):
    done = after(RISCV, f"import {module}")
    assert done.returncode == 1
    assert "UnsupportedPlatformError: Streetfix does not run on linux (riscv64)" in done.stderr


def test_the_packages_metadata_names_the_same_systems():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    told = {each.rpartition(" :: ")[2] for each in project["classifiers"] if each.startswith("Operating System")}
    assert told == {"Linux", "MacOS"}
    assert {system for system, _ in platforms.SUPPORTED} == {"linux", "darwin"}


def test_a_plain_installation_gets_a_numpy_that_jaxtyping_can_read():
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    (numpy,) = (each for each in map(Requirement, wanted) if each.name == "numpy")
    assert numpy.specifier.contains("2.4.6")
    assert not numpy.specifier.contains("2.5.0")  # its NDArray is a type alias, and jaxtyping 0.3.11 raises TypeError
