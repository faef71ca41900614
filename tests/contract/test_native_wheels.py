"""Wheels as users get them: built with gcc, and with zig where a machine has no compiler."""

import platform
import re
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

from benchmarks.native.instructions import beyond_baseline
from benchmarks.native.wheels import ROOT, build_wheel, has_gcc, libraries, python_in

ziglang = pytest.importorskip("ziglang")
ZIG = [sys.executable, "-m", "ziglang", "cc"]
C_FILES = sorted(path for folder in ("service", "model_training") for path in (ROOT / folder).rglob("*.c"))
on_x86_64 = pytest.mark.skipif(platform.machine() != "x86_64", reason="the disassembler is asked for x86-64")
with_gcc = pytest.mark.skipif(not has_gcc(), reason="no gcc on this machine")


@pytest.fixture(scope="session")
def by_zig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The unpacked wheel of a machine without a compiler; kept for all tests, as zig compiles its own runtime once."""
    return build_wheel(tmp_path_factory.mktemp("native") / "zig", "zig")


@pytest.fixture(scope="session")
def by_gcc(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_wheel(
        tmp_path_factory.mktemp("native") / "gcc", "gcc", {"cmake.define.CMAKE_COMPILE_WARNING_AS_ERROR": "ON"}
    )


def compiler_of(library: Path) -> str:
    return "zig" if b"clang version" in library.read_bytes() else "gcc"


@on_x86_64
def test_without_a_compiler_no_instruction_is_beyond_the_baseline(by_zig: Path) -> None:
    found = {library.stem: beyond_baseline(library) for library in libraries(by_zig)}
    assert found == {f"_{path.stem}": {} for path in C_FILES}
    assert {compiler_of(library) for library in libraries(by_zig)} == {"zig"}


@on_x86_64
@with_gcc
def test_with_gcc_only_what_is_chosen_at_load_time_is_beyond_the_baseline(by_gcc: Path) -> None:
    found = {library.stem: beyond_baseline(library, without_clones=True) for library in libraries(by_gcc)}
    assert found == {f"_{path.stem}": {} for path in C_FILES}
    assert {compiler_of(library) for library in libraries(by_gcc)} == {"gcc"}


@on_x86_64
@pytest.mark.parametrize(
    ("flags", "mnemonic"),
    [
        (["-mcpu=x86_64_v4"], "zmm"),
        (["-mcpu=x86_64_v3", "-ffp-contract=fast"], "vfmadd"),
        (["-mcpu=x86_64_v2"], "round"),
    ],
)
def test_what_is_beyond_the_baseline_is_seen(tmp_path: Path, flags: list[str], mnemonic: str) -> None:
    library, source = tmp_path / "wide.o", tmp_path / "wide.c"
    source.write_text(
        "#include <math.h>\n"
        "void wide(double *a, const double *b, int n) { for (int i = 0; i < n; i++) a[i] = floor(a[i]) * b[i] + a[i]; }\n"
    )
    subprocess.run([*ZIG, *flags, "-O3", "-c", "-o", str(library), str(source)], check=True)
    found = beyond_baseline(library)
    assert found.total() > 0
    if mnemonic != "zmm":  # a register, not an instruction
        assert any(mnemonic in name for name in found)
    assert beyond_baseline(library, without_clones=True) == found


@with_gcc
def test_the_builds_of_both_compilers_return_the_same_bits(by_zig: Path, by_gcc: Path) -> None:
    arguments = ["-W", "ignore", "-m", "benchmarks.native.inputs", "--rounds", "56"]
    told = [python_in(unpacked, arguments) for unpacked in (by_zig, by_gcc)]
    assert [each.returncode for each in told] == [0, 0], told[0].stderr + told[1].stderr
    assert len(told[0].stdout.splitlines()) == 56 * 8
    assert told[0].stdout == told[1].stdout


def test_the_packages_of_the_wheel_are_what_ran(by_zig: Path) -> None:
    done = python_in(
        by_zig, ["-c", "from service.registration import kernel; kernel._library(); print(kernel.LIBRARY)"]
    )
    assert done.stdout.strip() == str(by_zig / "service" / "registration" / "_kernel.so")


def test_the_wheel_is_for_this_platform_and_any_python_3(by_zig: Path) -> None:
    wheel = next(by_zig.parent.glob("*.whl"))
    system = {"linux": "linux", "darwin": r"macosx_\d+_\d+"}[sys.platform]
    # No claim of manylinux: only auditwheel, which looks at what the libraries need, makes that.
    assert re.fullmatch(rf"streetfix-[^-]+-py3-none-{system}_{platform.machine()}\.whl", wheel.name)


def test_the_wheel_holds_no_source_of_c_and_nothing_of_the_working_tree(by_zig: Path) -> None:
    # The file itself: programs of other tests write bytecode into the unpacked packages.
    with ZipFile(next(by_zig.parent.glob("*.whl"))) as wheel:
        held = {name for name in wheel.namelist() if not name.endswith("/")}
    assert not [name for name in held if name.endswith((".c", ".h", ".ts")) or "__pycache__" in name]
    assert {name.partition("/")[0] for name in held if ".dist-info" not in name} == {
        "streetfix",
        "service",
        "model_training",
    }
    tracked = subprocess.run(
        ["git", "ls-files", "streetfix/*.py", "service/*.py", "model_training/*.py"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    assert {name for name in held if name.endswith(".py")} >= set(tracked)


@pytest.mark.parametrize("target", ["aarch64-linux-gnu", "aarch64-macos", "x86_64-macos"])
@pytest.mark.parametrize("source", C_FILES, ids=lambda path: path.stem)
def test_every_file_compiles_for_the_other_platforms(tmp_path: Path, target: str, source: Path) -> None:
    flags = ["-c", "-O1", "-std=c11", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror"]
    done = subprocess.run(
        [*ZIG, "-target", target, *flags, "-o", str(tmp_path / "out.o"), str(source)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
