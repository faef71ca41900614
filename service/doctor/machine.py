"""Checks of the machine: platform, processor, memory that workers share, compiled libraries and ports."""

import errno
import os
import platform
import re
import shutil
import socket
import sys
import tempfile
from collections.abc import Callable, Mapping
from contextlib import closing
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from service.doctor.finding import Finding
from service.errors import StreetfixError, UnsupportedPlatformError
from service.platforms import require_supported
from service.runtime.serving_table import SharedMemory
from service.runtime.settings import Settings
from service.runtime.threads import cpu_quota, threads_per_process, usable_cores

_MIB = 2**20
#: Free space of the temporary folder for the metrics of the most workers, 64: three files of 256 KiB each (``service.cli.shared_counts``).
LEAST_TEMPORARY_BYTES = 48 * _MIB


def _library_of(module: str, function: str) -> Any:
    return getattr(import_module(module), function)()


#: Loads each compiled library, by its name. Loading compares the structures of C with those of Python.
LIBRARIES: Mapping[str, Callable[[], Any]] = {
    "registration/_kernel.so": partial(_library_of, "service.registration.kernel", "_library"),
    "registration/_points.so": partial(_library_of, "service.registration.points", "_library"),
    "registration/_rays.so": partial(_library_of, "service.registration.visibility", "_library"),
    "imaging/_depth16.so": partial(_library_of, "service.imaging.depth16", "library"),
    "imaging/_resample.so": partial(_library_of, "service.imaging.resample", "_library"),
    "imaging/_level.so": partial(_library_of, "service.imaging.level", "_library"),
    "imaging/_view_grid.so": partial(_library_of, "service.imaging.view_grid", "_library"),
}


def check_platform() -> Finding:
    """Check that the service runs on this operating system and processor."""
    try:
        require_supported()
    except UnsupportedPlatformError as error:
        return Finding.of_error("platform", error)
    return Finding(
        "platform", "ok", f"{sys.platform} on {platform.machine()}, Python {platform.python_version()}, is supported"
    )


def check_cores(settings: Settings | None, cgroup: Path = Path("/sys/fs/cgroup")) -> Finding:
    """Report the cores that a service may use, and whether its processes and threads exceed them.

    Args:
        settings: of the service; None if they are invalid, then only the cores are reported.
        cgroup: folder of the control groups.
    """
    usable, all_cores, quota = usable_cores(cgroup), os.cpu_count() or 1, cpu_quota(cgroup)
    limited = "" if quota is None else f"; a quota allows {quota:g} cores of processor time"
    found = f"{usable} of {all_cores} usable"
    if settings is None:
        return Finding("cores", "ok", found + limited)
    workers = settings.workers
    threads = threads_per_process(settings.threads, workers=workers, cores=usable)
    found += f": a service works on {workers * threads} requests at once (workers: {workers}, threads of each: {threads}){limited}"
    if workers * threads > usable:
        return Finding(
            "cores",
            "warning",
            f"{found}, and requests beyond {usable} wait for a core",
            f"unset STREETFIX_THREADS, or set it to {max(1, usable // workers)}"
            if workers <= usable
            else f"set STREETFIX_WORKERS to at most {usable}, and unset STREETFIX_THREADS",
        )
    return Finding("cores", "ok", found)


def check_instructions(cpuinfo: Path = Path("/proc/cpuinfo")) -> Finding:
    """Report the instruction set. The C code has no need of AVX2, but is faster with it.

    Args:
        cpuinfo: description of the processor by the system.
    """
    machine = platform.machine()
    if machine in ("aarch64", "arm64"):
        return Finding("instruction set", "ok", "64-bit ARM")
    try:
        flags = re.search(r"^flags\s*:(.*)$", cpuinfo.read_text(), re.MULTILINE)
    except OSError:
        flags = None
    if machine != "x86_64" or flags is None:
        return Finding("instruction set", "ok", f"{machine}; the system does not report whether it has AVX2")
    level_text = (
        "with AVX2"
        if "avx2" in flags[1].split()
        else "without AVX2: the answers are the same, but take somewhat longer"
    )
    return Finding("instruction set", "ok", f"x86-64 {level_text}")


def check_shared_memory(
    shm: Path = Path("/dev/shm"),  # noqa: S108  # only looked at
    *,
    temporary: Path | None = None,
    make: Callable[[], SharedMemory] = SharedMemory,
) -> Finding:
    """Check what several workers share: anonymous memory, and files in the temporary folder.

    The service does not use ``/dev/shm``. Its free space is only reported, because containers often limit it.

    Args:
        shm: folder of the shared memory with names.
        temporary: temporary folder of the service; None takes that of this process.
        make: creates the memory that workers share.
    """
    check = "shared memory"
    try:
        with closing(make()):
            pass
        folder = temporary or Path(tempfile.gettempdir())
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return Finding(
            check,
            "warning",
            f"several workers cannot share memory and files here ({error.strerror or error})",
            "let the service write to its temporary folder (TMPDIR), or keep --workers at 1",
        )
    if free < LEAST_TEMPORARY_BYTES:
        return Finding(
            check,
            "warning",
            f"the temporary folder {folder} has {free // _MIB} MiB left for the metrics of several workers",
            f"free {LEAST_TEMPORARY_BYTES // _MIB} MiB, set TMPDIR to another disk, or keep --workers at 1",
        )
    return Finding(check, "ok", f"several workers can share memory and files; {_named_memory(shm)}")


def _named_memory(shm: Path) -> str:
    try:
        free = shutil.disk_usage(shm).free
    except OSError:
        return f"{shm} does not exist, and the service does not use it"
    return f"{shm} has {free // _MIB} MiB left, and the service does not use it"


def check_libraries(libraries: Mapping[str, Callable[[], Any]]) -> Finding:
    """Check that all compiled libraries load, and that they belong to this release.

    Args:
        libraries: loads each library, by its name, as ``LIBRARIES``.
    """
    for name, load in libraries.items():
        try:
            load()
        except StreetfixError as error:
            return Finding.of_error("compiled code", error)
        except (OSError, AttributeError) as error:  # of another processor, or without one of its functions
            return Finding("compiled code", "problem", f"{name} does not load ({error})", "install the package again")
    return Finding("compiled code", "ok", f"all {len(libraries)} libraries load")


def check_port(option: str, host: str, port: int | None, *, named: bool) -> Finding:
    """Check that a service could listen on a port.

    Args:
        option: of ``serve`` that sets the port, with its dashes.
        host: address to listen on.
        port: the port; None if the service does not listen there.
        named: whether the user named the port. Another program on it is then a problem. Else it may be a running service, which is a
            warning.
    """
    check = option.removeprefix("--").replace("-", " ")
    if port is None:
        return Finding(check, "ok", f"not requested ({option})")
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        socket.create_server((host, port), family=family).close()
    except OSError as error:
        taken = error.errno == errno.EADDRINUSE
        return Finding(
            check,
            "warning" if taken and not named else "problem",
            f"cannot listen on {host}:{port} ({error.strerror})",
            f"if no Streetfix service runs there already, choose another {option}"
            if taken
            else f"choose another --host or {option}",
        )
    return Finding(check, "ok", f"{host}:{port} is free" if port else "the system chooses a free one")
