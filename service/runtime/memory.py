"""One budget of bytes for all that requests bring: bodies, messages and pictures, of both faces.

What a request will take is reserved before it is allocated. What does not fit is refused at once, so that a flood of large requests
ends in refusals and not in a killed container.
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
#: What a process takes without requests: packages, encoder, tables of a map; more where it is measured to be more.
PROCESS_BYTES = 192 * MIB
#: What a thread takes to answer, besides the pictures: descriptors, points, candidates. Measured: 7 MiB, a stock map's 20.
THREAD_BYTES = 32 * MIB
#: Share of the limit that stays free: fragmentation, sockets, connections, versions of maps that come.
SPARE_SHARE = 0.125
#: Pages of maps can be read again from their files, but an answer that has to do so is slow: so much of the limit stays for them, also
#: where the maps come later.
MAPS_SHARE = 0.25
#: Largest messages that gRPC holds beside the budget: 2.2 copies while its one thread takes a message over from C, those of health
#: and reflection, which must be answered when the budget is spent, and those that are parsed.
GRPC_PARSED, GRPC_OTHERS = 2, 2
GRPC_COPIES = 2.2
#: Share of the memory for messages that are being read, whose sizes nobody knows yet.
GRPC_READING_SHARE = 0.25
#: Below this the service would refuse what robots usually send.
LEAST_BYTES = 64 * MIB

#: Bytes that decoding takes at its peak for each pixel, measured over all formats: colour (a progressive JPEG or a PNG of 16 bits),
#: depth, and depth that is stored as range or by CARLA.
RGB_PEAK, DEPTH_PEAK, DEPTH_PEAK_CONVERTED = 11, 17, 30
#: Bytes that stay for each pixel of depth while its request lasts: the picture, and what registration makes of it for a while.
DEPTH_KEPT = 8
#: What an explanation takes for each pixel of depth beside that.
EXPLAIN_PEAK = 14

_UNLIMITED = 2**60


class MemoryBudget:
    """Bytes that requests may hold together; safe to use from all threads.

    Args:
        limit: bytes.
        messages: of the largest size that gRPC may read at once, outside of the limit.
    """

    def __init__(self, limit: int, messages: int = 0) -> None:
        self.limit = limit
        self.messages = messages
        self._lock = threading.Lock()
        self._held = 0
        # Pictures give back where the interpreter drops them, which may be inside of this lock: that only appends here.
        self._returned: deque[int] = deque()
        self._told: Callable[[float], None] = lambda _: None
        self._trimmer = Trimmer()

    @property
    def held(self) -> int:
        """Bytes that are reserved now."""
        with self._lock:
            self._take_back()
            return self._held

    def watch(self, told: Callable[[float], None]) -> None:
        """Tell the bytes that are reserved whenever somebody reserves or gives back."""
        self._told = told
        told(self.held)

    def hold(self) -> "Hold":
        """A reservation of nothing, that grows."""
        return Hold(self)

    def reserve(self, count: int) -> bool:
        """Whether there was room for so many bytes more, which are reserved then."""
        with self._lock:
            self._take_back()
            if self._held + count > self.limit:
                return False
            self._held += count
            self._told(self._held)
            return True

    def give_back(self, count: int) -> None:
        """Give back so many bytes."""
        with self._lock:
            self._take_back()
            self._held -= count
            self._told(self._held)
        self.freed(count)

    def freed(self, count: int) -> None:
        """Take note of memory that was freed, so that the system gets it back."""
        if count >= LARGE_BYTES:
            self._trimmer.soon()

    def give_back_later(self, count: int) -> None:
        """Give back so many bytes, from wherever the interpreter drops an object."""
        self._returned.append(count)

    def _take_back(self) -> None:
        while self._returned:
            self._held -= self._returned.popleft()


class Hold:
    """Bytes that one request holds; inside ``with`` until its end, or until the work on it ends that its caller did not wait for."""

    def __init__(self, budget: MemoryBudget) -> None:
        self._budget = budget
        self._lock = threading.Lock()
        self._users = 1  # the request itself, and the work on it
        self.bytes = 0

    def __enter__(self) -> Self:
        """Nothing is reserved yet."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give back what is held, when all work is over."""
        self._one_less()

    def grow(self, count: int) -> None:
        """Reserve so many bytes more, before they are allocated.

        Raises:
            TooLargeError: the request alone needs more than there is for all.
            BusyError: others hold too much now.
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
        """Give back what is held beyond so many bytes."""
        if count < self.bytes:
            self._budget.give_back(self.bytes - count)
            self.bytes = count

    def until(self, work: "Future[Any]") -> None:
        """Keep what is held at least until some work is over, also where its caller has gone meanwhile."""
        with self._lock:
            self._users += 1
        work.add_done_callback(lambda _: self._one_less())

    def leave_with(self, owner: Any) -> None:
        """Leave what is held to an object: it is given back when that is no more."""
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
    """The budget of one process: as set, else what the machine's or container's limit leaves.

    Args:
        settings: of the service.
        threads: that answer in a process.

    Raises:
        RequestError: too little is left for requests.
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
    """Bytes that this process and its like may take: the least of the control groups' limits (version 2 and 1) and the machine's memory."""
    found = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    for folder, name in _group_folders(cgroups, own):
        try:
            words = (folder / name).read_text().split()
            if words and words[0] != "max" and 0 < int(words[0]) < _UNLIMITED:
                found.append(int(words[0]))
        except (OSError, ValueError):  # another version, a group that is not seen from here, or none at all
            continue
    return min(found)


def _group_folders(cgroups: Path, own: Path) -> list[tuple[Path, str]]:
    """Folders of this process' groups up to their roots, with the name of the file that limits memory there."""
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
    """Memory of this process that is no file's; 0 where the system does not tell."""
    try:
        found = re.search(r"^RssAnon:\s+(\d+) kB", status.read_text(), re.MULTILINE)
    except OSError:
        return 0
    return 0 if found is None else int(found[1]) * 1024


def _mib(count: float) -> str:
    return f"{count / MIB:.0f} MiB"
