"""Our part of the build backend: the choice of the compiler, and the error without one."""

import importlib.util
import shutil
import sys
from pathlib import Path
from types import ModuleType

import pytest

from service import platforms

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def backend() -> ModuleType:
    spec = importlib.util.spec_from_file_location("build_backend", ROOT / "native" / "build_backend.py")
    assert spec is not None
    assert spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


@pytest.fixture
def machine(monkeypatch):
    """Return a machine with only these programs and these build variables."""

    def of(*programs, **variables):
        found = {"cmake": shutil.which("cmake"), "ninja": shutil.which("ninja")}
        monkeypatch.setattr(
            shutil, "which", lambda name, **_: f"/usr/bin/{name}" if name in programs else found.get(name)
        )
        for name in ("CC", "CMAKE_ARGS", "CMAKE_TOOLCHAIN_FILE"):
            monkeypatch.delenv(name, raising=False)
        for name, value in variables.items():
            monkeypatch.setenv(name, value)

    return of


@pytest.fixture
def standard(backend, monkeypatch):
    """Return the settings that scikit-build-core receives."""
    given = []
    for name in ("build_wheel", "build_editable"):
        monkeypatch.setattr(
            backend.standard, name, lambda _folder, settings, _metadata: given.append(settings) or "wheel"
        )
    return given


@pytest.mark.parametrize(
    ("programs", "variables", "settings"),
    [
        (["cc"], {}, None),
        (["gcc"], {}, {}),
        (["clang"], {}, None),
        ([], {"CC": "icx"}, None),
        ([], {"CMAKE_ARGS": "-DCMAKE_C_COMPILER=icx"}, None),
        ([], {"CMAKE_TOOLCHAIN_FILE": "arm.cmake"}, None),
        ([], {}, {"cmake.define.CMAKE_C_COMPILER": "icx"}),
    ],
)
def test_a_compiler_of_the_builder_or_the_machine_is_left_to_cmake(
    backend, machine, standard, programs, variables, settings
):
    machine(*programs, **variables)
    assert backend.get_requires_for_build_wheel(settings) == backend.standard.get_requires_for_build_wheel(settings)
    backend.build_wheel("folder", settings)
    backend.build_editable("folder", settings)
    assert standard == [settings, settings]


def test_a_machine_without_a_compiler_takes_one_from_the_package_index(backend, machine, standard):
    machine()
    for requires in (backend.get_requires_for_build_wheel, backend.get_requires_for_build_editable):
        assert [each.split(">")[0] for each in requires() if each.startswith("zig")] == ["ziglang"]
    ziglang = pytest.importorskip("ziglang")
    backend.build_wheel("folder", {"wheel.packages": "service"})
    backend.build_editable("folder")
    zig = f"{Path(ziglang.__file__).with_name('zig')};cc"
    assert standard == [
        {"wheel.packages": "service", "cmake.define.CMAKE_C_COMPILER": zig},
        {"cmake.define.CMAKE_C_COMPILER": zig},
    ]


def test_without_any_compiler_the_message_says_how_to_get_one(backend, machine, standard, monkeypatch):
    machine()
    monkeypatch.setitem(sys.modules, "ziglang", None)
    with pytest.raises(
        SystemExit, match="no C compiler: install gcc or clang, name one by CC, or run `pip install ziglang`"
    ):
        backend.build_wheel("folder")
    assert standard == []


@pytest.mark.parametrize(("system", "processor"), [("win32", "AMD64"), ("linux", "riscv64"), ("freebsd14", "x86_64")])
def test_where_the_service_cannot_run_nothing_is_built(backend, monkeypatch, standard, system, processor):
    monkeypatch.setattr(backend.sys, "platform", system)
    monkeypatch.setattr(backend.platform, "machine", lambda: processor)
    steps = (
        backend.get_requires_for_build_wheel,
        backend.get_requires_for_build_editable,
        lambda: backend.build_wheel("folder"),
        lambda: backend.build_editable("folder"),
    )
    for step in steps:
        with pytest.raises(
            SystemExit, match=rf"cannot be built for {system} \({processor}\): it runs on Linux \(x86-64"
        ):
            step()
    assert standard == []


def test_build_and_service_agree_on_the_platforms(backend):
    assert backend.SUPPORTED == platforms.SUPPORTED
