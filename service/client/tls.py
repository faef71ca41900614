"""TLS of a client: trusted authorities, client certificate and explanations of a failed handshake."""

import os
import ssl
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import httpx

from service.errors import HandshakeError, KeysError, RequestError
from service.private_key import EncryptedKeyError, refuse_password

#: Environment variables that replace missing arguments. The service ignores names with the prefix STREETFIX_CLIENT_.
CA, CERT, KEY = "STREETFIX_CLIENT_CA", "STREETFIX_CLIENT_CERT", "STREETFIX_CLIENT_KEY"
#: OpenSSL's own variables. They apply only if no authority is given.
_CERT_FILE, _CERT_DIR = "SSL_CERT_FILE", "SSL_CERT_DIR"


@dataclass(frozen=True, slots=True)
class TlsFile:
    """A PEM file.

    Attributes:
        path: path of the file.
        named_by: argument or environment variable that gave the path, for messages.
    """

    path: Path
    named_by: str

    def read(self) -> bytes:
        """Return the content of the file.

        Raises:
            KeysError: the file cannot be read.
        """
        try:
            return self.path.read_bytes()
        except OSError as error:
            raise self.unusable(f"cannot be read ({error.strerror})", "check the path and the permissions") from error

    def unusable(self, why: str, remedy: str) -> KeysError:
        """Return the error for a file that cannot be used.

        Args:
            why: what is wrong with the file.
            remedy: what the user should do.
        """
        return KeysError(f"{self.path}: {why}; {remedy} ({self.named_by})", field=self.named_by)


@dataclass(frozen=True, slots=True)
class ClientTls:
    """TLS settings of a client.

    Attributes:
        ca: PEM file of the only authorities that may have signed the service's certificate. None trusts ``ca_folder``, or else
            the public authorities.
        cert: PEM chain of the client's certificate, for mutual TLS. None sends no certificate.
        key: unencrypted PEM private key of ``cert``.
        ca_folder: folder of authorities from ``SSL_CERT_DIR``. It is used only over HTTP and only if ``ca`` is None.
    """

    ca: TlsFile | None = None
    cert: TlsFile | None = None
    key: TlsFile | None = None
    ca_folder: Path | None = None

    @classmethod
    def of(
        cls,
        ca: str | Path | None = None,
        cert: str | Path | None = None,
        key: str | Path | None = None,
        *,
        environ: Mapping[str, str] | None = None,
    ) -> Self:
        """Read the settings from the arguments, and from the environment for each argument that is None.

        ``STREETFIX_CLIENT_CA``, ``STREETFIX_CLIENT_CERT`` and ``STREETFIX_CLIENT_KEY`` replace missing arguments. If neither
        ``ca`` nor its variable is given, ``SSL_CERT_FILE`` and then ``SSL_CERT_DIR`` name the authorities.

        Args:
            ca: PEM file of the trusted authorities.
            cert: PEM chain of the client's certificate.
            key: unencrypted PEM private key of ``cert``.
            environ: environment variables. None reads those of the process.

        Raises:
            RequestError: only one of certificate and key is given.
        """
        known = os.environ if environ is None else environ

        def named(given: str | Path | None, argument: str, *variables: str) -> TlsFile | None:
            if given is not None:
                return TlsFile(Path(given), argument)
            found = next((name for name in variables if known.get(name)), None)
            return None if found is None else TlsFile(Path(known[found]), found)

        shown, secret = named(cert, "cert", CERT), named(key, "key", KEY)
        if (shown is None) != (secret is None):
            given, missing = ("cert", "key") if secret is None else ("key", "cert")
            raise RequestError(
                f"{missing}: a client certificate and its private key belong together, but only {given} is given; pass --{missing}, "
                f"{missing}= or {KEY if missing == 'key' else CERT} as well",
                field=missing,
            )
        folder = known.get(_CERT_DIR)
        return cls(named(ca, "ca", CA, _CERT_FILE), shown, secret, Path(folder) if folder else None)

    @property
    def is_wanted(self) -> bool:
        """Whether an argument or a variable ``STREETFIX_CLIENT_*`` requests TLS.

        ``SSL_CERT_FILE`` does not count, because it applies to all programs of the machine.
        """
        return self.cert is not None or (self.ca is not None and self.ca.named_by != _CERT_FILE)

    @property
    def is_argument(self) -> bool:
        """Whether an argument requests TLS."""
        return any(
            each is not None and each.named_by in ("ca", "cert", "key") for each in (self.ca, self.cert, self.key)
        )

    def context(self) -> ssl.SSLContext:
        """Return a context for Python's ``ssl`` module.

        Raises:
            KeysError: a file cannot be read or used. The message names the file and the remedy.
        """
        if self.ca is not None:
            context = ssl.create_default_context(cadata=_authorities(self.ca))
        elif self.ca_folder is not None:
            context = ssl.create_default_context(capath=str(self.ca_folder))
        else:
            context = httpx.create_ssl_context(trust_env=False)
        if self.cert is not None and self.key is not None:
            for file in (self.cert, self.key):  # OpenSSL does not report which file is unreadable
                file.read()
            try:
                context.load_cert_chain(self.cert.path, self.key.path, password=refuse_password)
            except EncryptedKeyError as error:
                raise self.key.unusable(
                    "the private key is encrypted", "decrypt it: openssl pkey -in FILE -out PLAIN"
                ) from error
            except (ssl.SSLError, ValueError) as error:
                raise self.cert.unusable(
                    f"not a PEM certificate that matches the private key {self.key.path}",
                    "pass the chain with the client certificate first, and the key that belongs to it",
                ) from error
        return context

    def pems(self) -> tuple[bytes | None, bytes | None, bytes | None]:
        """Return authorities, private key and certificate chain for ``grpc.ssl_channel_credentials``.

        ``ca_folder`` is ignored, because gRPC takes no folder of authorities.

        Raises:
            KeysError: as ``context``.
        """
        self.context()  # checks the files: gRPC would report a bad file as an unreachable service
        return tuple(None if each is None else each.read() for each in (self.ca, self.key, self.cert))  # type: ignore[return-value]


def _authorities(file: TlsFile) -> str:
    """Return the text of a PEM file after checking that it has certificates.

    Raises:
        KeysError: the file has no certificate or cannot be read.
    """
    remedy = "pass the certificate of the authority as PEM, which begins with -----BEGIN CERTIFICATE-----"
    try:
        text = file.read().decode("ascii", errors="ignore")
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(cadata=text)
    except (ssl.SSLError, ValueError) as error:
        raise file.unusable("the file has no certificate", remedy) from error
    return text


def handshake_error(address: str, reason: str) -> HandshakeError | None:
    """Return the error for a failed handshake, or None if the reason does not concern TLS.

    Args:
        address: address of the service.
        reason: message of OpenSSL or gRPC.
    """
    folded = reason.lower()
    for words, remedy in _REMEDIES:
        if any(word in folded for word in words):
            return HandshakeError(f"{address}: TLS failed ({reason}); {remedy}", field="url")
    return None


#: Parts of messages of OpenSSL (REST) and BoringSSL (gRPC), and the remedy. The first match applies.
_REMEDIES = (
    (
        ("wrong_version_number", "wrong version number", "record layer failure"),
        "the server does not use TLS on this port: check the port, or connect without TLS (http://)",
    ),
    (
        (
            "hostname mismatch",
            "ip address mismatch",
            "hostname verification",
            "is not valid for",
            "is not in peer certificate",
        ),
        "the certificate is for another name: connect by a name in the certificate, or add this name to the certificate",
    ),
    (
        ("certificate has expired", "not yet valid"),
        "the certificate is not valid now: renew it, and check the clocks of both machines",
    ),
    (
        ("certificate_verify_failed", "certificate verify failed"),
        f"no trusted authority has signed the certificate: pass the certificate of its authority with --ca, ca= or {CA}",
    ),
    (
        ("certificate_required", "certificate required", "peer_did_not_return"),
        f"the service requires a client certificate: pass --cert and --key, cert= and key=, or {CERT} and {KEY}",
    ),
    (
        ("alert_unknown_ca", "alert unknown ca", "alert_bad_certificate", "alert bad certificate", "alert_certificate"),
        "the service does not accept the client certificate: pass one that its authority (STREETFIX_TLS_CLIENT_CA) has signed",
    ),
    (
        ("ssl_error_ssl", "tls handshake", "ssl handshake", "[ssl"),
        "check the address, and the TLS settings of both sides",
    ),
)


def closed_hint(*, speaks_tls: bool, shows_certificate: bool) -> str:
    """Return the likely reason for a connection that the service closed without a message.

    Since TLS 1.3 a client learns of a refused certificate only after its own part of the handshake.

    Args:
        speaks_tls: True if the client uses TLS.
        shows_certificate: True if the client has a certificate.
    """
    if not speaks_tls:
        return "if the service uses TLS, use https://, or --ca, ca= over gRPC"
    if not shows_certificate:
        return (
            f"if the service requires a client certificate, pass --cert and --key, cert= and key=, or {CERT} and {KEY}"
        )
    return (
        "the service may not accept the client certificate: its authority (STREETFIX_TLS_CLIENT_CA) must have signed it"
    )


def ssl_reason(error: BaseException) -> str | None:
    """Return OpenSSL's message from an error or its causes, or None if there is none.

    Args:
        error: the error.
    """
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, ssl.SSLError):
            return str(seen)
        seen = seen.__cause__ or seen.__context__
    return None
