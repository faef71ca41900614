"""The gRPC request handler: builds a listening server for an engine."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Event

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from service.errors import AddressError
from service.grpc.answering import answering
from service.grpc.auth import AuthInterceptor
from service.grpc.deadline_watchdog import DeadlineWatchdog
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import add_LocalizationServiceServicer_to_server
from service.grpc.health import Health
from service.grpc.memory import MessageMemory
from service.grpc.reading import SERVICE, ReadingInterceptor
from service.grpc.servicer import Servicer
from service.runtime.engine import Engine
from service.runtime.keys import KeyRing

HEALTH: str = health_pb2.DESCRIPTOR.services_by_name["Health"].full_name
#: Spare threads for calls that are refused or need no worker, while the queue is full.
_SPARE = 16
_LOOKAHEAD_BYTES = 65_536


class GrpcServer:
    """gRPC server of an engine. The caller opens and closes the engine.

    Args:
        engine: open.
        host: to listen on.
        port: 0 lets the system choose.
        keys: of the allowed callers; None allows everybody.
        credentials: for TLS; None serves without TLS.

    Attributes:
        port: on which the server listens.

    Raises:
        AddressError: the address is taken or does not belong to this machine.
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
        self._watchdog = DeadlineWatchdog()
        memory = MessageMemory(
            engine.memory, most_bytes=settings.limits.message_bytes, most_streams=settings.grpc_streams
        )
        reading = ReadingInterceptor(
            self._watchdog, memory, timeout_s=settings.request_timeout_s, answering=partial(answering, engine)
        )
        # Each call needs a waiting thread; the workers of the engine do the work. A stream holds its thread until it ends.
        most = engine.admission.capacity + settings.grpc_streams + _SPARE
        self._server = grpc.server(
            ThreadPoolExecutor(most, thread_name_prefix="streetfix-grpc"),
            options=[
                ("grpc.max_receive_message_length", settings.limits.message_bytes),
                ("grpc.max_send_message_length", -1),
                # Data that a client may send before the service reads its message. By default gRPC raises it to megabytes.
                ("grpc.http2.bdp_probe", 0),
                ("grpc.http2.lookahead_bytes", _LOOKAHEAD_BYTES),
                # Only with several workers: otherwise a taken port would go unnoticed.
                ("grpc.so_reuseport", int(settings.workers > 1)),
                ("grpc.keepalive_time_ms", 30_000),  # ends the stream of a robot that has lost its link
                ("grpc.keepalive_timeout_ms", 10_000),
            ],
            maximum_concurrent_rpcs=most,
            interceptors=[reading] if keys is None else [AuthInterceptor(keys, engine.metrics.requested), reading],
        )
        servicer = Servicer(engine, self._watchdog, memory)
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
        """Start to answer calls."""
        self._watchdog.start()
        self._server.start()

    def begin_stop(self, *, grace_s: float) -> Event:
        """Refuse new calls and let running ones end; return an event that is set when all have ended.

        Args:
            grace_s: seconds after which running calls are cancelled.
        """
        ended: Event = self._server.stop(grace_s)
        return ended

    def stop(self, *, grace_s: float) -> None:
        """Stop the server and wait until all calls have ended.

        Args:
            grace_s: seconds after which running calls are cancelled.
        """
        self.begin_stop(grace_s=grace_s).wait()
        self._watchdog.stop()
