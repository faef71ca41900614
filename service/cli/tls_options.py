"""The options of all commands that talk to a service over TLS."""

from pathlib import Path
from typing import Annotated

import typer

Ca = Annotated[
    Path | None,
    typer.Option(
        "--ca",
        help="PEM of the authorities that may have signed the service's certificate [env: STREETFIX_CLIENT_CA, SSL_CERT_FILE].",
        show_default=False,
    ),
]
Cert = Annotated[
    Path | None,
    typer.Option(
        "--cert",
        help="PEM of this client's certificate, where the service asks for one [env: STREETFIX_CLIENT_CERT].",
        show_default=False,
    ),
]
Key = Annotated[
    Path | None,
    typer.Option(
        "--key", help="PEM of that certificate's private key [env: STREETFIX_CLIENT_KEY].", show_default=False
    ),
]
