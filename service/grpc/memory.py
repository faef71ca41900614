"""Memory for gRPC messages: gRPC reads a whole message before our code sees how long it is.

A message is read only when somebody asks for it (until then flow control keeps it at the client, but for 64 KiB). So no more calls
ask at once than there is memory for messages of the largest size. When a message is here its own size is reserved, or it is refused.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from service.errors import BusyError
from service.runtime.memory import GRPC_OTHERS, GRPC_PARSED, Hold, MemoryBudget

#: Share of the budget for open streams, each of which may send a message of the largest size at any time.
STREAMS_SHARE = 0.5
#: Calls and streams of other services (health, reflection) that are read at once, outside of the budget: they are answered when it is
#: spent.
OTHER_CALLS, OTHER_STREAMS = 1, GRPC_OTHERS - 1
#: A call waits so long for its turn, one of another service so long: others may send their messages over a slow link.
TURN_S, OTHERS_TURN_S = 5.0, 0.1

#: What the call of this thread holds.
held_by_call: ContextVar[Hold | None] = ContextVar("held_by_call", default=None)


class MessageMemory:
    """Turns to read messages, within a budget.

    Args:
        budget: of all requests.
        most_bytes: of a message.
        most_streams: that may be open, if there is memory for them.
    """

    def __init__(self, budget: MemoryBudget, *, most_bytes: int, most_streams: int) -> None:
        self._budget = budget
        self._most_bytes = most_bytes
        self._reading = threading.Semaphore(max(1, budget.messages))
        self._parsing = threading.Semaphore(GRPC_PARSED)
        self._other_calls = threading.Semaphore(OTHER_CALLS)
        self._other_streams = threading.Semaphore(OTHER_STREAMS)
        self.streams = min(most_streams, int(budget.limit * STREAMS_SHARE) // most_bytes)
        self._streams = threading.Semaphore(self.streams)

    def hold(self) -> Hold:
        """A reservation of nothing."""
        return self._budget.hold()

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Read one message inside.

        Raises:
            BusyError: more calls read than there is memory for.
        """
        with _taken(self._reading, "more calls send messages than there is memory for; try again in a second"):
            yield

    @contextmanager
    def parsing(self, count: int) -> Iterator[None]:
        """Parse a message of so many bytes inside, while its bytes are there, too."""
        with self._parsing:
            yield
        self._budget.freed(count)  # the pieces that it came in, and its bytes

    @contextmanager
    def turn_of_others(self, *, streams: bool) -> Iterator[None]:
        """Read one message of another service than ours inside.

        Args:
            streams: of a stream, whose messages must not keep those of health back.

        Raises:
            BusyError: others read.
        """
        places = self._other_streams if streams else self._other_calls
        with _taken(places, "more calls send messages than may; try again in a second", wait_s=OTHERS_TURN_S):
            yield

    @contextmanager
    def stream(self) -> Iterator[None]:
        """Keep a stream open inside; the largest size is reserved as long as it lives.

        Raises:
            BusyError: as many are open as may be, or the memory for requests is taken.
        """
        busy = f"all {self.streams} streams are taken; close one, or send sequences instead"
        with _taken(self._streams, busy, wait_s=0.0), self.hold() as hold:
            hold.grow(self._most_bytes)
            yield


@contextmanager
def _taken(places: threading.Semaphore, busy: str, *, wait_s: float = TURN_S) -> Iterator[None]:
    if not places.acquire(timeout=wait_s) if wait_s else not places.acquire(blocking=False):
        raise BusyError(busy)
    try:
        yield
    finally:
        places.release()
