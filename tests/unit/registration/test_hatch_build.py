"""The build hook, without hatchling: it is there only while the package is built."""

import ctypes
import importlib.util
import shutil
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, Generic, TypeVar

import pytest

ROOT = Path(__file__).resolve().parents[3]
C_FILES = tuple(
    f"service/{name}.c"
    for name in (
        "registration/kernel", "registration/points", "registration/rays", "imaging/gather", "imaging/level", "imaging/depth16"
    )
)  # fmt: skip
HEADERS = ("service/registration/surfel.h", "service/registration/wide.h")
T = TypeVar("T")


class Interface(Generic[T]):
    """What the hook takes over from hatchling: nothing that these tests need."""


@pytest.fixture
def hook(monkeypatch) -> Any:
    """The module ``hatch_build``."""
    names = ["hatchling", "builders", "hooks", "plugin", "interface"]
    for depth in range(len(names)):
        module = ModuleType(".".join(names[: depth + 1]))
        monkeypatch.setitem(sys.modules, module.__name__, module)
    module.BuildHookInterface = Interface
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


@pytest.fixture
def machine(monkeypatch):
    """A machine on which only these programs are installed, and this ``CC`` is set."""

    def of(*programs, CC=None):
        monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}" if name in programs else None)
        monkeypatch.delenv("CC", raising=False)
        if CC is not None:
            monkeypatch.setenv("CC", CC)

    return of


@pytest.mark.parametrize(
    ("programs", "CC", "expected"),
    [
        (["cc", "gcc", "clang"], None, ["cc"]),
        (["gcc", "clang"], None, ["gcc"]),
        (["clang"], None, ["clang"]),
        (["cc", "icx"], "icx", ["icx"]),
        (["cc", "ccache", "gcc"], "ccache gcc", ["ccache", "gcc"]),
        (["cc"], "icx", ["cc"]),
        (["cc"], "", ["cc"]),
        ([], None, None),
        ([], "icx", None),
    ],
)
def test_the_compiler_is_the_builders_own_before_any_that_is_installed(hook, machine, programs, CC, expected):
    machine(*programs, CC=CC)
    assert hook.compiler() == expected


def test_only_a_machine_without_a_compiler_needs_one_from_the_package_index(hook, machine):
    machine("gcc")
    assert hook.KernelHook().dependencies() == []
    machine()
    assert [each.split(">")[0] for each in hook.KernelHook().dependencies()] == ["ziglang"]


@pytest.fixture
def tree(tmp_path):
    """A source tree of the C files alone."""
    for source in (*C_FILES, *HEADERS):
        (tmp_path / source).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / source, tmp_path / source)
    return tmp_path


def built(hook, root, *, target="wheel"):
    data = {"artifacts": []}
    hook.KernelHook.initialize(SimpleNamespace(root=str(root), target_name=target), "standard", data)
    return data


@pytest.fixture
def commands(hook, monkeypatch):
    """The compiler's calls; each writes its library and no more."""
    calls = []

    def run(arguments, *, check):
        calls.append((arguments, check))
        Path(arguments[arguments.index("-o") + 1]).write_bytes(b"library")

    monkeypatch.setattr(hook.subprocess, "run", run)
    return calls


@pytest.mark.parametrize(("CC", "command"), [("icx", ["icx"]), (None, [sys.executable, "-m", "ziglang", "cc"])])
def test_each_file_is_compiled_beside_its_source(hook, machine, commands, tree, CC, command):
    machine(*([CC] if CC else []), CC=CC)
    data = built(hook, tree)
    for source, (arguments, check) in zip(C_FILES, commands, strict=True):
        assert arguments[: len(command)] == command
        assert {str(tree / source), "-shared", "-O3"} <= set(arguments)
        assert arguments[-1] == "-lm"
        assert check
        assert (tree / source).with_name(f"_{Path(source).stem}.so").exists()
    assert not list(tree.rglob("*.part"))
    assert data["artifacts"] == [
        "/service/registration/_kernel.so",
        "/service/registration/_points.so",
        "/service/registration/_rays.so",
        "/service/imaging/_gather.so",
        "/service/imaging/_level.so",
        "/service/imaging/_depth16.so",
    ]


def test_the_wheel_is_for_this_platform_and_any_python_3(hook, machine, commands, tree):
    machine("cc")
    data = built(hook, tree)
    assert data["pure_python"] is False
    assert data["tag"].startswith("py3-none-")
    assert not data["tag"].endswith("any")


def test_a_source_archive_compiles_nothing(hook, machine, commands, tree):
    machine("cc")
    assert built(hook, tree, target="sdist") == {"artifacts": []}
    assert commands == []


@pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="no C compiler on this machine")
def test_the_compiled_library_has_what_the_kernel_calls(hook, monkeypatch, tree):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(hook, "FLAGS", ["-O0", *hook.FLAGS[1:]])  # quick; the warnings stay errors
    built(hook, tree)
    library = ctypes.CDLL(str(tree / "service" / "registration" / "_kernel.so"))
    for name in ("align", "mark", "fill", "render"):
        assert hasattr(library, f"streetfix_{name}")
    assert hasattr(ctypes.CDLL(str(tree / "service" / "imaging" / "_gather.so")), "streetfix_gather")
