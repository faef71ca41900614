"""``streetfix serve``: open the maps, listen, answer until told to stop."""

import math
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.errors import AddressError, BundleError

if TYPE_CHECKING:
    from service.cli.certificates import Certificates
    from service.runtime.engine import Engine
    from service.runtime.keys import KeyRing
    from service.runtime.map_registry import MapRegistry
    from service.runtime.settings import Settings

_BACKLOG = 128


def command(
    maps: Annotated[
        list[Path] | None,
        typer.Argument(metavar="BUNDLE", help="Map bundles, or folders of them.", show_default=False),
    ] = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on.  [default: 127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="0 lets the system choose.  [default: 8000]")] = None,
    grpc_port: Annotated[
        int | None, typer.Option(help="Serve gRPC too, on this port.  [default: no gRPC]", show_default=False)
    ] = None,
    threads: Annotated[int | None, typer.Option(help="Requests worked on at once.  [default: the cores]")] = None,
    queue: Annotated[int | None, typer.Option(help="Requests that may wait before 503.  [default: 64]")] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Check settings, keys, certificates and maps, print the effective settings, and leave."
        ),
    ] = False,
    false_accept_rate: Annotated[
        float | None,
        typer.Option(help="Share of the queries taken outside the map that may be LOCALIZED.  [default: 0.01]"),
    ] = None,
) -> None:
    """Serve maps over HTTP and gRPC; loopback only, unless told otherwise.

    Every option can be set as STREETFIX_HOST, STREETFIX_PORT and so on, the maps as STREETFIX_MAPS (':' between).

    Example: streetfix serve maps/paper-city --port 8000 --grpc-port 50051
    """
    from service.runtime.threads import limit_pools_before_import

    limit_pools_before_import()
    from service.runtime.settings import load_settings

    (check_only if check else serve)(
        load_settings(
            maps=tuple(maps) if maps else None, host=host, port=port, grpc_port=grpc_port, threads=threads, queue=queue,
            false_accept_rate=false_accept_rate,
        )
    )  # fmt: skip


def check_only(settings: "Settings") -> None:
    """Open all that a service would open, say what it found, and leave.

    Raises:
        StreetfixError: what would keep it from serving.
    """
    from service.cli.certificates import Certificates
    from service.runtime.engine import Engine
    from service.runtime.keys import KeyRing

    if not settings.maps:
        raise BundleError("there is no map to serve: streetfix serve BUNDLE, or set STREETFIX_MAPS")
    callers = 0 if settings.api_keys is None else len(KeyRing.open(settings.api_keys).caller_of)
    if settings.tls_certificate is not None:
        Certificates.read(settings)
    engine = Engine.open(settings)
    typer.echo(settings.model_dump_json(indent=2))
    for localizer in engine.registry:
        engine.warm(localizer)
        manifest = localizer.bundle.manifest
        typer.echo(f"map {manifest.name} {manifest.version}: opens and answers")
    typer.echo(f"keys of {callers} callers" if callers else "no keys")
    engine.close()


def serve(settings: "Settings") -> None:
    """Open the maps and answer until SIGINT or SIGTERM.

    Raises:
        BundleError: a map is missing, damaged or mismatched, or none is given.
        AddressError: the address is taken or not ours.
    """
    import uvicorn

    from service.cli.certificates import Certificates
    from service.cli.draining import DrainingServer
    from service.http.app import create_app
    from service.runtime.engine import Engine
    from service.runtime.keys import KeyRing
    from service.runtime.logs import set_up

    if not settings.maps:
        raise BundleError("there is no map to serve: streetfix serve BUNDLE, or set STREETFIX_MAPS")
    set_up(style=settings.log_style, level=settings.log_level)
    keys = None if settings.api_keys is None else KeyRing.open(settings.api_keys)
    tls = None if settings.tls_certificate is None else Certificates.read(settings)
    engine = Engine.open(settings)
    try:
        with _listen(settings.host, settings.port) as listener:
            config = uvicorn.Config(
                create_app(engine, keys), log_config=None, access_log=False, lifespan="off",
                timeout_graceful_shutdown=math.ceil(settings.grace_s), **({} if tls is None else tls.for_uvicorn()),
            )  # fmt: skip
            with _grpc(engine, keys, tls) as (grpc_port, leave), _watching(engine):
                server = DrainingServer(config, engine, delay_s=settings.drain_s, leaving=leave)
                # While it runs uvicorn has these handlers itself, and raises again what it got; both are harmless so.
                for number in (signal.SIGINT, signal.SIGTERM):
                    signal.signal(number, server.handle_exit)
                _say_where(engine.registry, listener, grpc_port, "http" if tls is None else "https")
                server.run(sockets=[listener])
    finally:
        engine.close()
    typer.echo("stopped")


@contextmanager
def _grpc(
    engine: "Engine", keys: "KeyRing | None", tls: "Certificates | None"
) -> Iterator[tuple[int | None, Callable[[], object]]]:
    """Serve gRPC inside, where the settings want it; its port, and what begins its end."""
    settings = engine.settings
    if settings.grpc_port is None:
        yield None, lambda: None
        return
    from service.grpc.server import GrpcServer

    credentials = None if tls is None else tls.for_grpc()
    server = GrpcServer(engine, host=settings.host, port=settings.grpc_port, keys=keys, credentials=credentials)
    server.start()
    try:
        yield server.port, lambda: server.begin_stop(grace_s=settings.grace_s)
    finally:
        server.stop(grace_s=settings.grace_s)


@contextmanager
def _watching(engine: "Engine") -> Iterator[None]:
    """Mount new bundles inside: every so often, and on SIGHUP."""
    from service.runtime.map_watcher import MapWatcher

    watcher = MapWatcher(engine.registry, engine.settings.maps, warm=engine.warm)
    watcher.start(engine.settings.watch_s or threading.TIMEOUT_MAX)
    before = signal.signal(signal.SIGHUP, lambda *_: watcher.look_now()) if hasattr(signal, "SIGHUP") else None
    try:
        yield
    finally:
        if before is not None:
            signal.signal(signal.SIGHUP, before)
        watcher.stop()


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except OSError as error:
        raise AddressError(
            f"cannot listen on {host}:{port} ({error.strerror}); choose another --host or --port"
        ) from error


def _say_where(registry: "MapRegistry", listener: socket.socket, grpc_port: int | None, scheme: str) -> None:
    host, port = listener.getsockname()[:2]
    for localizer in registry:
        manifest = localizer.bundle.manifest
        typer.echo(
            f"map {manifest.name} {manifest.version}: {manifest.counts.places} places, {manifest.counts.views} views"
        )
    shown = f"[{host}]" if ":" in host else host
    if grpc_port is not None:
        typer.echo(f"serving gRPC at {shown}:{grpc_port} (what it can do: proto/, or by reflection)")
    typer.echo(f"serving at {scheme}://{shown}:{port} (what it can do: /openapi.json; stop: Ctrl-C)")
