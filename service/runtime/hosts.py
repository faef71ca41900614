"""Allow-list of host names: checks the ``Host`` of a request, and the ``Origin`` of a request that changes something.

This protects against DNS rebinding: an attacker points the name of a web page to this machine. For a browser the page then has the
same origin as the service. Only the name in ``Host`` reveals the attack. An address cannot be rebound; an unknown name can.
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
    """Return a host pattern in lower case.

    Args:
        value: a name, ``*.name`` or ``*``. An IP address is accepted too; addresses are always allowed.

    Raises:
        ValueError: the value has a scheme, a port or a path, or is no name.
    """
    value = value.lower().rstrip(".")
    if _PATTERN.fullmatch(value) or _is_address(value.strip("[]")):
        return value
    raise ValueError(
        f"{value!r} is no host name; write names without scheme and port, as maps.example.org or *.example.org"
    )


@dataclass(frozen=True, slots=True)
class Authority:
    """Host and port of a ``Host`` header or an origin.

    Attributes:
        host: name or address, lower case, without brackets.
        port: digits; empty if none is given.
    """

    host: str
    port: str

    @classmethod
    def read(cls, text: str) -> "Authority | None":
        """Parse ``name:port``; None if the text is not valid.

        Args:
            text: value of the header.
        """
        found = _AUTHORITY.fullmatch(text.lower())
        if found is None:
            return None
        return cls(found["host"].strip("[]").rstrip("."), found["port"] or "")


@dataclass(frozen=True, slots=True)
class AllowedHosts:
    """Host names that a service accepts.

    Attributes:
        names: listed by the operator; exact names, or ``*.name`` for all names below.
        own: name that the service listens on; empty if it is an address.
        any_name: accept every name.
    """

    names: tuple[str, ...]
    own: str
    any_name: bool

    @classmethod
    def of(cls, settings: "Settings") -> "AllowedHosts":
        """Take the names of the settings.

        Without listed names every name is allowed if all requests need a key or a client certificate. Rebinding then gains nothing:
        a page in a browser has no key, and TLS with the name of an attacker fails. The service cannot know its own public names.

        Args:
            settings: of the service.
        """
        guarded = settings.api_keys is not None or settings.tls_client_ca is not None
        own = "" if _is_address(settings.host) else settings.host.lower().rstrip(".")
        listed = tuple(each for each in settings.allowed_hosts if each != _ANY)
        return cls(listed, own, _ANY in settings.allowed_hosts or (guarded and not settings.allowed_hosts))

    def allows(self, host: str) -> bool:
        """Return whether a ``Host`` header names this service: an address, a loopback name, or an allowed name.

        Args:
            host: value of the header.
        """
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
        """Return whether a page may change something: its origin is the service itself or a listed name.

        Args:
            origin: value of the header ``Origin``; ``null`` is refused.
            host: value of the header ``Host`` of the same request.
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
