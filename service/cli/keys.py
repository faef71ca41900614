"""``streetfix keys``: a new API key, and the line that lets it in."""

import re
from typing import Annotated

import typer

from service.errors import RequestError


def command(
    name: Annotated[str, typer.Argument(help="Who will use it: letters, digits, '.', '_' and '-'.")],
    operator: Annotated[
        bool, typer.Option(help="May also change what the service does: which version of a map serves.")
    ] = False,
) -> None:
    """Make an API key: the key on stderr, for its user; its line for the service's file on stdout.

    The file holds a hash; the key is shown this once and kept nowhere.

    Example: streetfix keys robot-7 >> keys.txt && STREETFIX_API_KEYS=keys.txt streetfix serve maps/paper-city
    """
    from service.runtime.keys import hash_of, new_key

    if not re.fullmatch(r"[A-Za-z0-9._-]{1,64}", name):
        raise RequestError(f"the name {name!r} is not 1 to 64 letters, digits, '.', '_' or '-'", field="name")
    key = new_key()
    typer.echo(f"key of {name}, shown once: {key}", err=True)
    typer.echo(f"{name} {hash_of(key)}" + (" operator" if operator else ""))
