"""The service ``grpc.health.v1``.

The ready-made servicer is not used. It holds locks while a peer reads, and it keeps every service name that was ever queried.
"""

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from service.runtime.engine import Engine


class Health(health_pb2_grpc.HealthServicer):  # type: ignore[misc]  # untyped
    """Reports the same as ``/readyz``, for the whole server and for LocalizationService.

    ``Watch`` is not served: each watcher needs no key and would hold a thread without a time limit. The protocol lets clients handle
    UNIMPLEMENTED as "no news".

    Args:
        engine: its readiness is reported.
        services: known names; the empty name stands for the whole server.
    """

    def __init__(self, engine: Engine, services: tuple[str, ...]) -> None:
        self._engine = engine
        self._services = services

    def Check(
        self, request: health_pb2.HealthCheckRequest, context: grpc.ServicerContext
    ) -> health_pb2.HealthCheckResponse:
        """Return whether a service is ready; NOT_FOUND for an unknown service.

        Args:
            request: names the service.
            context: of the call.
        """
        if request.service not in self._services:
            context.abort(grpc.StatusCode.NOT_FOUND, "service not found")
        kinds = health_pb2.HealthCheckResponse
        return kinds(status=kinds.SERVING if self._engine.is_ready else kinds.NOT_SERVING)
