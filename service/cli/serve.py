"""``streetfix serve``: open the maps, listen, and answer requests until a signal arrives."""

import gc
import math
import os
import secrets
import signal
import socket
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from service.errors import AddressError, BundleError

if TYPE_CHECKING:
    import uvicorn
    from fastapi import FastAPI

    from service.cli.certificates import Certificates
    from service.runtime.engine import Engine
    from service.runtime.keys import KeyRing
    from service.runtime.serving_table import ServingTable
    from service.runtime.settings import Settings

_BACKLOG = 128
#: Environment variable for the folder in which the Prometheus client library keeps the counts of several processes.
METRICS_FOLDER = "PROMETHEUS_MULTIPROC_DIR"


@contextmanager
def _uncollected() -> Iterator[None]:
    """Collect no garbage until ``_settled``. Imports make many objects and hardly any garbage, but collections take a fifth of their time.

    Garbage is collected again at the latest after the context.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def command(
    maps: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="BUNDLE",
            help="Map bundles, folders of them, or URLs of maps in object storage (s3://, gs://, az://, file://). "
            "URL@VERSION serves one version.",
            show_default=False,
        ),
    ] = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on.  [default: 127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="HTTP port. 0 lets the system choose.  [default: 8000]")] = None,
    grpc_port: Annotated[
        int | None, typer.Option(help="Also serve gRPC on this port.  [default: no gRPC]", show_default=False)
    ] = None,
    threads: Annotated[
        int | None, typer.Option(help="Requests that a process works on at once.  [default: its share of the cores]")
    ] = None,
    queue: Annotated[
        int | None, typer.Option(help="Requests that may wait in a process before 503.  [default: 64]")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes that share the ports and the maps.  [default: 1]")
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="Settings file, TOML. The environment and flags override it.", show_default=False),
    ] = None,
    samples: Annotated[
        Path | None,
        typer.Option(help="Folder of sample queries for the console.", show_default=False),
    ] = None,
    tile_cache: Annotated[
        Path | None,
        typer.Option(
            help="Folder for maps from object storage.  [default: ~/.cache/streetfix/tiles]", show_default=False
        ),
    ] = None,
    tile_cache_bytes: Annotated[
        int | None, typer.Option(help="Bound of the tiles in that folder.  [default: 20000000000]")
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Check settings, keys, certificates and maps. Print the effective settings and exit."
        ),
    ] = False,
    strict: Annotated[
        bool | None,
        typer.Option(
            "--strict", help="Do not start if there is no map bundle, or if one cannot be mounted.", show_default=False
        ),
    ] = None,
    false_accept_rate: Annotated[
        float | None,
        typer.Option(
            help="Largest share of the out-of-map calibration queries that may be LOCALIZED. A higher rate than the default also accepts "
            "a confidence of 0.5 to 0.9.  [default: 0.01]"
        ),
    ] = None,
) -> None:
    """Serve maps over HTTP and gRPC.

    By default the service listens on loopback only.

    Every option but --check has a variable: STREETFIX_HOST, STREETFIX_PORT and so on. STREETFIX_MAPS names the maps,
    with ':' between them. A TOML file can hold the same settings. --config or STREETFIX_CONFIG names the file.

    The service skips damaged map bundles and reports them (log, /readyz, /metrics). The service ends only if there are
    bundles and none can be mounted. With an empty maps folder the service is not ready until a bundle arrives.

    \b
    Example:
      streetfix serve maps/paper-city --port 8000 --grpc-port 50051
      streetfix serve s3://bucket/maps/town --tile-cache /var/cache/streetfix
    """
    from service.runtime.threads import limit_pools_before_import

    limit_pools_before_import()
    with _uncollected():
        from service.runtime.settings import load_settings

        settings = load_settings(
            config,
            maps=tuple(maps) if maps else None,
            host=host,
            port=port,
            grpc_port=grpc_port,
            threads=threads,
            queue=queue,
            workers=workers,
            strict=strict,
            false_accept_rate=false_accept_rate,
            samples=samples,
            tile_cache=tile_cache,
            tile_cache_bytes=tile_cache_bytes,
        )
        (check_only if check else serve)(settings)


def check_only(settings: "Settings") -> None:
    """Open everything that a service would open, print the result, and return.

    Args:
        settings: of the service.

    Raises:
        StreetfixError: the service could not start, or a map could not serve.
    """
    from service.cli.certificates import Certificates
    from service.console.samples import Samples
    from service.runtime.engine import Engine
    from service.runtime.keys import KeyRing

    if not settings.maps:
        raise BundleError("there is no map to serve: streetfix serve BUNDLE, or set STREETFIX_MAPS")
    if settings.console and settings.samples is not None:
        Samples.open(settings.samples)
    callers = 0 if settings.api_keys is None else len(KeyRing.open(settings.api_keys).caller_of)
    if settings.tls_certificate is not None:
        Certificates.read(settings)
    gc.enable()  # the imports are done, and many maps may be opened
    engine = Engine.open(settings)
    typer.echo(settings.model_dump_json(indent=2))
    engine.close()
    for localizer in engine.registry:
        manifest = localizer.bundle.manifest
        typer.echo(f"map {manifest.name} {manifest.version}: opens and answers")
    typer.echo(f"keys: {callers}" if callers else "no keys")
    if refused := engine.registry.refused:
        reasons = "; ".join(each.reason for each in refused)
        raise BundleError(f"{len(refused)} of the map bundles cannot be mounted: {reasons}")
    if not len(engine.registry):
        typer.echo(_no_map_yet(settings))


def serve(settings: "Settings") -> None:
    """Open the maps and answer requests until SIGINT or SIGTERM.

    Args:
        settings: of the service.

    Raises:
        StreetfixError: no map is given, or no given bundle can be mounted. With the setting ``strict``: one cannot be mounted.
        AddressError: the address is taken or does not belong to this machine.
    """
    from pydantic import SecretStr

    from service.heap import limit_heap
    from service.runtime.seal import LEAST_KEY
    from service.runtime.threads import usable_cores

    if not settings.maps:
        raise BundleError("there is no map to serve: streetfix serve BUNDLE, or set STREETFIX_MAPS")
    limit_heap(settings.threads or usable_cores())
    if settings.belief_key is None:  # the workers need the same one
        settings = settings.model_copy(update={"belief_key": SecretStr(secrets.token_hex(LEAST_KEY))})
    if settings.workers == 1:
        with (
            _hangup_held_back(),
            _listen(settings.host, settings.port) as listener,
            _listen_for_health(settings) as health,
        ):
            _answer(settings, listener, health)
    else:
        _answer_by_workers(settings)
    typer.echo("stopped")


def _answer_by_workers(settings: "Settings") -> None:
    """Answer by several processes on the same ports. They share metrics in a folder, and map versions in shared memory.

    Each worker has its own listening socket (SO_REUSEPORT), and the system distributes connections among them. With one shared
    socket, keep-alive connections would pile up in the fastest worker.
    """
    from service.cli.shared_counts import release, reserve
    from service.cli.workers import supervise
    from service.runtime.serving_table import SharedMemory, SharedServingTable

    gc.enable()  # this process serves nobody, but it lives as long as the service
    with (
        tempfile.TemporaryDirectory(prefix="streetfix-") as folder,
        closing(SharedMemory()) as memory,
        _held_port(settings.host, settings.port) as port,
        _held_port(settings.host, settings.grpc_port) as grpc_port,
        _held_port(settings.health_host or settings.host, settings.health_port) as health_port,
    ):
        counts = Path(folder) / "metrics"
        counts.mkdir()
        os.environ[METRICS_FOLDER] = str(counts)  # the Prometheus client reads it at import, which only workers do
        shared = settings.model_copy(update={"port": port, "grpc_port": grpc_port, "health_port": health_port})

        def work(number: int, ready: Callable[[], None]) -> None:
            with (
                _bind_shared(shared.host, shared.port) as listener,
                _listen_for_health(shared, shared=True) as health,
            ):
                table = SharedServingTable(memory, number)
                if (error := reserve(counts)) is not None:
                    del os.environ[METRICS_FOLDER]
                    message = (
                        f"worker {number} reports only its own metrics until it is started again ({counts}: "
                        f"{error.strerror})"
                    )
                    typer.echo(f"streetfix: {message}", err=True)
                _answer(shared, listener, health, table=table, ready=ready, says_where=number == 0)

        # Requests and streams each end within the grace period. A worker that runs much longer hangs.
        code = supervise(
            settings.workers,
            work,
            ended=partial(release, counts),
            kill_after_s=settings.drain_s + 2 * settings.grace_s + 10.0,
        )
    if code:
        raise typer.Exit(code)


@contextmanager
def _held_port(host: str, port: int | None) -> Iterator[int | None]:
    """Reserve a port for the workers inside the context; the system chooses it if it is 0.

    Raises:
        AddressError: the port is taken.
    """
    if port is None:
        yield None
        return
    with _listen(host, port) as alone:  # otherwise two services could share the port unnoticed
        chosen = int(alone.getsockname()[1])
    with _bind_shared(host, chosen):
        yield chosen


@_uncollected()
def _answer(
    settings: "Settings",
    listener: socket.socket,
    health: socket.socket | None,
    *,
    table: "ServingTable | None" = None,
    ready: Callable[[], None] = lambda: None,
    says_where: bool = True,
) -> None:
    """Open the maps and answer requests in this process."""
    import uvicorn

    from service.cli.certificates import Certificates
    from service.cli.draining import DrainingServer
    from service.cli.reloading import reloading
    from service.http.app import create_app, create_health_app
    from service.http.protocol import BoundedHttp
    from service.runtime.engine import Engine
    from service.runtime.keys import KeyRing
    from service.runtime.logs import set_up

    set_up(style=settings.log_style, level=settings.log_level)
    keys = None if settings.api_keys is None else KeyRing.open(settings.api_keys)
    tls = None if settings.tls_certificate is None else Certificates.read(settings)
    if settings.grpc_port is not None:
        import service.grpc.server  # noqa: F401  # imported here, so that ``_settled`` freezes its objects
    with _settled():
        engine = Engine.open(settings, table)
        try:
            config = uvicorn.Config(
                create_app(engine, keys),
                http=BoundedHttp,
                ws="none",
                proxy_headers=False,
                log_config=None,
                access_log=False,
                lifespan="off",
                timeout_graceful_shutdown=math.ceil(settings.grace_s),
                **({} if tls is None else tls.for_uvicorn()),
            )
            beside = [] if health is None else [(health, _plain(create_health_app(engine)))]
            with (
                _grpc(engine, keys, tls) as (grpc_port, leave),
                reloading(keys, tls, every_s=settings.watch_s) as reloader,
                _watching(engine, also=reloader.look_now),
            ):

                def started() -> None:
                    ready()
                    if says_where:
                        _say_where(engine, listener, grpc_port, "http" if tls is None else "https", health)

                server = DrainingServer(
                    config, engine, delay_s=settings.drain_s, started=started, leaving=leave, beside=beside
                )
                # uvicorn installs its own handlers while it runs, and raises received signals again at the end. With these handlers
                # that does no harm.
                for number in (signal.SIGINT, signal.SIGTERM):
                    signal.signal(number, server.handle_exit)
                server.run(sockets=[listener])
        finally:
            engine.close()


def _plain(app: "FastAPI") -> "uvicorn.Config":
    """Build the configuration of a listener without TLS."""
    import uvicorn

    from service.http.protocol import BoundedHttp

    return uvicorn.Config(
        app, http=BoundedHttp, ws="none", proxy_headers=False, log_config=None, access_log=False, lifespan="off"
    )


@contextmanager
def _settled() -> Iterator[None]:
    """Exclude the present objects from garbage collection: a hundred thousand objects of imported modules.

    A full collection of them took 100 ms, during which the service answered nobody (decision log). So there is none before, either
    (decision 0198). Maps are opened inside the context, so a replaced map is still collected.
    """
    gc.freeze()
    gc.enable()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def _grpc(
    engine: "Engine", keys: "KeyRing | None", tls: "Certificates | None"
) -> Iterator[tuple[int | None, Callable[[], object]]]:
    """Serve gRPC inside the context if the settings enable it; yield its port and a function that begins to stop it."""
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
def _hangup_held_back() -> Iterator[None]:
    """Block SIGHUP until ``_watching`` has a handler for it. Without a handler SIGHUP would end the process.

    The supervisor does the same for workers.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})
    try:
        yield
    finally:
        # Drop a SIGHUP that arrived after ``_watching`` ended: ignoring a blocked signal discards it.
        handler = signal.signal(signal.SIGHUP, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        signal.signal(signal.SIGHUP, handler)


@contextmanager
def _watching(engine: "Engine", *, also: Callable[[], None]) -> Iterator[None]:
    """Look for new bundles inside the context, periodically and on SIGHUP.

    SIGHUP makes the service read external files again. The service itself never sends SIGHUP; workers share news about maps through
    the serving table.

    Args:
        engine: its watcher looks for the bundles.
        also: also called on SIGHUP; it must be safe in a signal handler.
    """
    watcher = engine.watcher

    def reload(_number: int, _frame: FrameType | None) -> None:  # runs between two instructions of the main thread
        watcher.look_now()
        also()

    watcher.start(engine.settings.watch_s or threading.TIMEOUT_MAX)
    before = signal.signal(signal.SIGHUP, reload)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGHUP})  # a SIGHUP that arrived meanwhile is handled now
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})
        signal.signal(signal.SIGHUP, before)
        watcher.stop()


@contextmanager
def _listen_for_health(settings: "Settings", *, shared: bool = False) -> Iterator[socket.socket | None]:
    """Provide the listener of the health port; None if the settings have no such port.

    Raises:
        AddressError: the address is taken or does not belong to this machine.
    """
    if settings.health_port is None:
        yield None
        return
    listen = _bind_shared if shared else _listen
    with listen(settings.health_host or settings.host, settings.health_port) as listener:
        yield listener


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except OSError as error:
        raise _cannot_listen(host, port, error) from error


def _bind_shared(host: str, port: int) -> socket.socket:
    """Bind a socket to a port that other processes share.

    It does not listen yet. The system gives connections only to listening sockets, so no client waits for a worker that still opens
    maps.
    """
    bound = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        bound.bind((host, port))
    except OSError as error:
        bound.close()
        raise _cannot_listen(host, port, error) from error
    return bound


def _cannot_listen(host: str, port: int, error: OSError) -> AddressError:
    return AddressError(f"cannot listen on {host}:{port} ({error.strerror}); choose another --host or --port")


def _say_where(
    engine: "Engine", listener: socket.socket, grpc_port: int | None, scheme: str, health: socket.socket | None
) -> None:
    host, port = listener.getsockname()[:2]
    for localizer in engine.registry:
        manifest = localizer.bundle.manifest
        typer.echo(
            f"map {manifest.name} {manifest.version}: {manifest.counts.places} places, {manifest.counts.views} views"
        )
    if not len(engine.registry):
        typer.echo(_no_map_yet(engine.settings))
    shown = f"[{host}]" if ":" in host else host
    if grpc_port is not None:
        typer.echo(f"serving gRPC at {shown}:{grpc_port} (API: proto/, or server reflection)")
    if health is not None:
        address, health_port = health.getsockname()[:2]
        typer.echo(f"health at http://{f'[{address}]' if ':' in address else address}:{health_port}/readyz")
    if engine.settings.console:
        typer.echo(f"console at {scheme}://{shown}:{port}/console/")
    typer.echo(f"serving at {scheme}://{shown}:{port} (API: /docs). Stop with Ctrl-C.")


def _no_map_yet(settings: "Settings") -> str:
    where = ", ".join(map(str, settings.maps))
    return f"no map yet: not ready (/readyz answers 503) until there is a map bundle in {where}"
