"""TLS for both faces, from the settings' PEM files."""

import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.errors import KeysError

if TYPE_CHECKING:
    import grpc

    from service.runtime.settings import Settings


@dataclass(frozen=True, slots=True)
class Certificates:
    """PEM files that were found good.

    Attributes:
        certificate: chain of the service.
        key: its private key.
        client_ca: authorities of the clients' certificates; None asks for none.
    """

    certificate: Path
    key: Path
    client_ca: Path | None

    @classmethod
    def read(cls, settings: "Settings") -> "Certificates":
        """Check the settings' files before anything listens.

        Raises:
            KeysError: one cannot be read, or key and certificate do not belong together.
        """
        if settings.tls_certificate is None or settings.tls_key is None:
            raise KeysError("tls_certificate and tls_key are not set")
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            context.load_cert_chain(settings.tls_certificate, settings.tls_key)
        except (OSError, ssl.SSLError) as error:
            raise KeysError(
                f"{settings.tls_certificate}, {settings.tls_key}: no certificate with its key ({error})"
            ) from error
        if settings.tls_client_ca is not None:
            try:
                context.load_verify_locations(settings.tls_client_ca)
            except (OSError, ssl.SSLError) as error:
                raise KeysError(f"{settings.tls_client_ca}: no certificates of authorities ({error})") from error
        return cls(settings.tls_certificate, settings.tls_key, settings.tls_client_ca)

    def for_uvicorn(self) -> dict[str, Any]:
        """Arguments of its configuration."""
        found: dict[str, Any] = {"ssl_certfile": str(self.certificate), "ssl_keyfile": str(self.key)}
        if self.client_ca is not None:
            found |= {"ssl_ca_certs": str(self.client_ca), "ssl_cert_reqs": ssl.CERT_REQUIRED}
        return found

    def for_grpc(self) -> "grpc.ServerCredentials":
        """Credentials of its server."""
        import grpc

        pair = (self.key.read_bytes(), self.certificate.read_bytes())
        roots = None if self.client_ca is None else self.client_ca.read_bytes()
        return grpc.ssl_server_credentials([pair], root_certificates=roots, require_client_auth=roots is not None)
