"""Asks for an API key before a call is handled."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import grpc
from grpc_health.v1 import health_pb2

from service.errors import UnauthorizedError
from service.grpc.status import refuse
from service.runtime.keys import KeyRing, presented_key

_HEALTH = "/" + health_pb2.DESCRIPTOR.services_by_name["Health"].full_name + "/Check"
if TYPE_CHECKING:
    _Interceptor = grpc.ServerInterceptor[Any, Any]
else:  # generic in its stub alone
    _Interceptor = grpc.ServerInterceptor


class AuthInterceptor(_Interceptor):
    """Every call but those of health needs a key in its metadata: ``authorization: Bearer KEY`` or ``x-api-key``."""

    def __init__(self, keys: KeyRing, requested: Callable[[str, str, str, float | None], None]) -> None:
        self._keys = keys
        self._requested = requested

    def intercept_service(
        self, continuation: Callable[[grpc.HandlerCallDetails], Any], details: grpc.HandlerCallDetails
    ) -> Any:
        """The handler of a call, or one that refuses it."""
        handler = continuation(details)
        if handler is None or details.method == _HEALTH:
            return handler
        metadata = {name: value for name, value in details.invocation_metadata if isinstance(value, str)}
        try:
            self._keys.require(presented_key(metadata.get("authorization"), metadata.get("x-api-key")))
        except UnauthorizedError as error:
            self._requested("grpc", details.method.rsplit("/", 1)[-1], error.code, None)
            return _refusing(error)
        return handler


def _refusing(error: UnauthorizedError) -> Any:
    """Of the one form that waits for no message, and parses none, before it is called; on the wire all forms begin alike."""

    def one(_: Any, context: grpc.ServicerContext) -> Any:
        refuse(context, error)

    return grpc.stream_unary_rpc_method_handler(one)
