"""Build wheels of this working tree with a chosen compiler, and run Python in them."""

import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import zipfile
from pathlib import Path
from typing import Literal

ROOT = Path(__file__).resolve().parents[2]
Compiler = Literal["gcc", "zig"]

_BUILD = "import sys; sys.path.insert(0, 'native'); import build_backend; build_backend.build_wheel({folder!r}, {settings!r})"


def build_wheel(folder: Path, compiler: Compiler, settings: dict[str, str] | None = None) -> Path:
    """Build a wheel by the project's own backend, and unpack it.

    Args:
        folder: folder to create for the wheel.
        compiler: ``gcc``, or ``zig`` as on a machine without a compiler.
        settings: settings of scikit-build-core.

    Returns:
        The folder of the unpacked wheel.

    Raises:
        subprocess.CalledProcessError: the build failed; its output is on stderr.
    """
    folder.mkdir(parents=True)
    environment = {
        name: value for name, value in os.environ.items() if name not in ("CC", "CFLAGS", "CMAKE_ARGS", "LDFLAGS")
    }
    with tempfile.TemporaryDirectory() as without_programs:
        if compiler == "zig":
            environment["PATH"] = without_programs
        else:
            environment["CC"] = "gcc"
        command = [sys.executable, "-c", _BUILD.format(folder=str(folder), settings=settings or {})]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        print(done.stdout[-4000:], done.stderr[-4000:], file=sys.stderr)
        done.check_returncode()
    unpacked = folder / "unpacked"
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as archive:
        archive.extractall(unpacked)
    return unpacked


def libraries(unpacked: Path) -> list[Path]:
    """Return the compiled libraries of an unpacked wheel.

    Args:
        unpacked: folder of the unpacked wheel.
    """
    return sorted(unpacked.rglob("_*.so"))


def python_in(unpacked: Path, arguments: list[str], **environment: str) -> "subprocess.CompletedProcess[str]":
    """Run Python with the packages of an unpacked wheel instead of the working tree's.

    ``-S`` skips the .pth file of an editable install, which would put the working tree first.

    Args:
        unpacked: folder of the unpacked wheel.
        arguments: arguments of Python.
        **environment: further environment variables.
    """
    places = [str(unpacked), sysconfig.get_path("purelib"), sysconfig.get_path("platlib"), str(ROOT)]
    return subprocess.run(
        [sys.executable, "-S", "-P", *arguments],
        cwd=unpacked,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(dict.fromkeys(places)), **environment},
    )


def has_gcc() -> bool:
    """Return whether gcc is installed."""
    return shutil.which("gcc") is not None
