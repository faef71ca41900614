"""The gRPC face: an engine in, a listening server out."""

from concurrent.futures import ThreadPoolExecutor

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from service.errors import AddressError
from service.grpc.auth import AuthInterceptor
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import add_LocalizationServiceServicer_to_server
from service.grpc.servicer import Servicer
from service.runtime.engine import Engine
from service.runtime.keys import KeyRing

SERVICE: str = pb.DESCRIPTOR.services_by_name["LocalizationService"].full_name
#: Calls that are refused, or ask nothing of the workers, while every place of the queue is taken.
_SPARE = 16


class GrpcServer:
    """Serves an engine that somebody else opens and closes.

    Args:
        engine: open.
        host: to listen on.
        port: 0 lets the system choose.
        keys: who may ask; None lets everybody.
        credentials: TLS; None speaks without.

    Raises:
        AddressError: the address is taken or not ours.
    """

    def __init__(
        self,
        engine: Engine,
        *,
        host: str,
        port: int,
        keys: KeyRing | None = None,
        credentials: grpc.ServerCredentials | None = None,
    ) -> None:
        settings = engine.settings
        # A thread waits for each call; the work itself is the engine's workers'. A stream holds its thread while it lives.
        most = engine.admission.capacity + settings.grpc_streams + _SPARE
        self._server = grpc.server(
            ThreadPoolExecutor(most, thread_name_prefix="streetfix-grpc"),
            options=[
                ("grpc.max_receive_message_length", settings.limits.max_request_bytes),
                ("grpc.max_send_message_length", -1),
                ("grpc.so_reuseport", 0),
            ],
            maximum_concurrent_rpcs=most,
            interceptors=None if keys is None else [AuthInterceptor(keys)],
        )
        add_LocalizationServiceServicer_to_server(  # type: ignore[no-untyped-call]  # generated code
            Servicer(engine, streams=settings.grpc_streams), self._server
        )
        self._health = health.HealthServicer()
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        reflection.enable_server_reflection((SERVICE, health.SERVICE_NAME, reflection.SERVICE_NAME), self._server)
        shown = f"[{host}]" if ":" in host else host
        try:
            address = f"{shown}:{port}"
            self.port: int = (
                self._server.add_insecure_port(address)
                if credentials is None
                else self._server.add_secure_port(address, credentials)
            )
        except RuntimeError as error:
            raise AddressError(f"cannot listen on {shown}:{port} for gRPC; choose another --grpc-port") from error
        engine.when_draining.append(lambda: self._say(health_pb2.HealthCheckResponse.NOT_SERVING))
        self._say(
            health_pb2.HealthCheckResponse.SERVING if engine.is_ready else health_pb2.HealthCheckResponse.NOT_SERVING
        )

    def start(self) -> None:
        """Begin to answer."""
        self._server.start()

    def stop(self, *, grace_s: float) -> None:
        """Take no further calls, let running ones end, and give up on them after the grace."""
        self._say(health_pb2.HealthCheckResponse.NOT_SERVING)
        self._server.stop(grace_s).wait()

    def _say(self, status: "health_pb2.HealthCheckResponse.ServingStatus.ValueType") -> None:
        for name in ("", SERVICE):
            self._health.set(name, status)
