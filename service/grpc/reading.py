"""Reads a call's message in the call's own thread, with patience, and looks at its size before it is parsed."""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import grpc

from service.errors import RequestError
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.patience import Patience
from service.grpc.status import refuse

if TYPE_CHECKING:
    _Interceptor = grpc.ServerInterceptor[Any, Any]
else:  # generic in its stub alone
    _Interceptor = grpc.ServerInterceptor

SERVICE: str = pb.DESCRIPTOR.services_by_name["LocalizationService"].full_name
#: Fields of a message at its top, repeated ones counted each: more make no sense, and each may cost a hundred times its bytes.
MOST_FIELDS = 64


class ReadingInterceptor(_Interceptor):
    """Takes raw bytes where gRPC would parse in its one serving thread, and ends calls that never send them."""

    def __init__(self, patience: Patience, *, timeout_s: float) -> None:
        self._patience = patience
        self._timeout_s = timeout_s

    def intercept_service(
        self, continuation: Callable[[grpc.HandlerCallDetails], Any], details: grpc.HandlerCallDetails
    ) -> Any:
        """The handler of a call of ours, in another form."""
        handler = continuation(details)
        if handler is None or handler.unary_unary is None or not details.method.startswith(f"/{SERVICE}/"):
            return handler

        def answer(messages: Iterator[bytes], context: grpc.ServicerContext) -> Any:
            with self._patience.at_most(self._timeout_s, context.cancel):
                raw = next(messages, b"")
            try:
                require_few_fields(raw)
            except RequestError as error:
                refuse(context, error)
            return handler.unary_unary(handler.request_deserializer(raw), context)

        return grpc.stream_unary_rpc_method_handler(answer, response_serializer=handler.response_serializer)


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
