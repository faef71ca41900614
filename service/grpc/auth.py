"""Asks for an API key before a call is handled."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import grpc
from grpc_health.v1 import health

from service.errors import UnauthorizedError
from service.grpc.status import refuse
from service.runtime.keys import KeyRing, presented_key

if TYPE_CHECKING:
    _Interceptor = grpc.ServerInterceptor[Any, Any]
else:  # generic in its stub alone
    _Interceptor = grpc.ServerInterceptor


class AuthInterceptor(_Interceptor):
    """Every call but those of health needs a key in its metadata: ``authorization: Bearer KEY`` or ``x-api-key``."""

    def __init__(self, keys: KeyRing) -> None:
        self._keys = keys

    def intercept_service(
        self, continuation: Callable[[grpc.HandlerCallDetails], Any], details: grpc.HandlerCallDetails
    ) -> Any:
        """The handler of a call, or one that refuses it."""
        handler = continuation(details)
        if handler is None or details.method.startswith(f"/{health.SERVICE_NAME}/"):
            return handler
        metadata = {name: value for name, value in details.invocation_metadata if isinstance(value, str)}
        try:
            self._keys.require(presented_key(metadata.get("authorization"), metadata.get("x-api-key")))
        except UnauthorizedError as error:
            return _refusing(handler, error)
        return handler


def _refusing(handler: Any, error: UnauthorizedError) -> Any:
    """Of the same form as the handler it stands for."""

    def one(_: Any, context: grpc.ServicerContext) -> Any:
        refuse(context, error)

    make = {
        (False, False): grpc.unary_unary_rpc_method_handler, (False, True): grpc.unary_stream_rpc_method_handler,
        (True, False): grpc.stream_unary_rpc_method_handler, (True, True): grpc.stream_stream_rpc_method_handler,
    }[handler.request_streaming, handler.response_streaming]  # fmt: skip
    return make(one, request_deserializer=handler.request_deserializer, response_serializer=handler.response_serializer)
