"""The build backend: scikit-build-core, with a C compiler from PyPI where the machine has none.

``pip install`` asks a backend what it needs before it builds (PEP 517). Where neither ``CC`` nor a compiler of this machine is there, the
answer includes ``ziglang``, and the build uses it. All else is scikit-build-core's; its settings stand in ``pyproject.toml``.
"""

import os
import platform
import shutil
import sys
from pathlib import Path

from scikit_build_core import build as standard
from scikit_build_core.build import build_sdist, get_requires_for_build_sdist

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]

Settings = dict[str, list[str] | str] | None

COMPILERS = ("cc", "gcc", "clang")
COMPILER_PACKAGE = "ziglang>=0.13,<0.18"
#: The same as in ``service/platforms.py``, which cannot be imported before the package is built.
SUPPORTED = (("linux", "x86_64"), ("linux", "aarch64"), ("darwin", "arm64"))


def require_supported() -> None:
    """Refuse to build where the service cannot run: a build that succeeds there would only fail later, and less clearly."""
    machine = platform.machine()
    if (sys.platform, machine) not in SUPPORTED:
        raise SystemExit(
            f"Streetfix cannot be built for {sys.platform} ({machine}): it runs on Linux (x86-64, 64-bit ARM) and on macOS "
            "(Apple silicon); on Windows use WSL 2 or the container"
        )


def has_compiler(config_settings: Settings) -> bool:
    """Whether the builder names a compiler, or this machine has one."""
    named = os.environ.get("CC") or os.environ.get("CMAKE_TOOLCHAIN_FILE")
    words = [os.environ.get("CMAKE_ARGS", ""), *(config_settings or {}).keys()]
    named = named or any("CMAKE_C_COMPILER" in word or "CMAKE_TOOLCHAIN_FILE" in word for word in words)
    return bool(named) or any(shutil.which(name) for name in COMPILERS)


def get_requires_for_build_wheel(config_settings: Settings = None) -> list[str]:
    """CMake and Ninja where they are missing, and a compiler likewise."""
    require_supported()
    return [*standard.get_requires_for_build_wheel(config_settings), *_compiler_package(config_settings)]


def get_requires_for_build_editable(config_settings: Settings = None) -> list[str]:
    """As for a wheel."""
    require_supported()
    return [*standard.get_requires_for_build_editable(config_settings), *_compiler_package(config_settings)]


def prepare_metadata_for_build_wheel(metadata_directory: str, config_settings: Settings = None) -> str:
    """The folder of the metadata."""
    return standard.prepare_metadata_for_build_wheel(metadata_directory, config_settings)


def prepare_metadata_for_build_editable(metadata_directory: str, config_settings: Settings = None) -> str:
    """The folder of the metadata."""
    return standard.prepare_metadata_for_build_editable(metadata_directory, config_settings)


def build_wheel(wheel_directory: str, config_settings: Settings = None, metadata_directory: str | None = None) -> str:
    """The name of the wheel."""
    require_supported()
    return standard.build_wheel(wheel_directory, _with_compiler(config_settings), metadata_directory)


def build_editable(
    wheel_directory: str, config_settings: Settings = None, metadata_directory: str | None = None
) -> str:
    """The name of the wheel that points at this folder; the libraries are built beside their sources."""
    require_supported()
    return standard.build_editable(wheel_directory, _with_compiler(config_settings), metadata_directory)


def _compiler_package(config_settings: Settings) -> list[str]:
    return [] if has_compiler(config_settings) else [COMPILER_PACKAGE]


def _with_compiler(config_settings: Settings) -> Settings:
    """The same settings, with the compiler from PyPI where there is no other."""
    if has_compiler(config_settings):
        return config_settings
    try:
        import ziglang
    except ModuleNotFoundError as error:
        raise SystemExit(
            "There is no C compiler: install gcc or clang, name one by CC, or run `pip install ziglang` "
            "(pip does that itself unless build isolation is off)"
        ) from error
    zig = Path(ziglang.__file__).with_name("zig")
    return {**(config_settings or {}), "cmake.define.CMAKE_C_COMPILER": f"{zig};cc"}
