import os
import platform
import shutil
import socket
import sys
from pathlib import Path

import pytest

from service.doctor import machine
from service.errors import StreetfixError
from service.runtime.settings import Settings


def test_a_supported_platform_is_ok(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    found = machine.check_platform()
    assert (found.level, found.remedy) == ("ok", "")
    assert found.text.startswith("linux on aarch64, Python 3.")


def test_another_platform_is_a_problem_that_says_where_the_service_runs(monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(platform, "machine", lambda: "AMD64")
    found = machine.check_platform()
    assert found.level == "problem"
    assert "does not run on win32 (AMD64)" in found.text
    assert found.remedy == "on Windows use WSL 2 or the container"


def test_a_quota_limits_the_cores(monkeypatch, tmp_path):
    """150 ms of processor time in each 100 ms are 1.5 cores, so two threads."""
    (tmp_path / "cpu.max").write_text("150000 100000\n")
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    assert machine.check_cores(Settings(), tmp_path).text == (
        "2 of 8 usable: a service works on 2 requests at once (workers: 1, threads of each: 2); "
        "a quota allows 1.5 cores of processor time"
    )
    assert machine.check_cores(None, tmp_path).text == "2 of 8 usable; a quota allows 1.5 cores of processor time"


@pytest.mark.parametrize(
    ("workers", "threads", "level", "at_once", "remedy"),
    [
        (1, None, "ok", 4, ""),
        (2, None, "ok", 4, ""),
        (3, None, "ok", 3, ""),  # 4 cores // 3 processes: one thread each
        (2, 2, "ok", 4, ""),
        (1, 7, "warning", 7, "unset STREETFIX_THREADS, or set it to 4"),
        (2, 3, "warning", 6, "unset STREETFIX_THREADS, or set it to 2"),
        (5, None, "warning", 5, "set STREETFIX_WORKERS to at most 4, and unset STREETFIX_THREADS"),
    ],
)
def test_processes_and_threads_beyond_the_cores_get_a_warning(
    monkeypatch, tmp_path, workers, threads, level, at_once, remedy
):
    """The machine has four cores and no quota."""
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(4)), raising=False)
    found = machine.check_cores(Settings(workers=workers, threads=threads), tmp_path)
    assert (found.level, found.remedy) == (level, remedy)
    assert f"a service works on {at_once} requests at once" in found.text


@pytest.mark.parametrize(
    ("kind", "flags", "told"),
    [
        ("x86_64", "fpu avx avx2 bmi1", "x86-64 with AVX2"),
        ("x86_64", "fpu avx", "x86-64 without AVX2: the answers are the same, but take somewhat longer"),
        ("aarch64", "", "64-bit ARM"),
        ("arm64", "", "64-bit ARM"),
    ],
)
def test_the_instruction_set_is_information(monkeypatch, tmp_path, kind, flags, told):
    monkeypatch.setattr(platform, "machine", lambda: kind)
    (tmp_path / "cpuinfo").write_text(f"processor\t: 0\nflags\t\t: {flags}\n\nprocessor\t: 1\n")
    found = machine.check_instructions(tmp_path / "cpuinfo")
    assert (found.level, found.text) == ("ok", told)


def test_without_a_description_of_the_processor_avx2_is_unknown(monkeypatch, tmp_path):
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    found = machine.check_instructions(tmp_path / "missing")
    assert (found.level, found.text) == ("ok", "x86_64; the system does not report whether it has AVX2")


def free_of(monkeypatch, mib: dict[str, int]) -> None:
    """Return the free space of a folder. All other folders are missing."""

    def usage(folder: Path) -> object:
        if str(folder) not in mib:
            raise FileNotFoundError(2, "No such file or directory", str(folder))
        return type("Usage", (), {"free": mib[str(folder)] * 2**20})()

    monkeypatch.setattr(shutil, "disk_usage", usage)


def test_shared_memory_is_ok_even_without_dev_shm(monkeypatch):
    free_of(monkeypatch, {"/t": 48})
    found = machine.check_shared_memory(Path("/none"), temporary=Path("/t"))
    assert found.level == "ok"
    assert found.text.endswith("/none does not exist, and the service does not use it")


def test_the_free_space_of_dev_shm_is_printed(monkeypatch):
    free_of(monkeypatch, {"/t": 1000, "/shm": 64})
    assert machine.check_shared_memory(Path("/shm"), temporary=Path("/t")).text.endswith(
        "/shm has 64 MiB left, and the service does not use it"
    )


def test_a_full_temporary_folder_is_a_warning(monkeypatch):
    """64 workers with three files of 256 KiB each need 48 MiB."""
    free_of(monkeypatch, {"/t": 47, "/shm": 64})
    found = machine.check_shared_memory(Path("/shm"), temporary=Path("/t"))
    assert found.level == "warning"
    assert found.text == "the temporary folder /t has 47 MiB left for the metrics of several workers"
    assert found.remedy.startswith("free 48 MiB")


def test_memory_that_cannot_be_shared_is_a_warning():
    def refuse():
        raise OSError(12, "Cannot allocate memory")

    found = machine.check_shared_memory(make=refuse)
    assert (found.level, "Cannot allocate memory" in found.text) == ("warning", True)


def test_all_compiled_libraries_load():
    files = {
        path.relative_to(Path(machine.__file__).parents[1]).as_posix()
        for path in Path(machine.__file__).parents[1].rglob("_*.so")
    }
    assert files == set(machine.LIBRARIES)
    assert machine.check_libraries(machine.LIBRARIES).text == "all 7 libraries load"


def test_a_library_of_another_release_is_a_problem():
    def old():
        raise StreetfixError("_x.so was not compiled from the C files of this release; install the package again")

    found = machine.check_libraries({"good": object, "x": old})
    assert (found.level, found.text, found.remedy) == (
        "problem",
        "_x.so was not compiled from the C files of this release",
        "install the package again",
    )


def test_a_library_of_another_processor_is_a_problem():
    def foreign():
        raise OSError("wrong ELF class")

    found = machine.check_libraries({"imaging/_x.so": foreign})
    assert (found.level, found.text) == ("problem", "imaging/_x.so does not load (wrong ELF class)")


@pytest.mark.parametrize(("named", "level"), [(True, "problem"), (False, "warning")])
def test_a_port_that_is_taken_is_a_problem_where_the_user_named_it(named, level):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        found = machine.check_port("--port", "127.0.0.1", port, named=named)
    assert (found.check, found.level) == ("port", level)
    assert found.text.startswith(f"cannot listen on 127.0.0.1:{port} (")
    assert found.remedy == "if no Streetfix service runs there already, choose another --port"


def test_an_unused_port_is_free():
    assert machine.check_port("--port", "127.0.0.1", 0, named=True).level == "ok"
    assert machine.check_port("--grpc-port", "127.0.0.1", None, named=False).text == "not requested (--grpc-port)"


def test_an_address_of_another_machine_is_a_problem(monkeypatch):
    def refuse(*_, **__):
        raise OSError(99, "Cannot assign requested address")

    monkeypatch.setattr(socket, "create_server", refuse)
    found = machine.check_port("--port", "192.0.2.1", 8000, named=False)
    assert (found.level, found.remedy) == ("problem", "choose another --host or --port")
