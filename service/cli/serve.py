"""``streetfix serve``: open the maps, listen, answer until told to stop."""

import signal
import socket
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.errors import AddressError, BundleError

if TYPE_CHECKING:
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
    threads: Annotated[int | None, typer.Option(help="Requests worked on at once.  [default: the cores]")] = None,
    queue: Annotated[int | None, typer.Option(help="Requests that may wait before 503.  [default: 64]")] = None,
    false_accept_rate: Annotated[
        float | None,
        typer.Option(help="Share of the queries taken outside the map that may be LOCALIZED.  [default: 0.01]"),
    ] = None,
) -> None:
    """Serve maps over HTTP; loopback only, unless told otherwise.

    Every option can be set as STREETFIX_HOST, STREETFIX_PORT and so on, the maps as STREETFIX_MAPS (':' between).

    Example: streetfix serve maps/paper-city --port 8000
    """
    from service.runtime.threads import limit_pools_before_import

    limit_pools_before_import()
    from service.runtime.settings import load_settings

    serve(
        load_settings(
            maps=tuple(maps) if maps else None, host=host, port=port, threads=threads, queue=queue, false_accept_rate=false_accept_rate
        )
    )  # fmt: skip


def serve(settings: "Settings") -> None:
    """Open the maps and answer until SIGINT or SIGTERM.

    Raises:
        BundleError: a map is missing, damaged or mismatched, or none is given.
        AddressError: the address is taken or not ours.
    """
    import logging

    import uvicorn

    from service.http.app import create_app
    from service.runtime.engine import Engine

    if not settings.maps:
        raise BundleError("there is no map to serve: streetfix serve BUNDLE, or set STREETFIX_MAPS")
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(levelname)s %(name)s %(message)s")
    engine = Engine.open(settings)
    try:
        with _listen(settings.host, settings.port) as listener:
            config = uvicorn.Config(create_app(engine), log_config=None, access_log=False, lifespan="off")
            server = uvicorn.Server(config)
            # While it runs uvicorn has these handlers itself, and raises again what it got; both are harmless so.
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, server.handle_exit)
            _say_where(engine.registry, listener)
            server.run(sockets=[listener])
    finally:
        engine.close()
    typer.echo("stopped")


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except OSError as error:
        raise AddressError(
            f"cannot listen on {host}:{port} ({error.strerror}); choose another --host or --port"
        ) from error


def _say_where(registry: "MapRegistry", listener: socket.socket) -> None:
    host, port = listener.getsockname()[:2]
    for localizer in registry:
        manifest = localizer.bundle.manifest
        typer.echo(
            f"map {manifest.name} {manifest.version}: {manifest.counts.places} places, {manifest.counts.views} views"
        )
    shown = f"[{host}]" if ":" in host else host
    typer.echo(f"serving at http://{shown}:{port} (what it can do: /openapi.json; stop: Ctrl-C)")
