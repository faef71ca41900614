"""``grpc.health.v1``, without what its ready-made servicer keeps: locks held while a peer reads, and every name it was ever asked."""

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from service.runtime.engine import Engine


class Health(health_pb2_grpc.HealthServicer):  # type: ignore[misc]  # untyped
    """Says what ``/readyz`` says, for the server as a whole and for our service.

    ``Watch`` is not served: each watcher would hold a thread, without a key and for as long as it likes. Clients that would watch take
    UNIMPLEMENTED for "no news", as the protocol has it.
    """

    def __init__(self, engine: Engine, services: tuple[str, ...]) -> None:
        self._engine = engine
        self._services = services

    def Check(
        self, request: health_pb2.HealthCheckRequest, context: grpc.ServicerContext
    ) -> health_pb2.HealthCheckResponse:
        """One look."""
        if request.service not in self._services:
            context.abort(grpc.StatusCode.NOT_FOUND, "there is no such service here")
        kinds = health_pb2.HealthCheckResponse
        return kinds(status=kinds.SERVING if self._engine.is_ready else kinds.NOT_SERVING)
