"""Encrypted private keys are refused by the client and by the service. This module imports nothing: the service needs no httpx to start."""


class EncryptedKeyError(Exception):
    """OpenSSL requested a password, because the private key is encrypted."""


def refuse_password() -> str:
    """Refuse to give a password. Without this callback OpenSSL would ask at the terminal.

    Raises:
        EncryptedKeyError: always.
    """
    raise EncryptedKeyError
