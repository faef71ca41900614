"""One open call of ``LocalizeStream``: it sends a frame and waits for its answer."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from queue import SimpleQueue
from typing import Any

import grpc

from service.client.grpc_errors import no_answer_in_time
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb


class StreamCall:
    """An open call. gRPC reads the frames in a thread of its own, which ends with ``cancel``.

    Args:
        method: ``LocalizeStream`` of a stub.
        metadata: metadata of the call.
        address: address of the service, for messages.
        timeout_s: timeout of one answer, seconds. The call itself has none, because a robot may drive for hours.
    """

    def __init__(
        self, method: Callable[..., Any], metadata: tuple[tuple[str, str], ...], *, address: str, timeout_s: float
    ) -> None:
        self._frames: SimpleQueue[pb.LocalizeStreamRequest | None] = SimpleQueue()
        self._address, self._timeout_s = address, timeout_s
        self._call = method(iter(self._frames.get, None), metadata=metadata)

    def ask(self, frame: pb.LocalizeStreamRequest) -> pb.LocalizeStreamResponse:
        """Send a frame and return its outcome.

        Args:
            frame: the frame.

        Raises:
            NoAnswerInTimeError: the timeout ended. The call is then cancelled.
            ValueError: the server answered without an outcome, or ended the stream.
            grpc.RpcError: the call failed.
        """
        self._frames.put(frame)
        with self._time_limit():
            response: pb.LocalizeStreamResponse | None = next(self._call, None)
        if response is None:
            raise ValueError("the stream ended without an answer to its last frame")
        if response.outcome.WhichOneof("outcome") is None:
            raise ValueError("a frame has neither an answer nor a problem")
        return response

    def finish(self) -> None:
        """Say that no frame follows, and wait until the service has ended the call.

        Raises:
            NoAnswerInTimeError: the timeout ended. The call is then cancelled.
            grpc.RpcError: the call failed.
        """
        self._frames.put(None)
        with self._time_limit():
            next(self._call, None)

    def cancel(self) -> None:
        """End the call and the thread that reads its frames. A call that has ended stays as it is."""
        self._call.cancel()  # first: otherwise the service could take the end of the frames for a finished stream
        self._frames.put(None)

    @contextmanager
    def _time_limit(self) -> Iterator[None]:
        late = threading.Event()

        def give_up() -> None:
            late.set()
            self._call.cancel()

        timer = threading.Timer(self._timeout_s, give_up)
        timer.daemon = True
        timer.start()
        try:
            yield
        except grpc.RpcError as error:
            if late.is_set():
                raise no_answer_in_time(self._address, self._timeout_s) from error
            raise
        finally:
            timer.cancel()
