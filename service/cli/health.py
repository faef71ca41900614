"""``streetfix health``: check whether the service of these settings is ready. The health check of the container runs it."""

import socket
import ssl
import urllib.error
import urllib.request

import typer

from service.cli.tls_options import Ca, Cert, Key
from service.errors import UnreachableError

_TIMEOUT_S = 2.0


def command(ca: Ca = None, cert: Cert = None, key: Key = None) -> None:
    """Check whether the service on this machine is ready.

    The variables STREETFIX_* describe the service. The exit code is 0 if the service is ready, otherwise 1.

    Without --ca the command accepts any certificate, because the service is on this machine. A service that requires
    client certificates needs --cert and --key. Without them the command only checks that the service listens.

    \b
    Example:
      STREETFIX_PORT=8000 streetfix health
    """
    from service.client.tls import ClientTls
    from service.runtime.settings import load_settings

    settings = load_settings(insecure_public=True)  # this command serves nothing, so it needs no protection
    if settings.health_port is not None:
        _ask(f"http://{_address(settings.health_host or settings.host)}:{settings.health_port}/readyz", None)
        return
    tls = ClientTls.of(ca, cert, key)
    address = _address(settings.host)
    if (
        settings.tls_client_ca is not None and tls.cert is None
    ):  # without a certificate it can only check that the service listens
        try:
            socket.create_connection((address.strip("[]"), settings.port), timeout=_TIMEOUT_S).close()
        except OSError as error:
            raise UnreachableError(f"nothing listens on port {settings.port} ({error})") from error
        return
    scheme = "http" if settings.tls_certificate is None else "https"
    context = None
    if scheme == "https":  # the certificate names the public host, not loopback
        context = tls.context()
        context.check_hostname = False
        if not tls.is_wanted or tls.ca is None:
            context.verify_mode = ssl.CERT_NONE
    _ask(f"{scheme}://{address}:{settings.port}/readyz", context)


def _ask(url: str, context: ssl.SSLContext | None) -> None:
    try:
        urllib.request.urlopen(url, timeout=_TIMEOUT_S, context=context).close()  # noqa: S310  # of our own making
    except (OSError, urllib.error.URLError) as error:
        raise UnreachableError(f"{url}: not ready ({error})") from error
    typer.echo("ready")


def _address(host: str) -> str:
    """Address in a URL by which this machine reaches a service that listens on a host."""
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104  # a question, nothing is bound
    return f"[{host}]" if ":" in host else host
