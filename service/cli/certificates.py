"""TLS for REST and gRPC from the PEM files of the settings. The files may be replaced while the service runs."""

import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.errors import KeysError
from service.private_key import EncryptedKeyError, refuse_password
from service.runtime.readable import why_unreadable

if TYPE_CHECKING:
    import grpc

    from service.runtime.settings import Settings


@dataclass(frozen=True, slots=True)
class _Loaded:
    """One state of the files.

    Attributes:
        context: for handshakes of REST.
        certificate: PEM chain.
        key: PEM private key.
        client_ca: PEM authorities of clients; None requires no client certificate.
    """

    context: ssl.SSLContext
    certificate: bytes
    key: bytes
    client_ca: bytes | None


class Certificates:
    """Certificate, key and client authorities. Handshakes use the state of the last successful ``reload``.

    Args:
        certificate: file of the certificate chain of the service.
        key: file of its private key.
        client_ca: file of the authorities for client certificates; None requires no client certificate.

    Raises:
        KeysError: a file cannot be read, or key and certificate do not belong together.
    """

    def __init__(self, certificate: Path, key: Path, client_ca: Path | None) -> None:
        self._certificate = certificate
        self._key = key
        self._client_ca = client_ca
        self._now = self._load()

    @classmethod
    def read(cls, settings: "Settings") -> "Certificates":
        """Read the files of the settings, before anything listens.

        Args:
            settings: of the service.

        Raises:
            KeysError: as for the class, or the settings name no files.
        """
        if settings.tls_certificate is None or settings.tls_key is None:
            raise KeysError("tls_certificate and tls_key are not set")
        return cls(settings.tls_certificate, settings.tls_key, settings.tls_client_ca)

    @property
    def paths(self) -> tuple[Path, ...]:
        """Paths of all files."""
        return tuple(path for path in (self._certificate, self._key, self._client_ca) if path is not None)

    def reload(self) -> None:
        """Read the files again for new handshakes. Open connections do not change.

        Raises:
            KeysError: the files cannot be used; the old state stays in force.
        """
        self._now = self._load()

    def for_uvicorn(self) -> dict[str, Any]:
        """Return keyword arguments for ``uvicorn.Config``."""
        return {"ssl_context_factory": lambda _config, _default: _context_of(self)}

    def for_grpc(self) -> "grpc.ServerCredentials":
        """Return the credentials for a gRPC server."""
        import grpc

        def configuration(loaded: _Loaded) -> Any:
            return grpc.ssl_server_certificate_configuration(
                [(loaded.key, loaded.certificate)], root_certificates=loaded.client_ca
            )

        given = self._now

        def newer() -> Any:
            """Return the state for the next handshake; None if it has not changed."""
            nonlocal given
            now = self._now
            if now is given:
                return None
            given = now
            return configuration(now)

        return grpc.dynamic_ssl_server_credentials(
            configuration(given), newer, require_client_authentication=self._client_ca is not None
        )

    def wrap_bio(self, *given: Any, **named: Any) -> ssl.SSLObject:
        """Begin a handshake of REST.

        Args:
            given: positional arguments of ``SSLContext.wrap_bio``.
            named: keyword arguments of ``SSLContext.wrap_bio``.
        """
        return self._now.context.wrap_bio(*given, **named)

    def _load(self) -> _Loaded:
        before = self._bytes()
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            context.load_cert_chain(self._certificate, self._key, password=refuse_password)
        except EncryptedKeyError as error:
            raise KeysError(
                f"{self._key}: the private key is encrypted; decrypt it: openssl pkey -in FILE -out PLAIN"
            ) from error
        except (OSError, ssl.SSLError) as error:
            raise KeysError(f"{self._certificate}, {self._key}: not a certificate with its key ({error})") from error
        if self._client_ca is not None:
            try:
                context.load_verify_locations(self._client_ca)
            except (OSError, ssl.SSLError) as error:
                raise KeysError(f"{self._client_ca}: not certificates of authorities ({error})") from error
            context.verify_mode = ssl.CERT_REQUIRED
        if self._bytes() != before:
            raise KeysError(
                f"{self._certificate}, {self._key}: the files changed while they were read; the service reads them "
                "again"
            )
        return _Loaded(context, before[0] or b"", before[1] or b"", before[2])

    def _bytes(self) -> tuple[bytes | None, ...]:
        found: list[bytes | None] = []
        for path in (self._certificate, self._key, self._client_ca):
            try:
                found.append(None if path is None else path.read_bytes())
            except OSError as error:
                raise KeysError(f"{path}: the PEM file cannot be read ({why_unreadable(path, error)})") from error  # type: ignore[arg-type]
        return tuple(found)


class _DelegatingContext(ssl.SSLContext):
    """Context for the asyncio server, which gets it once. Every handshake uses the certificates in force."""

    certificates: Certificates

    def wrap_bio(self, *given: Any, **named: Any) -> ssl.SSLObject:
        """Begin a handshake."""
        return self.certificates.wrap_bio(*given, **named)


def _context_of(certificates: Certificates) -> ssl.SSLContext:
    context = _DelegatingContext(ssl.PROTOCOL_TLS_SERVER)
    context.certificates = certificates
    return context
