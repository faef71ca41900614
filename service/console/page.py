"""The console's built files, and what a browser may do with them."""

import gzip
import hashlib
from dataclasses import dataclass
from pathlib import Path

STATIC = Path(__file__).with_name("static")
INDEX = "index.html"

#: Nothing from another host, nothing inline, no plug-ins, no frames; pictures of the user's own and of answers are blobs.
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
    """One file; ``lasts`` where its name changes with its content."""

    content: bytes
    compressed: bytes
    media_type: str
    etag: str
    lasts: bool


def built_files(folder: Path = STATIC) -> dict[str, BuiltFile]:
    """All files by their path below the page's address; empty where nothing was built.

    They are read once: no request ever names a path of the file system.
    """
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix in _MEDIA_TYPES:
            name, content = path.relative_to(folder).as_posix(), path.read_bytes()
            found[name] = BuiltFile(
                content, gzip.compress(content, mtime=0), _MEDIA_TYPES[path.suffix],
                f'"{hashlib.sha256(content).hexdigest()[:16]}"', lasts=name != INDEX,
            )  # fmt: skip
    return found
