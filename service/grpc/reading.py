"""Read the messages of a call in its own thread, in turn, with a time limit, and check their size before parsing.

If gRPC parsed the messages, invalid bytes would end a call with the text of gRPC, a traceback in the log and no count in the metrics.
gRPC would also read the messages of all calls at once, without a memory limit.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, NoReturn

import grpc
from google.protobuf.descriptor import Descriptor
from google.protobuf.descriptor_pool import Default
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from service.errors import BusyError, RequestError, StreetfixError
from service.grpc.call import Call
from service.grpc.deadline_watchdog import DeadlineWatchdog
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.memory import MessageMemory, held_by_call
from service.grpc.parsing import parsed

if TYPE_CHECKING:
    _Interceptor = grpc.ServerInterceptor[Any, Any]
else:  # only the type stub is generic
    _Interceptor = grpc.ServerInterceptor

SERVICE: str = pb.DESCRIPTOR.services_by_name["LocalizationService"].full_name
#: Time limit in seconds for a message of another service (health, reflection). Such a message is small.
OTHERS_S = 1.0
#: Ends a call of the given name according to the contract: ``service.grpc.answering.answering`` bound to an engine.
Answering = Callable[[str, grpc.ServicerContext], AbstractContextManager[Call]]
Messages = Iterator[bytes]


class ReadingInterceptor(_Interceptor):
    """Reads raw bytes instead of letting gRPC parse. It ends calls that send nothing, and refuses bytes that do not parse.

    Args:
        watchdog: ends calls that take too long.
        memory: limits the number of calls that read at once.
        timeout_s: time limit for the only message of a call of LocalizationService.
        answering: ends refused calls.
    """

    def __init__(
        self, watchdog: DeadlineWatchdog, memory: MessageMemory, *, timeout_s: float, answering: Answering
    ) -> None:
        self._watchdog = watchdog
        self._memory = memory
        self._timeout_s = timeout_s
        self._answering = answering

    def intercept_service(
        self, continuation: Callable[[grpc.HandlerCallDetails], Any], details: grpc.HandlerCallDetails
    ) -> Any:
        """Return a handler that reads raw bytes, for LocalizationService, health and reflection.

        Args:
            continuation: returns the original handler of a call.
            details: method and metadata of the call.
        """
        handler = continuation(details)
        if handler is None:
            return None
        service, _, method = details.method.removeprefix("/").partition("/")
        message = Default().FindServiceByName(service).methods_by_name[method].input_type
        serializer, ours = handler.response_serializer, service == SERVICE
        if handler.request_streaming:
            stream = self._our_stream if ours else self._stream_of_others
            return grpc.stream_stream_rpc_method_handler(
                stream(handler, message, method), response_serializer=serializer
            )
        if ours:
            return grpc.stream_unary_rpc_method_handler(
                self._our_answer(handler, message, method), response_serializer=serializer
            )
        if handler.response_streaming:
            return grpc.stream_stream_rpc_method_handler(
                self._answers_of_others(handler, message, method), response_serializer=serializer
            )
        return grpc.stream_unary_rpc_method_handler(
            self._answer_of_others(handler, message, method), response_serializer=serializer
        )

    def _our_answer(
        self, handler: Any, message: Descriptor, method: str
    ) -> Callable[[Messages, grpc.ServicerContext], Any]:
        def answer(messages: Messages, context: grpc.ServicerContext) -> Any:
            with self._memory.hold() as hold:
                try:
                    with self._memory.turn():
                        raw = self._next(messages, method, context, self._timeout_s)
                    hold.grow(len(raw))
                except StreetfixError as error:
                    self._end(error, method, context)
                with self._memory.parsing(len(raw)):
                    request = self._parsed(raw, message, method, context)
                    del raw
                token = held_by_call.set(hold)
                try:
                    return handler.unary_unary(request, context)
                finally:
                    held_by_call.reset(token)

        return answer

    def _our_stream(
        self, handler: Any, message: Descriptor, method: str
    ) -> Callable[[Messages, grpc.ServicerContext], Any]:
        del method  # the servicer ends its streams itself

        def one_by_one(messages: Messages) -> Iterator[Message]:
            while (raw := next(messages, None)) is not None:
                with self._memory.parsing(len(raw)):
                    request = parsed(raw, message)
                    del raw  # the stream has reserved memory for only one of the two
                yield request
                del request

        def stream(messages: Messages, context: grpc.ServicerContext) -> Any:
            return handler.stream_stream(one_by_one(messages), context)

        return stream

    def _answer_of_others(
        self, handler: Any, message: Descriptor, method: str
    ) -> Callable[[Messages, grpc.ServicerContext], Any]:
        def answer(messages: Messages, context: grpc.ServicerContext) -> Any:
            return handler.unary_unary(self._small(messages, message, method, context), context)

        return answer

    def _answers_of_others(
        self, handler: Any, message: Descriptor, method: str
    ) -> Callable[[Messages, grpc.ServicerContext], Iterator[Any]]:
        def answers(messages: Messages, context: grpc.ServicerContext) -> Iterator[Any]:
            yield from handler.unary_stream(self._small(messages, message, method, context), context)

        return answers

    def _stream_of_others(
        self, handler: Any, message: Descriptor, method: str
    ) -> Callable[[Messages, grpc.ServicerContext], Iterator[Any]]:
        def in_turn(messages: Messages, context: grpc.ServicerContext) -> Iterator[Message]:
            while True:
                try:
                    with self._memory.reading_slot(streams=True), self._watchdog.time_limit(OTHERS_S, context.cancel):
                        raw = next(messages, None)
                except StreetfixError as error:
                    self._end(error, method, context)
                if raw is None:
                    return
                yield self._parsed(raw, message, method, context)

        def answers(messages: Messages, context: grpc.ServicerContext) -> Iterator[Any]:
            yield from handler.stream_stream(in_turn(messages, context), context)

        return answers

    def _small(self, messages: Messages, message: Descriptor, method: str, context: grpc.ServicerContext) -> Message:
        """Read the only message of a call of another service.

        Health needs no key, so any client could hold the turn and send nothing. The others are then answered as if their messages
        were empty: with the health of the whole service.
        """
        try:
            with self._memory.reading_slot(streams=False):
                raw = self._next(messages, method, context, OTHERS_S)
        except BusyError:
            return GetMessageClass(message)()
        return self._parsed(raw, message, method, context)

    def _next(self, messages: Messages, method: str, context: grpc.ServicerContext, timeout_s: float) -> bytes:
        """Read the only message of a call. If none arrives, the call ends."""
        try:
            with self._watchdog.time_limit(timeout_s, context.cancel):
                raw = next(messages, None)
        except grpc.RpcError as error:
            self._end(error, method, context)
        # gRPC gives no reason if the call was cancelled meanwhile or if its message exceeded the limit.
        if raw is None:
            self._end(RequestError("the call ended without a message; send exactly one message"), method, context)
        return raw

    def _parsed(self, raw: bytes, message: Descriptor, method: str, context: grpc.ServicerContext) -> Message:
        """Parse a message of a call. If the bytes are invalid, the call ends."""
        try:
            return parsed(raw, message)
        except RequestError as error:
            self._end(error, method, context)

    def _end(self, error: Exception, method: str, context: grpc.ServicerContext) -> NoReturn:
        with self._answering(method, context):
            raise error
        raise AssertionError("the call continued after its end")
