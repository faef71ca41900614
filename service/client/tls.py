"""TLS of a client: which authorities it trusts, which certificate it shows, and what a failed handshake means."""

import os
import ssl
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import httpx

from service.errors import HandshakeError, KeysError, RequestError

#: Variables that stand in for arguments that were not given. The service ignores all names that begin so.
CA, CERT, KEY = "STREETFIX_CLIENT_CA", "STREETFIX_CLIENT_CERT", "STREETFIX_CLIENT_KEY"
#: The usual variables of OpenSSL; they only matter where no authority is given.
_CERT_FILE, _CERT_DIR = "SSL_CERT_FILE", "SSL_CERT_DIR"


@dataclass(frozen=True, slots=True)
class TlsFile:
    """A PEM file and who named it, for messages."""

    path: Path
    named_by: str

    def read(self) -> bytes:
        """Its bytes.

        Raises:
            KeysError: it cannot be read.
        """
        try:
            return self.path.read_bytes()
        except OSError as error:
            raise self.unusable(
                f"it cannot be read ({error.strerror})", "check the path and who may read it"
            ) from error

    def unusable(self, why: str, remedy: str) -> KeysError:
        """The error for a file that cannot be used."""
        return KeysError(f"{self.path}: {why}; {remedy} ({self.named_by})", field=self.named_by)


@dataclass(frozen=True, slots=True)
class ClientTls:
    """What a client brings to a handshake.

    Attributes:
        ca: PEM of the authorities that may have signed the service's certificate, and nobody else's; None trusts the public ones.
        cert: PEM chain that the client shows where the service asks for one (mutual TLS); None shows nothing.
        key: PEM private key of ``cert``, not encrypted.
        ca_folder: of authorities, where ``SSL_CERT_DIR`` alone names some.
    """

    ca: TlsFile | None = None
    cert: TlsFile | None = None
    key: TlsFile | None = None
    ca_folder: Path | None = None

    @classmethod
    def of(
        cls, ca: str | Path | None = None, cert: str | Path | None = None, key: str | Path | None = None, *,
        environ: Mapping[str, str] | None = None,
    ) -> Self:  # fmt: skip
        """From arguments, or where they are None from the environment.

        ``STREETFIX_CLIENT_CA``, ``STREETFIX_CLIENT_CERT`` and ``STREETFIX_CLIENT_KEY`` stand in for the arguments. Without any of
        the two for ``ca``, ``SSL_CERT_FILE`` and then ``SSL_CERT_DIR`` name the authorities.

        Raises:
            RequestError: a certificate without its key, or a key without its certificate.
        """
        known = os.environ if environ is None else environ

        def named(given: str | Path | None, argument: str, *variables: str) -> TlsFile | None:
            if given is not None:
                return TlsFile(Path(given), argument)
            found = next((name for name in variables if known.get(name)), None)
            return None if found is None else TlsFile(Path(known[found]), found)

        shown, secret = named(cert, "cert", CERT), named(key, "key", KEY)
        if (shown is None) != (secret is None):
            there, missing = ("cert", "key") if secret is None else ("key", "cert")
            raise RequestError(
                f"{missing}: a client's certificate and its private key go together, and only {there} is given; give --{missing}, "
                f"{missing}= or {KEY if missing == 'key' else CERT} as well", field=missing,
            )  # fmt: skip
        folder = known.get(_CERT_DIR)
        return cls(named(ca, "ca", CA, _CERT_FILE), shown, secret, Path(folder) if folder else None)

    @property
    def is_wanted(self) -> bool:
        """Whether an argument or a variable of ours asks for TLS; ``SSL_CERT_FILE`` is for all programs of the machine."""
        return self.cert is not None or (self.ca is not None and self.ca.named_by != _CERT_FILE)

    @property
    def is_argument(self) -> bool:
        """Whether an argument asks for TLS."""
        return any(
            each is not None and each.named_by in ("ca", "cert", "key") for each in (self.ca, self.cert, self.key)
        )

    def context(self) -> ssl.SSLContext:
        """For Python's own TLS.

        Raises:
            KeysError: a file cannot be read or is none; it names the file and the remedy.
        """
        if self.ca is not None:
            context = ssl.create_default_context(cadata=_authorities(self.ca))
        elif self.ca_folder is not None:
            context = ssl.create_default_context(capath=str(self.ca_folder))
        else:
            context = httpx.create_ssl_context(trust_env=False)
        if self.cert is not None and self.key is not None:
            for file in (self.cert, self.key):  # OpenSSL does not say which of the two it cannot read
                file.read()
            try:
                context.load_cert_chain(self.cert.path, self.key.path, password=refuse_password)
            except EncryptedKeyError as error:
                raise self.key.unusable(
                    "the private key is encrypted", "decrypt it: openssl pkey -in FILE -out PLAIN"
                ) from error
            except (ssl.SSLError, ValueError) as error:
                raise self.cert.unusable(
                    f"this is no certificate in PEM with its private key {self.key.path}",
                    "give the chain with the client's own certificate first, and the key that belongs to it",
                ) from error
        return context

    def pems(self) -> tuple[bytes | None, bytes | None, bytes | None]:
        """Authorities, private key and certificate chain as ``grpc.ssl_channel_credentials`` takes them.

        Raises:
            KeysError: as ``context``.
        """
        self.context()  # gRPC would say of a bad file that the service is not there
        return tuple(None if each is None else each.read() for each in (self.ca, self.key, self.cert))  # type: ignore[return-value]


class EncryptedKeyError(Exception):
    """OpenSSL wants a password."""


def refuse_password() -> str:
    """Without it OpenSSL would ask at the terminal."""
    raise EncryptedKeyError


def _authorities(file: TlsFile) -> str:
    """A file's certificates, checked.

    Raises:
        KeysError: it has none.
    """
    remedy = "give the authority's certificate in PEM, which begins with -----BEGIN CERTIFICATE-----"
    try:
        text = file.read().decode("ascii", errors="ignore")
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(cadata=text)
    except (ssl.SSLError, ValueError) as error:
        raise file.unusable("there is no certificate in it", remedy) from error
    return text


def handshake_error(address: str, reason: str) -> HandshakeError | None:
    """The error for a handshake that failed; None where the reason is not one of TLS.

    Args:
        address: of the service.
        reason: as OpenSSL or gRPC says it.
    """
    folded = reason.lower()
    for words, remedy in _REMEDIES:
        if any(word in folded for word in words):
            return HandshakeError(f"{address}: TLS failed ({reason}); {remedy}", field="url")
    return None


#: What OpenSSL (REST) and BoringSSL (gRPC) say, and what to check; the first that fits.
_REMEDIES = (
    (("wrong_version_number", "wrong version number", "record layer failure"),
     "what listens there does not speak TLS: check the port, or ask without TLS (http://)"),
    (("hostname mismatch", "ip address mismatch", "hostname verification", "is not valid for", "is not in peer certificate"),
     "its certificate is for another name: ask by a name that is in the certificate, or have this name added to it"),
    (("certificate has expired", "not yet valid"),
     "its certificate is not valid now: renew it, and check the clocks of both machines"),
    (("certificate_verify_failed", "certificate verify failed"),
     f"no authority that this client trusts has signed its certificate: give the authority's with --ca, ca= or {CA}"),
    (("certificate_required", "certificate required", "peer_did_not_return"),
     f"it asks for a client certificate: give --cert and --key, cert= and key=, or {CERT} and {KEY}"),
    (("alert_unknown_ca", "alert unknown ca", "alert_bad_certificate", "alert bad certificate", "alert_certificate"),
     "it does not accept the client's certificate: give one that its authority (STREETFIX_TLS_CLIENT_CA) has signed"),
    (("ssl_error_ssl", "tls handshake", "ssl handshake", "[ssl"), "check the address, and the TLS settings of both sides"),
)  # fmt: skip


def closed_hint(*, speaks_tls: bool, shows_certificate: bool) -> str:
    """What a connection that was closed without a word may mean: since TLS 1.3 a client hears of a refusal only after its own part."""
    if not speaks_tls:
        return "if the service speaks TLS, so must the client: https://, or --ca, ca= over gRPC"
    if not shows_certificate:
        return f"if it asks for a client certificate, give --cert and --key, cert= and key=, or {CERT} and {KEY}"
    return "it may not accept the client's certificate: its authority (STREETFIX_TLS_CLIENT_CA) must have signed it"


def ssl_reason(error: BaseException) -> str | None:
    """What OpenSSL said among an error's causes, if anything."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, ssl.SSLError):
            return str(seen)
        seen = seen.__cause__ or seen.__context__
    return None
