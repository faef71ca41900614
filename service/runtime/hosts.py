"""By which names a service may be asked: the ``Host`` of a request, and the ``Origin`` of what would change something.

A web page whose name an attacker lets point to this machine (DNS rebinding) is, to a browser, of the same origin as the service.
Only the name in ``Host`` tells: an address cannot be rebound, a name that we do not know can.
"""

import re
from dataclasses import dataclass
from ipaddress import ip_address
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from service.runtime.settings import Settings

_LABEL = r"[a-z0-9_]([a-z0-9_-]{0,61}[a-z0-9_])?"
_PATTERN = re.compile(rf"\*|(\*\.)?{_LABEL}(\.{_LABEL})*")
_AUTHORITY = re.compile(r"(?P<host>\[[0-9a-f:.]+\]|[^\[\]:@/?#\\]+)(:(?P<port>[0-9]{1,5}))?")
_DEFAULT_PORTS = {"http": "80", "https": "443"}
_ANY = "*"


def require_host_pattern(value: str) -> str:
    """A name, ``*.name`` or ``*``, in lower case; also an address, which is always allowed.

    Raises:
        ValueError: it has a scheme, a port or a path, or is no name.
    """
    value = value.lower().rstrip(".")
    if _PATTERN.fullmatch(value) or _is_address(value.strip("[]")):
        return value
    raise ValueError(
        f"{value!r} is no host name; write names without scheme and port, as maps.example.org or *.example.org"
    )


@dataclass(frozen=True, slots=True)
class Authority:
    """Host and port of a ``Host`` header or an origin; the port is empty where none is written."""

    host: str
    port: str

    @classmethod
    def read(cls, text: str) -> "Authority | None":
        """From ``name:port``; None where it is none."""
        found = _AUTHORITY.fullmatch(text.lower())
        if found is None:
            return None
        return cls(found["host"].strip("[]").rstrip("."), found["port"] or "")


@dataclass(frozen=True, slots=True)
class AllowedHosts:
    """Names by which a service may be asked.

    Attributes:
        names: that the operator listed: exact ones, and ``*.`` before those that stand for all below.
        own: name that the service listens on; empty where it is an address.
        any_name: every name is allowed.
    """

    names: tuple[str, ...]
    own: str
    any_name: bool

    @classmethod
    def of(cls, settings: "Settings") -> "AllowedHosts":
        """Those of the settings; any name where none is listed and every request must show a key or a certificate.

        A page in a browser has no key, and TLS with a name of an attacker's fails, so rebinding gains nothing there. The names of
        a service that is reached by others are not known to it.
        """
        guarded = settings.api_keys is not None or settings.tls_client_ca is not None
        own = "" if _is_address(settings.host) else settings.host.lower().rstrip(".")
        listed = tuple(each for each in settings.allowed_hosts if each != _ANY)
        return cls(listed, own, _ANY in settings.allowed_hosts or (guarded and not settings.allowed_hosts))

    def allows(self, host: str) -> bool:
        """Whether a ``Host`` header names this service: an address, a loopback name, or one of the names."""
        authority = Authority.read(host)
        if authority is None:
            return False
        return (
            self.any_name
            or _is_address(authority.host)
            or _is_loopback(authority.host)
            or authority.host == self.own
            or self._lists(authority.host)
        )

    def allows_origin(self, origin: str, host: str) -> bool:
        """Whether a page of an origin may change something: it is the service's own, or of a listed name.

        Args:
            origin: as a browser sends it; ``null`` is nobody's.
            host: the request's ``Host``.
        """
        scheme, _, rest = origin.partition("://")
        asked, own = Authority.read(rest), Authority.read(host)
        if scheme.lower() not in _DEFAULT_PORTS or asked is None or own is None:
            return False
        default = _DEFAULT_PORTS[scheme.lower()]
        same = asked.host == own.host and (asked.port or default) == (own.port or default)
        return same or self._lists(asked.host)

    def _lists(self, name: str) -> bool:
        return any(name.endswith(each[1:]) if each.startswith("*.") else name == each for each in self.names)


def _is_loopback(name: str) -> bool:
    return name == "localhost" or name.endswith(".localhost")


def _is_address(text: str) -> bool:
    try:
        ip_address(text)
    except ValueError:
        return False
    return True
