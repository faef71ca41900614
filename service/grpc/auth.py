"""Check the API key before a call is handled."""

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
else:  # only the type stub is generic
    _Interceptor = grpc.ServerInterceptor


class AuthInterceptor(_Interceptor):
    """Requires a key in the metadata of every call except ``Health/Check``: ``authorization: Bearer KEY`` or ``x-api-key``.

    Args:
        keys: of the callers.
        requested: called with request handler, method, code and seconds of a refused call.
    """

    def __init__(self, keys: KeyRing, requested: Callable[[str, str, str, float | None], None]) -> None:
        self._keys = keys
        self._requested = requested

    def intercept_service(
        self, continuation: Callable[[grpc.HandlerCallDetails], Any], details: grpc.HandlerCallDetails
    ) -> Any:
        """Return the handler of a call, or a handler that refuses it.

        Args:
            continuation: returns the handler of a call.
            details: method and metadata of the call.
        """
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
    """Return a handler that refuses a call.

    It has the stream-unary form, because only this form is called before gRPC reads and parses a message. On the wire all forms begin
    in the same way.
    """

    def one(_: Any, context: grpc.ServicerContext) -> Any:
        refuse(context, error)

    return grpc.stream_unary_rpc_method_handler(one)
