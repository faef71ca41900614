"""The address of a search server, and of its collection with the views of maps. It needs no package of the extra ``qdrant``."""

import re
from urllib.parse import urlsplit

from service.errors import RequestError

#: Name of the collection, unless another one is given.
COLLECTION = "streetfix"
#: Time for one request of a query, s.
QUERY_S = 2.0
_NAME = re.compile(r"[A-Za-z0-9_-]{1,200}")


def checked_search_url(text: str) -> str:
    """Return the URL of a Qdrant server.

    Args:
        text: such as ``http://127.0.0.1:6333``.

    Raises:
        RequestError: the scheme is not http or https, there is no host, or the URL has credentials, a query or a fragment. The message
            repeats none of these.
    """
    try:
        parts = urlsplit(text)
        is_right = (
            parts.scheme in ("http", "https") and bool(parts.hostname) and "@" not in parts.netloc and parts.port != 0
        )
    except ValueError:
        is_right = False
    if not is_right or parts.query or parts.fragment or not text.isprintable() or " " in text:
        raise RequestError(
            "the URL of Qdrant is not valid; write http://HOST:PORT or https://HOST:PORT, and give the key in STREETFIX_QDRANT_API_KEY",
            field="qdrant_url",
        )
    return text


def checked_name(text: str) -> str:
    """Return the name of a collection.

    Args:
        text: the name.

    Raises:
        RequestError: it has other characters than letters, digits, ``_`` and ``-``, or more than 200.
    """
    if not _NAME.fullmatch(text):
        raise RequestError(
            f"the name of the collection {text[:200]!r} is not valid; use up to 200 letters, digits, '_' and '-'",
            field="qdrant_collection",
        )
    return text
