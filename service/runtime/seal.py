"""Seal bytes that a client carries between requests, so that the service can trust them when they come back."""

import hashlib
import hmac
import secrets

_MAC_BYTES = 32
#: Least length of a key, characters. 32 random characters resist guessing.
LEAST_KEY = 32


class Seal:
    """HMAC-SHA256 over bytes. It protects against changes; it hides nothing.

    Args:
        key: secret of all processes that share the bytes; None draws one, which no other process knows.
    """

    def __init__(self, key: str | None = None) -> None:
        self._key = (key or secrets.token_hex(LEAST_KEY)).encode("utf-8", "surrogateescape")

    def sealed(self, content: bytes) -> bytes:
        """Return the bytes behind their code.

        Args:
            content: any bytes.
        """
        return self._code(content) + content

    def opened(self, sealed: bytes) -> bytes | None:
        """Return the bytes of ``sealed``; None if they were changed, or sealed with another key.

        Args:
            sealed: as received.
        """
        code, content = sealed[:_MAC_BYTES], sealed[_MAC_BYTES:]
        return content if hmac.compare_digest(code, self._code(content)) else None

    def _code(self, content: bytes) -> bytes:
        return hmac.new(self._key, content, hashlib.sha256).digest()
