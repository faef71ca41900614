"""Reads a call's message in the call's own thread, in its turn, with patience, and looks at its size before it is parsed."""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import grpc
from google.protobuf.message import DecodeError

from service.errors import RequestError, StreetfixError
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.memory import MessageMemory, held_by_call
from service.grpc.patience import Patience
from service.grpc.status import refuse

if TYPE_CHECKING:
    _Interceptor = grpc.ServerInterceptor[Any, Any]
else:  # generic in its stub alone
    _Interceptor = grpc.ServerInterceptor

SERVICE: str = pb.DESCRIPTOR.services_by_name["LocalizationService"].full_name
#: Fields of a message at its top, repeated ones counted each: more make no sense, and each may cost a hundred times its bytes.
MOST_FIELDS = 64
#: Seconds in which a message of another service (health, reflection) must be there: it is small.
OTHERS_S = 3.0


class ReadingInterceptor(_Interceptor):
    """Takes raw bytes where gRPC would parse in its one serving thread, and ends calls that never send them."""

    def __init__(
        self,
        patience: Patience,
        memory: MessageMemory,
        requested: Callable[[str, str, str, float | None], None],
        *,
        timeout_s: float,
    ) -> None:
        self._patience = patience
        self._memory = memory
        self._requested = requested
        self._timeout_s = timeout_s

    def intercept_service(
        self, continuation: Callable[[grpc.HandlerCallDetails], Any], details: grpc.HandlerCallDetails
    ) -> Any:
        """The handler of a call, in another form where its message is read here."""
        handler = continuation(details)
        if handler is None:
            return None
        ours = details.method.startswith(f"/{SERVICE}/")
        if handler.unary_unary is not None:
            answer = (
                self._answer(handler, details.method.rsplit("/", 1)[-1]) if ours else self._answer_of_others(handler)
            )
            return grpc.stream_unary_rpc_method_handler(answer, response_serializer=handler.response_serializer)
        if ours or handler.stream_stream is None:
            return handler
        return grpc.stream_stream_rpc_method_handler(
            self._stream_of_others(handler), response_serializer=handler.response_serializer
        )

    def _answer(self, handler: Any, method: str) -> Callable[[Iterator[bytes], grpc.ServicerContext], Any]:
        def answer(messages: Iterator[bytes], context: grpc.ServicerContext) -> Any:
            with self._memory.hold() as hold:
                try:
                    with self._memory.turn():
                        with self._patience.at_most(self._timeout_s, context.cancel):
                            raw = next(messages, b"")
                        hold.grow(len(raw))
                    require_few_fields(raw)
                except StreetfixError as error:
                    self._requested("grpc", method, error.code, None)
                    refuse(context, error)
                with self._memory.parsing(len(raw)):
                    message = handler.request_deserializer(raw)
                    del raw
                held_by_call.set(hold)
                return handler.unary_unary(message, context)

        return answer

    def _answer_of_others(self, handler: Any) -> Callable[[Iterator[bytes], grpc.ServicerContext], Any]:
        def answer(messages: Iterator[bytes], context: grpc.ServicerContext) -> Any:
            try:
                with self._memory.turn_of_others(streams=False), self._patience.at_most(OTHERS_S, context.cancel):
                    message = handler.request_deserializer(next(messages, b""))
            except StreetfixError as error:
                refuse(context, error)
            except DecodeError:
                refuse(context, _no_message())
            return handler.unary_unary(message, context)

        return answer

    def _stream_of_others(self, handler: Any) -> Callable[[Iterator[bytes], grpc.ServicerContext], Iterator[Any]]:
        def in_turn(messages: Iterator[bytes], context: grpc.ServicerContext) -> Iterator[Any]:
            while True:
                try:
                    with self._memory.turn_of_others(streams=True), self._patience.at_most(OTHERS_S, context.cancel):
                        raw = next(messages, None)
                    if raw is None:
                        return
                    message = handler.request_deserializer(raw)
                except StreetfixError as error:
                    refuse(context, error)
                except DecodeError:
                    refuse(context, _no_message())
                yield message

        def answers(messages: Iterator[bytes], context: grpc.ServicerContext) -> Iterator[Any]:
            yield from handler.stream_stream(in_turn(messages, context), context)

        return answers


def require_few_fields(raw: bytes, *, most: int = MOST_FIELDS) -> None:
    """Walk over the fields of a message without looking into them.

    Raises:
        RequestError: there are more than a message of ours has, or the bytes are no message.
    """
    at, count = 0, 0
    while at < len(raw):
        count += 1
        if count > most:
            raise RequestError(
                f"the message has more than {most} fields at its top; send fewer requests or frames at once"
            )
        tag, at = _varint(raw, at)
        kind = tag & 7
        if kind == 0:
            _, at = _varint(raw, at)
        elif kind == 1:
            at += 8
        elif kind == 2:
            length, at = _varint(raw, at)
            at += length
        elif kind == 5:
            at += 4
        else:
            raise _no_message()
    if at != len(raw):
        raise _no_message()


def _varint(raw: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(raw):
            break
        byte = raw[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise _no_message()


def _no_message() -> RequestError:
    return RequestError("the bytes are no protobuf message; use the proto in this service's repository")
