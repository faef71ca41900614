"""The built files of the console, and their HTTP headers."""

import gzip
import hashlib
from dataclasses import dataclass
from pathlib import Path

STATIC = Path(__file__).with_name("static")
INDEX = "index.html"

#: No other host, no inline code, no plug-ins, no frames. Images of queries and answers are blobs.
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; font-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}
_MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}


@dataclass(frozen=True, slots=True)
class BuiltFile:
    """One built file. ``lasts`` says that its name changes with its content, so browsers may cache it."""

    content: bytes
    compressed: bytes
    media_type: str
    etag: str
    lasts: bool


def built_files(folder: Path = STATIC) -> dict[str, BuiltFile]:
    """Return all built files by their path below the page's address; empty without a build.

    Files are read once, so no request can name a path of the file system.

    Args:
        folder: folder of the built page.
    """
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix in _MEDIA_TYPES:
            name, content = path.relative_to(folder).as_posix(), path.read_bytes()
            found[name] = BuiltFile(
                content,
                gzip.compress(content, mtime=0),
                _MEDIA_TYPES[path.suffix],
                f'"{hashlib.sha256(content).hexdigest()[:16]}"',
                lasts=name != INDEX,
            )
    return found
