"""Check that the committed page was built from the sources, without Node: ``python -m service.console.built [--check]``."""

import hashlib
import json
import sys
from pathlib import Path

from service.console.page import STATIC

WEB = STATIC.with_name("web")
NOTE = STATIC.with_name("built.json")
#: Inputs of a build. ``package-lock.json`` has the hash of every package.
_SOURCES = ("index.html", "package.json", "package-lock.json", "tsconfig.json", "vite.config.ts", "src/**/*")


def note_of(web: Path = WEB, static: Path = STATIC) -> dict[str, object]:
    """Return one hash of all sources, and one of each built file.

    Args:
        web: folder of the sources.
        static: folder of the built page.
    """
    sources = sorted({path for pattern in _SOURCES for path in web.glob(pattern) if path.is_file()})
    together = hashlib.sha256()
    for path in sources:
        together.update(f"{path.relative_to(web).as_posix()} {_sha256(path)}\n".encode())
    files = sorted(path for path in static.rglob("*") if path.is_file())
    return {
        "sources": together.hexdigest(),
        "files": {path.relative_to(static).as_posix(): _sha256(path) for path in files},
    }


def main(arguments: list[str]) -> int:
    """Write ``built.json`` after a build, or compare with it (``--check``). Return the exit code."""
    if "--check" not in arguments:
        NOTE.write_text(json.dumps(note_of(), indent=1) + "\n")
        return 0
    if not NOTE.exists() or json.loads(NOTE.read_text()) != note_of():
        sys.stderr.write("service/console/static was not built from service/console/web; run: make console\n")
        return 1
    return 0


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
