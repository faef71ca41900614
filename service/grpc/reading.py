"""Reads a call's messages in the call's own thread, in its turn, with patience, and looks at their size before they are parsed.

Left to gRPC, bytes that do not parse end a call with its own words, a traceback in the log, and no count in the metrics. gRPC would
also read the messages of all calls at once, whatever memory that takes.
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
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.memory import MessageMemory, held_by_call
from service.grpc.parsing import parsed
from service.grpc.patience import Patience

if TYPE_CHECKING:
    _Interceptor = grpc.ServerInterceptor[Any, Any]
else:  # generic in its stub alone
    _Interceptor = grpc.ServerInterceptor

SERVICE: str = pb.DESCRIPTOR.services_by_name["LocalizationService"].full_name
#: Seconds in which a message of another service (health, reflection) must be there: it is small.
OTHERS_S = 1.0
#: Ends a call of that name as the contract says; ``service.grpc.answering.answering`` of an engine.
Answering = Callable[[str, grpc.ServicerContext], AbstractContextManager[Call]]
Messages = Iterator[bytes]


class ReadingInterceptor(_Interceptor):
    """Takes raw bytes where gRPC would parse, ends calls that never send them, and refuses what does not parse.

    Args:
        patience: ends calls.
        memory: gives calls their turns to read.
        timeout_s: that a call of ours may take to send its only message.
        answering: how refused calls end.
    """

    def __init__(self, patience: Patience, memory: MessageMemory, *, timeout_s: float, answering: Answering) -> None:
        self._patience = patience
        self._memory = memory
        self._timeout_s = timeout_s
        self._answering = answering

    def intercept_service(
        self, continuation: Callable[[grpc.HandlerCallDetails], Any], details: grpc.HandlerCallDetails
    ) -> Any:
        """The handler of a call, in another form: of ours, of health and of reflection."""
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
        del method  # our servicer ends its streams itself

        def one_by_one(messages: Messages) -> Iterator[Message]:
            while (raw := next(messages, None)) is not None:
                with self._memory.parsing(len(raw)):
                    request = parsed(raw, message)
                    del raw  # the stream has reserved memory for one of both
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
                    with self._memory.turn_of_others(streams=True), self._patience.at_most(OTHERS_S, context.cancel):
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
        """The only message of a call of another service.

        Nobody needs a key for health. If a caller holds the turn and sends nothing, others are answered as if their messages were
        empty: health of the whole service.
        """
        try:
            with self._memory.turn_of_others(streams=False):
                raw = self._next(messages, method, context, OTHERS_S)
        except BusyError:
            return GetMessageClass(message)()
        return self._parsed(raw, message, method, context)

    def _next(self, messages: Messages, method: str, context: grpc.ServicerContext, timeout_s: float) -> bytes:
        """The only message of a call; the call ends where none comes."""
        try:
            with self._patience.at_most(timeout_s, context.cancel):
                raw = next(messages, None)
        except grpc.RpcError as error:
            self._end(error, method, context)
        # gRPC says no more of a call that was cancelled meanwhile, or whose message was beyond the limit
        if raw is None:
            self._end(RequestError("the call ended before its message had come; send exactly one"), method, context)
        return raw

    def _parsed(self, raw: bytes, message: Descriptor, method: str, context: grpc.ServicerContext) -> Message:
        """A message of a call; the call ends where the bytes are none."""
        try:
            return parsed(raw, message)
        except RequestError as error:
            self._end(error, method, context)

    def _end(self, error: Exception, method: str, context: grpc.ServicerContext) -> NoReturn:
        with self._answering(method, context):
            raise error
        raise AssertionError("a call went on after its end")
