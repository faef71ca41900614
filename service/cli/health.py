"""``streetfix health``: whether the service of these settings is ready; what a container's health check runs."""

import socket
import ssl
import urllib.error
import urllib.request

import typer

from service.errors import UnreachableError

_TIMEOUT_S = 2.0


def command() -> None:
    """Ask the service that STREETFIX_* describes, on this machine, whether it is ready: leaves with 0 or 1.

    Example: STREETFIX_PORT=8000 streetfix health
    """
    from service.runtime.settings import load_settings

    settings = load_settings(insecure_public=True)  # what is asked here is not what is served
    if settings.health_port is not None:
        _ask(f"http://{_address(settings.health_host or settings.host)}:{settings.health_port}/readyz", None)
        return
    address = _address(settings.host)
    if settings.tls_client_ca is not None:  # it would ask for a certificate: that it listens must do
        try:
            socket.create_connection((address.strip("[]"), settings.port), timeout=_TIMEOUT_S).close()
        except OSError as error:
            raise UnreachableError(f"nothing listens on port {settings.port} ({error})") from error
        return
    scheme = "http" if settings.tls_certificate is None else "https"
    context = None
    if scheme == "https":  # its own certificate names the outside, not loopback
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    _ask(f"{scheme}://{address}:{settings.port}/readyz", context)


def _ask(url: str, context: ssl.SSLContext | None) -> None:
    try:
        urllib.request.urlopen(url, timeout=_TIMEOUT_S, context=context).close()  # noqa: S310  # of our own making
    except (OSError, urllib.error.URLError) as error:
        raise UnreachableError(f"{url}: not ready ({error})") from error
    typer.echo("ready")


def _address(host: str) -> str:
    """Where a service that listens on a host is reached from this machine, as in a URL."""
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104  # a question, nothing is bound
    return f"[{host}]" if ":" in host else host
