"""Convert errors of pydantic to ``RequestError``, for the service and for its clients."""

import json
from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from service.errors import RequestError

#: A message repeats a wrong text of at most this length, characters, and a wrong number below this size. Longer values may be image
#: data, or the whole request.
MOST_CHARACTERS, MOST_NUMBER = 40, 1e40
#: Kinds of errors in which the name is wrong, not the value.
_NAME_IS_WRONG = ("missing", "extra_forbidden")


def invalid(error: ValidationError) -> RequestError:
    """Convert an error of pydantic. The error names the first field; its message also names the next ones.

    The message repeats a wrong value if it is a number or a short text.

    Args:
        error: of pydantic.
    """
    return request_error_from(error.errors(include_url=False, include_context=False))


def request_error_from(errors: Sequence[Any]) -> RequestError:
    """Convert a list of pydantic's errors, as ``invalid`` does.

    Args:
        errors: as pydantic lists them; at least one.
    """
    messages = [
        f"{'.'.join(map(str, each['loc'])) or 'the request'}: {each['msg'].removeprefix('Value error, ')}{_given(each)}"
        for each in errors[:5]
    ]
    field = ".".join(str(part) for part in errors[0]["loc"])
    return RequestError("; ".join(messages) + "; see the schema at /openapi.json", field=field)


def _given(error: dict[str, Any]) -> str:
    """Return the wrong value as JSON in brackets; nothing for the whole request, a list, an object or a long value."""
    value = error.get("input")
    if not error["loc"] or error.get("type") in _NAME_IS_WRONG:
        return ""
    short = isinstance(value, str) and len(value) <= MOST_CHARACTERS
    number = isinstance(value, (int, float)) and not abs(value) >= MOST_NUMBER
    return f" (given: {json.dumps(value)})" if short or number else ""
