"""One memory budget for the bodies, messages and images of all requests, REST and gRPC.

A request reserves its memory before it allocates. A request that does not fit is refused at once. So a flood of large requests causes
refusals and not a killed container.
"""

import os
import re
import threading
import weakref
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from service.errors import BusyError, RequestError, TooLargeError
from service.runtime.heap import LARGE_BYTES, Trimmer

if TYPE_CHECKING:
    from service.runtime.settings import Settings

MIB = 2**20
#: Minimum memory of a process without requests: packages, encoder, tables of a map. A larger measured value replaces it.
PROCESS_BYTES = 192 * MIB
#: Memory of a thread for one answer, besides the images: descriptors, points, candidates. Measured: 7 MiB; 20 MiB for a stock map.
THREAD_BYTES = 32 * MIB
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


class MemoryBudget:
    """Bytes that all requests together may hold. It is thread-safe.

    Args:
        limit: bytes.
        messages: number of gRPC messages of the largest size that may be read at once, outside the limit.
    """

    def __init__(self, limit: int, messages: int = 0) -> None:
        self.limit = limit
        self.messages = messages
        self._lock = threading.Lock()
        self._held = 0
        # Finalizers of images may run while this thread holds the lock. So they only append here and never take the lock.
        self._returned: deque[int] = deque()
        self._told: Callable[[float], None] = lambda _: None
        self._trimmer = Trimmer()

    @property
    def held(self) -> int:
        """Number of bytes that are reserved now."""
        with self._lock:
            self._take_back()
            return self._held

    def watch(self, told: Callable[[float], None]) -> None:
        """Report the reserved bytes now and after every change.

        Args:
            told: called with the number of bytes.
        """
        self._told = told
        told(self.held)

    def hold(self) -> "Hold":
        """Create an empty reservation that can grow."""
        return Hold(self)

    def reserve(self, count: int) -> bool:
        """Reserve bytes if they fit; return whether they did.

        Args:
            count: bytes.
        """
        with self._lock:
            self._take_back()
            if self._held + count > self.limit:
                return False
            self._held += count
            self._told(self._held)
            return True

    def give_back(self, count: int) -> None:
        """Release reserved bytes.

        Args:
            count: bytes.
        """
        with self._lock:
            self._take_back()
            self._held -= count
            self._told(self._held)
        self.freed(count)

    def freed(self, count: int) -> None:
        """Return freed memory to the system if it is large.

        Args:
            count: bytes that were freed.
        """
        if count >= LARGE_BYTES:
            self._trimmer.soon()

    def give_back_later(self, count: int) -> None:
        """Release reserved bytes at the next access to the budget. Safe to call from a finalizer, because it takes no lock.

        Args:
            count: bytes.
        """
        self._returned.append(count)

    def _take_back(self) -> None:
        while self._returned:
            self._held -= self._returned.popleft()


class Hold:
    """Bytes that one request holds.

    Use it as a context manager. The bytes are released when the context and all work that was passed to ``until`` have ended.

    Args:
        budget: in which the bytes are reserved.

    Attributes:
        bytes: reserved now.
    """

    def __init__(self, budget: MemoryBudget) -> None:
        self._budget = budget
        self._lock = threading.Lock()
        self._users = 1  # the request itself, and the work for it
        self.bytes = 0

    def __enter__(self) -> Self:
        """Return the hold; nothing is reserved yet."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Release the bytes once all work is over."""
        self._one_less()

    def grow(self, count: int) -> None:
        """Reserve more bytes before they are allocated.

        Args:
            count: additional bytes.

        Raises:
            TooLargeError: the request alone exceeds the budget.
            BusyError: other requests hold too much now.
        """
        if self._budget.reserve(count):
            self.bytes += count
            return
        needed, limit = self.bytes + count, self._budget.limit
        if needed > limit:
            raise TooLargeError(
                f"the request needs {_mib(needed)} of memory, more than the {_mib(limit)} that this service has for requests; send "
                "smaller pictures or fewer at once, or let its operator give it more (STREETFIX_REQUEST_MEMORY_MIB)"
            )
        raise BusyError(
            f"the memory for requests is taken (this one needs {_mib(needed)} of {_mib(limit)}); try again in a second"
        )

    def shrink_to(self, count: int) -> None:
        """Release the bytes above a count.

        Args:
            count: bytes to keep.
        """
        if count < self.bytes:
            self._budget.give_back(self.bytes - count)
            self.bytes = count

    def until(self, work: "Future[Any]") -> None:
        """Keep the bytes at least until some work is over, even if the caller disconnects.

        Args:
            work: future of the work.
        """
        with self._lock:
            self._users += 1
        work.add_done_callback(lambda _: self._one_less())

    def leave_with(self, owner: Any) -> None:
        """Transfer the bytes to an object. They are released when the object is deleted.

        Args:
            owner: any object that supports weak references.
        """
        if self.bytes:
            weakref.finalize(owner, self._budget.give_back_later, self.bytes).atexit = False
        self.bytes = 0

    def _one_less(self) -> None:
        with self._lock:
            self._users -= 1
            over = self._users == 0
        if over:
            self.shrink_to(0)


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
        process = max(anonymous_bytes(), PROCESS_BYTES) + threads * THREAD_BYTES
        if settings.grpc_port is not None:
            process += round((GRPC_COPIES + GRPC_PARSED + GRPC_OTHERS) * message)
        left = int((limit - shared) / settings.workers - process)
        of = f"the memory limit of {_mib(limit)} leaves"
    else:
        left = settings.request_memory_mib * MIB // settings.workers
        of = f"setting request_memory_mib: {settings.request_memory_mib} MiB leave"
    least = max(LEAST_BYTES, 3 * body)
    if left < least:
        raise RequestError(
            f"{of} {_mib(max(0, left))} for the requests of each of {settings.workers} processes with {threads} threads, and {_mib(least)} "
            "is the least (three of the largest requests); give it more memory, fewer workers or threads, or a smaller "
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


def _mib(count: float) -> str:
    return f"{count / MIB:.0f} MiB"
