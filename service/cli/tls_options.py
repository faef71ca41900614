"""Options of all commands that connect to a service over TLS."""

from pathlib import Path
from typing import Annotated

import typer

Ca = Annotated[
    Path | None,
    typer.Option(
        "--ca",
        help="PEM file of the authorities that may sign the service's certificate.  "
        "[env: STREETFIX_CLIENT_CA, SSL_CERT_FILE]",
        show_default=False,
    ),
]
Cert = Annotated[
    Path | None,
    typer.Option(
        "--cert",
        help="PEM file of this client's certificate, if the service requires one.  [env: STREETFIX_CLIENT_CERT]",
        show_default=False,
    ),
]
Key = Annotated[
    Path | None,
    typer.Option(
        "--key", help="PEM file of the private key of --cert.  [env: STREETFIX_CLIENT_KEY]", show_default=False
    ),
]
