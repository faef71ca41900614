"""Reads a call's messages in the call's own thread, with patience, and looks at their size before they are parsed.

Left to gRPC, bytes that do not parse end a call with its own words, a traceback in the log, and no count in the metrics.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, NoReturn

import grpc
from google.protobuf.descriptor import Descriptor
from google.protobuf.descriptor_pool import Default
from google.protobuf.message import Message

from service.errors import RequestError
from service.grpc.call import Call
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.parsing import parsed
from service.grpc.patience import Patience

if TYPE_CHECKING:
    _Interceptor = grpc.ServerInterceptor[Any, Any]
else:  # generic in its stub alone
    _Interceptor = grpc.ServerInterceptor

SERVICE: str = pb.DESCRIPTOR.services_by_name["LocalizationService"].full_name
#: Ends a call of that name as the contract says; ``service.grpc.answering.answering`` of an engine.
Answering = Callable[[str, grpc.ServicerContext], AbstractContextManager[Call]]


class ReadingInterceptor(_Interceptor):
    """Takes raw bytes where gRPC would parse, ends calls that never send them, and refuses what does not parse.

    Args:
        patience: ends calls.
        timeout_s: that a call of ours may take to send its only message.
        answering: how refused calls end.
    """

    def __init__(self, patience: Patience, *, timeout_s: float, answering: Answering) -> None:
        self._patience = patience
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
        serializer = handler.response_serializer
        if handler.request_streaming:

            def stream(messages: Iterator[bytes], context: grpc.ServicerContext) -> Any:
                if service == SERVICE:  # our servicer ends its streams itself
                    return handler.stream_stream((parsed(raw, message) for raw in messages), context)
                return handler.stream_stream((self._parsed(raw, message, method, context) for raw in messages), context)

            return grpc.stream_stream_rpc_method_handler(stream, response_serializer=serializer)
        if service != SERVICE:  # health, which needs no key: a call must not hold a thread before its message is there
            behaviour = handler.unary_stream if handler.response_streaming else handler.unary_unary

            def one(raw: bytes, context: grpc.ServicerContext) -> Any:
                return behaviour(self._parsed(raw, message, method, context), context)

            if handler.response_streaming:
                return grpc.unary_stream_rpc_method_handler(one, response_serializer=serializer)
            return grpc.unary_unary_rpc_method_handler(one, response_serializer=serializer)

        def patient(messages: Iterator[bytes], context: grpc.ServicerContext) -> Any:
            raw = self._next(messages, method, context)
            return handler.unary_unary(self._parsed(raw, message, method, context), context)

        return grpc.stream_unary_rpc_method_handler(patient, response_serializer=serializer)

    def _next(self, messages: Iterator[bytes], method: str, context: grpc.ServicerContext) -> bytes:
        """The only message of a call; the call ends where none comes."""
        try:
            with self._patience.at_most(self._timeout_s, context.cancel):
                raw = next(messages, None)
        except grpc.RpcError as error:
            self._end(error, method, context)
        if (
            raw is None
        ):  # gRPC says no more of a call that was cancelled meanwhile, or whose message was beyond the limit
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
