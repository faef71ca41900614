"""The request id: a header that REST and gRPC share."""

import re
import uuid

#: Name of the header (REST, in any case) and of the metadata key (gRPC, in lower case).
REQUEST_ID = "x-request-id"
_ACCEPTABLE = re.compile(r"[A-Za-z0-9._-]{1,64}")


def request_id_of(given: str) -> str:
    """Return the caller's id if it is 1 to 64 letters, digits, ``.``, ``_`` or ``-``; else a new one.

    Args:
        given: id that the caller sent; empty if it sent none.
    """
    return given if _ACCEPTABLE.fullmatch(given) else uuid.uuid4().hex
