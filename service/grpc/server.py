"""The gRPC face: an engine in, a listening server out."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Event

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from service.errors import AddressError
from service.grpc.answering import answering
from service.grpc.auth import AuthInterceptor
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import add_LocalizationServiceServicer_to_server
from service.grpc.health import Health
from service.grpc.memory import MessageMemory
from service.grpc.patience import Patience
from service.grpc.reading import SERVICE, ReadingInterceptor
from service.grpc.servicer import Servicer
from service.runtime.engine import Engine
from service.runtime.keys import KeyRing

HEALTH: str = health_pb2.DESCRIPTOR.services_by_name["Health"].full_name
#: Calls that are refused, or ask nothing of the workers, while every place of the queue is taken.
_SPARE = 16
_LOOKAHEAD_BYTES = 65_536


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
        self._patience = Patience()
        memory = MessageMemory(
            engine.memory, most_bytes=settings.limits.message_bytes, most_streams=settings.grpc_streams
        )
        reading = ReadingInterceptor(
            self._patience, memory, timeout_s=settings.request_timeout_s, answering=partial(answering, engine)
        )
        # A thread waits for each call; the work itself is the engine's workers'. A stream holds its thread while it lives.
        most = engine.admission.capacity + settings.grpc_streams + _SPARE
        self._server = grpc.server(
            ThreadPoolExecutor(most, thread_name_prefix="streetfix-grpc"),
            options=[
                ("grpc.max_receive_message_length", settings.limits.message_bytes),
                ("grpc.max_send_message_length", -1),
                # What a client may send ahead of our asking for its message: gRPC would widen it to megabytes by itself.
                ("grpc.http2.bdp_probe", 0),
                ("grpc.http2.lookahead_bytes", _LOOKAHEAD_BYTES),
                ("grpc.so_reuseport", int(settings.workers > 1)),  # else a taken port would go unnoticed
                ("grpc.keepalive_time_ms", 30_000),  # a robot that lost its link must not keep its stream
                ("grpc.keepalive_timeout_ms", 10_000),
            ],
            maximum_concurrent_rpcs=most,
            interceptors=[reading] if keys is None else [AuthInterceptor(keys, engine.metrics.requested), reading],
        )
        servicer = Servicer(engine, self._patience, memory)
        add_LocalizationServiceServicer_to_server(servicer, self._server)  # type: ignore[no-untyped-call]  # generated code
        health_pb2_grpc.add_HealthServicer_to_server(Health(engine, ("", SERVICE)), self._server)
        reflection.enable_server_reflection((SERVICE, HEALTH, reflection.SERVICE_NAME), self._server)
        shown = f"[{host}]" if ":" in host else host
        address = f"{shown}:{port}"
        try:
            self.port: int = (
                self._server.add_insecure_port(address)
                if credentials is None
                else self._server.add_secure_port(address, credentials)
            )
        except RuntimeError as error:
            raise AddressError(f"cannot listen on {address} for gRPC; choose another --grpc-port") from error

    def start(self) -> None:
        """Begin to answer."""
        self._patience.start()
        self._server.start()

    def begin_stop(self, *, grace_s: float) -> Event:
        """Take no further calls, let running ones end, and give up on them after the grace; the event is set when all is over."""
        ended: Event = self._server.stop(grace_s)
        return ended

    def stop(self, *, grace_s: float) -> None:
        """Stop and wait for the end."""
        self.begin_stop(grace_s=grace_s).wait()
        self._patience.stop()
