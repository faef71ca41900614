"""Bodies of REST requests."""

import uuid
from collections.abc import Mapping


def multipart(parts: Mapping[str, bytes]) -> tuple[bytes, str]:
    """Return body and content type of a multipart/form-data request.

    Args:
        parts: content by name.
    """
    boundary = uuid.uuid4().hex
    body = b"".join(
        f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"; filename="{name}"\r\n\r\n'.encode()
        + content
        + b"\r\n"
        for name, content in parts.items()
    )
    return body + f"--{boundary}--\r\n".encode(), f"multipart/form-data; boundary={boundary}"
