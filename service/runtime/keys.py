"""API keys of the callers. The file holds names and hashes, never a key."""

import hashlib
import hmac
import re
import secrets
from dataclasses import dataclass
from pathlib import Path

from service.errors import KeysError, UnauthorizedError
from service.runtime.readable import why_unreadable

_NAME = re.compile(r"[A-Za-z0-9._-]{1,64}")
_HASH = re.compile(r"[0-9a-f]{64}")
_MOST_BYTES, _MOST_KEY = 2**20, 512


@dataclass(frozen=True, slots=True)
class Caller:
    """A caller of the service.

    Attributes:
        name: in the file of keys.
        operator: may change the behaviour of the service, such as the serving version of a map.
    """

    name: str
    operator: bool = False


@dataclass(slots=True)
class KeyRing:
    """Callers by the SHA-256 of their keys.

    A key has 256 random bits. So an attacker cannot guess keys, and a fast hash is enough. A slow hash would only delay every request.

    Attributes:
        caller_of: callers by hash. ``reload`` replaces it atomically, so a request sees either all old or all new callers.
        path: file of the keys; None if they came from elsewhere.
    """

    caller_of: dict[str, Caller]
    path: Path | None = None

    @classmethod
    def open(cls, path: Path) -> "KeyRing":
        """Read a file with one line ``NAME SHA256`` or ``NAME SHA256 operator`` per caller; ``#`` begins a comment.

        Args:
            path: of the file.

        Raises:
            KeysError: the file is missing, unreadable, too large or empty; or a line is invalid or repeats a name or a key.
        """
        try:
            with path.open("rb") as file:
                content = file.read(_MOST_BYTES + 1)
            text = content.decode("utf-8")
        except OSError as error:
            raise KeysError(
                f"{path}: the key file cannot be read ({why_unreadable(path, error)}); streetfix keys creates its lines"
            ) from error
        except UnicodeDecodeError as error:
            raise KeysError(f"{path}: not a key file ({error}); streetfix keys creates its lines") from error
        if len(content) > _MOST_BYTES:
            raise KeysError(f"{path}: the key file exceeds {_MOST_BYTES // 2**20} MiB; remove unused keys")
        found: dict[str, Caller] = {}
        for number, line in enumerate(text.splitlines(), 1):
            words = line.split("#", 1)[0].split()
            if not words:
                continue
            right = words[2:] in ([], ["operator"]) and len(words) > 1
            if not right or not _NAME.fullmatch(words[0]) or not _HASH.fullmatch(words[1]):
                raise KeysError(
                    f"{path}: line {number} is not NAME SHA256 (64 hexadecimal digits); create it with streetfix keys"
                )
            if words[1] in found or words[0] in [caller.name for caller in found.values()]:
                raise KeysError(
                    f"{path}: line {number} repeats the name or the key of an earlier line; keep one of them"
                )
            found[words[1]] = Caller(words[0], operator=len(words) == 3)
        if not found:
            raise KeysError(f"{path}: the key file is empty; add a key with streetfix keys NAME >> {path}")
        return cls(found, path)

    def reload(self) -> None:
        """Read the file again.

        Raises:
            KeysError: the file cannot be used; the old keys stay in force.
        """
        if self.path is not None:
            self.caller_of = KeyRing.open(self.path).caller_of

    def require(self, presented: str | None) -> Caller:
        """Return the caller of a key.

        Args:
            presented: key of the request; None if it has none.

        Raises:
            UnauthorizedError: there is no key, or it is unknown.
        """
        if not presented:
            raise UnauthorizedError(
                "this service requires an API key; send it as Authorization: Bearer KEY, or as X-Api-Key"
            )
        digest = hash_of(presented[:_MOST_KEY])
        for known, caller in self.caller_of.items():
            if hmac.compare_digest(known, digest):
                return caller
        raise UnauthorizedError("the API key is unknown to this service; request one from its operator")


def presented_key(authorization: str | None, api_key: str | None) -> str | None:
    """Return the key from the headers of a request; None if there is none.

    Args:
        authorization: value of ``Authorization``; a ``Bearer`` token takes precedence.
        api_key: value of ``X-Api-Key``.
    """
    scheme, _, value = (authorization or "").partition(" ")
    if scheme.lower() == "bearer" and value.strip():
        return value.strip()
    return api_key or None


def new_key() -> str:
    """Generate a key of 256 random bits, as text."""
    return "sf_" + secrets.token_urlsafe(32)


def hash_of(key: str) -> str:
    """Hash a key as in the file of keys.

    Args:
        key: as text.
    """
    return hashlib.sha256(key.encode("utf-8", "replace")).hexdigest()
