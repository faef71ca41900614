"""How much memory a process has for requests: what requests need, and what the machine or the container leaves."""

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

from service.errors import RequestError
from service.imaging.rectify import TABLES_BYTES
from service.runtime.admission import MIB, MemoryBudget, in_mib

if TYPE_CHECKING:
    from service.runtime.settings import Settings

#: Minimum memory of a process without requests: packages, encoder, tables of a map. A larger measured value replaces it.
PROCESS_BYTES = 192 * MIB
#: Memory of a thread for one answer, besides the images. Measured with tracemalloc (November 2026, stock encoder, images of 640 x 480):
#: 7 MiB for one frame, 24 MiB for 4, 71 MiB for 16, the most of a request. Most of it are the surfels in view of each frame and the surfel
#: of each ray at each pose. ONNX Runtime's own memory of a run is not in these figures.
THREAD_BYTES = 80 * MIB
#: Share of the limit that stays free, for fragmentation, sockets, connections and further map versions.
SPARE_SHARE = 0.125
#: Share of the limit for pages of maps, also if the maps are mounted later. The system can read such pages again from the files, but
#: this makes an answer slow.
MAPS_SHARE = 0.25
#: Messages of the largest size that gRPC holds outside the budget. ``GRPC_PARSED`` are being parsed. ``GRPC_OTHERS`` belong to health and
#: reflection, which must be answered even if the budget is spent. ``GRPC_COPIES`` exist while its one thread copies a message from C.
GRPC_PARSED, GRPC_OTHERS = 2, 2
GRPC_COPIES = 2.2
#: Share of the memory for messages that are being read. Their sizes are not known yet.
GRPC_READING_SHARE = 0.25
#: Minimum budget. Below this the service would refuse common requests of robots.
LEAST_BYTES = 64 * MIB

#: Peak bytes per pixel while decoding, measured over all formats: RGB (progressive JPEG or 16-bit PNG), depth, and depth that is
#: stored as range or in the CARLA encoding.
RGB_PEAK, DEPTH_PEAK, DEPTH_PEAK_CONVERTED = 11, 17, 30
#: Bytes per depth pixel during the rest of the request: the image and temporary data of registration.
DEPTH_KEPT = 8
#: Additional bytes per depth pixel for an explanation.
EXPLAIN_PEAK = 14

_UNLIMITED = 2**60


def budget_of(settings: "Settings", *, threads: int) -> MemoryBudget:
    """Compute the budget of one process: from the setting, else from the memory limit of the machine or container.

    Args:
        settings: of the service.
        threads: worker threads per process.

    Raises:
        RequestError: too little memory is left for requests.
    """
    message, body = settings.limits.message_bytes, settings.limits.max_request_bytes
    if settings.request_memory_mib is None:
        limit = memory_limit()
        shared = limit * (SPARE_SHARE + MAPS_SHARE)
        process = max(anonymous_bytes(), PROCESS_BYTES) + threads * THREAD_BYTES + TABLES_BYTES
        if settings.grpc_port is not None:
            process += round((GRPC_COPIES + GRPC_PARSED + GRPC_OTHERS) * message)
        left = int((limit - shared) / settings.workers - process)
        of = f"the memory limit of {in_mib(limit)} leaves"
    else:
        left = settings.request_memory_mib * MIB // settings.workers
        of = f"setting request_memory_mib: {settings.request_memory_mib} MiB leave"
    least = max(LEAST_BYTES, 3 * body)
    if left < least:
        raise RequestError(
            f"{of} {in_mib(max(0, left))} for the requests of each of {settings.workers} processes with {threads} threads, but "
            f"{in_mib(least)} are needed (three of the largest requests); set more memory, fewer workers or threads, or a smaller "
            "limits.max_request_bytes",
            field="request_memory_mib",
        )
    messages = 0 if settings.grpc_port is None else max(1, int(left * GRPC_READING_SHARE) // message)
    return MemoryBudget(left - messages * message, messages)


def memory_limit(cgroups: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> int:
    """Return the memory limit in bytes: the lowest of the control group limits and the memory of the machine.

    Args:
        cgroups: folder of the control groups, version 2 and 1.
        own: file that lists the groups of this process.
    """
    found = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    for folder, name in _group_folders(cgroups, own):
        try:
            words = (folder / name).read_text().split()
            if words and words[0] != "max" and 0 < int(words[0]) < _UNLIMITED:
                found.append(int(words[0]))
        except (OSError, ValueError):  # the other version, a group outside this namespace, or no control groups
            continue
    return min(found)


def _group_folders(cgroups: Path, own: Path) -> list[tuple[Path, str]]:
    """Folders of this process's groups up to their roots, each with the name of its memory limit file."""
    roots = {
        ("", cgroups): "memory.max",
        ("", cgroups / "unified"): "memory.max",
        ("memory", cgroups / "memory"): "memory.limit_in_bytes",
    }
    try:
        lines = own.read_text().splitlines()
    except OSError:
        lines = []
    below: dict[str, str] = {}
    for line in lines:
        _, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        below |= dict.fromkeys(controllers.split(","), path)
    found = []
    for (controller, root), name in roots.items():
        parts = [part for part in below.get(controller, "/").split("/") if part not in ("", ".", "..")]
        found += [(root.joinpath(*parts[:count]), name) for count in range(len(parts) + 1)]
    return found


def anonymous_bytes(status: Path = Path("/proc/self/status")) -> int:
    """Return the anonymous resident memory of this process in bytes; 0 if the system does not report it.

    Args:
        status: status file of the process.
    """
    try:
        found = re.search(r"^RssAnon:\s+(\d+) kB", status.read_text(), re.MULTILINE)
    except OSError:
        return 0
    return 0 if found is None else int(found[1]) * 1024
