"""Write openapi/openapi.json, or compare it: ``python -m service.http.openapi [--check] [FILE]``."""

import json
import sys
from pathlib import Path

from service.http.app import create_app
from service.runtime.engine import Engine
from service.runtime.map_registry import MapRegistry
from service.runtime.settings import Settings

COMMITTED = Path("openapi/openapi.json")


def openapi_text() -> str:
    """Generate the OpenAPI document from the code, without maps and environment variables."""
    engine = Engine(MapRegistry(), Settings.model_construct())
    try:
        return json.dumps(create_app(engine).openapi(), indent=1, sort_keys=True) + "\n"
    finally:
        engine.close()


def main(arguments: list[str]) -> int:
    """Write the file, or check with ``--check`` whether it is up to date; return the exit code.

    Args:
        arguments: of the command line.
    """
    check = "--check" in arguments
    names = [argument for argument in arguments if argument != "--check"]
    path = Path(names[0]) if names else COMMITTED
    text = openapi_text()
    if not check:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    elif not path.exists() or path.read_text() != text:
        sys.stderr.write(f"{path} does not match the code; run: python -m service.http.openapi\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
