"""Convert errors of pydantic to ``RequestError``, for the service and for its clients."""

from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from service.errors import RequestError


def invalid(error: ValidationError) -> RequestError:
    """Convert an error of pydantic. The error names the first field; its message also names the next ones.

    Args:
        error: of pydantic.
    """
    return request_error_from(error.errors(include_url=False, include_input=False, include_context=False))


def request_error_from(errors: Sequence[Any]) -> RequestError:
    """Convert a list of pydantic's errors, as ``invalid`` does.

    Args:
        errors: as pydantic lists them; at least one.
    """
    messages = [
        f"{'.'.join(str(part) for part in each['loc']) or 'the request'}: {each['msg'].removeprefix('Value error, ')}"
        for each in errors[:5]
    ]
    field = ".".join(str(part) for part in errors[0]["loc"])
    return RequestError("; ".join(messages) + "; see the schema at /openapi.json", field=field)
