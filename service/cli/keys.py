"""``streetfix keys``: create an API key and its line for the file of keys."""

import re
from typing import Annotated

import typer

from service.errors import RequestError


def command(
    name: Annotated[str, typer.Argument(help="Name of the user: letters, digits, '.', '_' and '-'.")],
    operator: Annotated[
        bool, typer.Option(help="The key may also change the service: which version of a map serves.")
    ] = False,
) -> None:
    """Make an API key and its line for the service's file.

    The command prints the key on stderr, for its user. It prints the line on stdout. The line holds a hash.
    The command shows the key only once and stores it nowhere.

    \b
    Example:
      streetfix keys robot-7 >> keys.txt && STREETFIX_API_KEYS=keys.txt streetfix serve maps/paper-city
    """
    from service.runtime.keys import hash_of, new_key

    if not re.fullmatch(r"[A-Za-z0-9._-]{1,64}", name):
        raise RequestError(f"the name {name!r} is not 1 to 64 letters, digits, '.', '_' or '-'", field="name")
    key = new_key()
    typer.echo(f"key of {name}, shown once: {key}", err=True)
    typer.echo(f"{name} {hash_of(key)}" + (" operator" if operator else ""))
