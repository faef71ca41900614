"""Compiles the C files when the package is built; where no C compiler is installed, with one from PyPI."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SOURCES = tuple(
    Path("service") / name
    for name in (
        "registration/kernel.c",
        "registration/points.c",
        "registration/rays.c",
        "imaging/gather.c",
        "imaging/level.c",
        "imaging/depth16.c",
    )
)
# Nobody looks at floating-point exceptions nor at errno, and a compiler that minds them cannot choose without a branch.
FLAGS = ["-O3", "-std=c11", "-fno-trapping-math", "-fno-math-errno", "-shared", "-fPIC", "-Wall", "-Wextra", "-Werror"]


def compiler() -> list[str] | None:
    """The C compiler of this machine, ``CC`` first; None where there is none."""
    for name in (os.environ.get("CC"), "cc", "gcc", "clang"):
        words = (name or "").split()
        if words and shutil.which(words[0]):
            return words
    return None


class KernelHook(BuildHookInterface[Any]):
    """``_NAME.so`` beside each ``NAME.c``, in the wheel and in editable installs."""

    def dependencies(self) -> list[str]:
        """What the build environment must hold beyond hatchling."""
        return [] if compiler() else ["ziglang>=0.13,<0.18"]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002  # hatchling's signature
        """Compile, and mark the wheel as one for this platform and any Python 3."""
        if self.target_name != "wheel":
            return
        command = compiler() or [sys.executable, "-m", "ziglang", "cc"]
        for source in SOURCES:
            library = source.with_name(f"_{source.stem}.so")
            part = Path(self.root) / library.with_suffix(".part")
            subprocess.run([*command, *FLAGS, "-o", str(part), str(Path(self.root) / source), "-lm"], check=True)  # noqa: S603  # no shell; the compiler is the builder's own
            part.rename(Path(self.root) / library)
            build_data["artifacts"].append(f"/{library.as_posix()}")
        build_data["pure_python"] = False
        from packaging.tags import platform_tags  # comes with hatchling

        build_data["tag"] = f"py3-none-{next(platform_tags())}"
