"""Memory for gRPC messages. gRPC reads a whole message before this code can see its length.

gRPC reads a message only on request. Until then flow control keeps it at the client, except for 64 KiB. So the number of calls that
read at once is limited by the memory for messages of the largest size. After the reading the actual size is reserved, or the message is
refused.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from service.errors import BusyError
from service.runtime.admission import Hold, MemoryBudget
from service.runtime.memory import GRPC_OTHERS, GRPC_PARSED

#: Share of the budget for open streams. Each may send a message of the largest size at any time.
STREAMS_SHARE = 0.5
#: Calls and streams of other services (health, reflection) that are read at once. They are outside the budget, so that the service
#: answers them even if the budget is spent.
OTHER_CALLS, OTHER_STREAMS = 1, GRPC_OTHERS - 1
#: Seconds that a call waits for its turn, and that a call of another service waits. Other calls may send over a slow link.
TURN_S, OTHERS_TURN_S = 5.0, 0.1

#: The memory that the call of this thread holds.
held_by_call: ContextVar[Hold | None] = ContextVar("held_by_call", default=None)


class MessageMemory:
    """Limits the number of calls that read and parse messages at once, within a budget.

    Args:
        budget: of all requests.
        most_bytes: largest size of a message.
        most_streams: maximum number of open streams; the memory may allow fewer.

    Attributes:
        streams: maximum number of open streams.
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
        """Create an empty reservation."""
        return self._budget.hold()

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Wait for the turn to read one message inside the context.

        Raises:
            BusyError: more calls read than the memory allows.
        """
        with _taken(self._reading, "the memory for incoming messages is full; try again in a second"):
            yield

    @contextmanager
    def parsing(self, count: int) -> Iterator[None]:
        """Wait for the turn to parse a message inside the context; its bytes then exist beside the message.

        Args:
            count: size of the message in bytes.
        """
        with self._parsing:
            yield
        self._budget.freed(count)  # the received pieces and the joined bytes

    @contextmanager
    def reading_slot(self, *, streams: bool) -> Iterator[None]:
        """Wait for the turn to read one message of another service inside the context.

        Args:
            streams: the message belongs to a stream. Streams have their own turn, so that they do not delay health.

        Raises:
            BusyError: another call reads.
        """
        places = self._other_streams if streams else self._other_calls
        with _taken(places, "too many calls send messages at once; try again in a second", wait_s=OTHERS_TURN_S):
            yield

    @contextmanager
    def stream(self) -> Iterator[None]:
        """Keep a stream open inside the context, with memory for a message of the largest size.

        Raises:
            BusyError: the maximum number of streams is open, or the memory for requests is taken.
        """
        busy = f"all {self.streams} streams are in use; close one, or send sequences instead"
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
