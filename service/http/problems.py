"""Errors as problem+json (RFC 9457). One table maps the kinds of the exceptions to status codes."""

import json
import logging
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from service.contract.invalid import request_error_from
from service.errors import Kind, StreetfixError

MEDIA_TYPE = "application/problem+json"
RETRY_AFTER_S = 1

STATUS_OF_KIND: dict[Kind, int] = {
    "invalid": 422,
    "unsupported": 415,
    "too_large": 413,
    "not_found": 404,
    "unauthorized": 401,
    "forbidden": 403,
    "busy": 503,
    "not_ready": 503,
    "deadline": 504,
}

#: Codes of problems without a ``StreetfixError``: refusals by HTTP itself, and unexpected errors.
CODE_OF_STATUS = {400: "bad-request", 404: "not-found", 405: "method-not-allowed", 500: "internal"}

_log = logging.getLogger("streetfix.http")


class Problem(BaseModel):
    """What went wrong and what to do, RFC 9457."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "type": "/problems/image-size",
                    "title": "The image size does not match the camera intrinsics.",
                    "status": 422,
                    "detail": "The image `depth` has 640x360 pixels, but the camera has 640x480, so the aspect ratios differ; "
                    "send the whole image, or the intrinsics of the image that you sent.",
                    "code": "image-size",
                    "field": "depth",
                    "request_id": "4f0c8f4c0d5e4c0f9b4a3a1d4b7f9e21",
                }
            ]
        }
    )

    type: str = Field(description="a relative URI; docs/problems.md lists all problems")
    title: str
    status: int
    detail: str = Field(description="what happened, the wrong value, and what to do")
    code: str = Field(description="the last part of the type; stable")
    field: str | None = Field(description="dotted path of the invalid field")
    request_id: str


def install(app: FastAPI) -> None:
    """Answer every expected error as a problem. ``RequestIdMiddleware`` answers the unexpected ones.

    Args:
        app: that gets the handlers.
    """
    app.add_exception_handler(StreetfixError, _on_ours)
    app.add_exception_handler(RequestValidationError, _on_invalid)
    app.add_exception_handler(HTTPException, _on_http)


def problem_response(problem: Problem, headers: Any = None) -> Response:
    """Build the response for a problem. Status 503 also gets ``Retry-After``.

    Args:
        problem: to send.
        headers: further headers; None adds none.
    """
    all_headers = dict(headers or {})
    if problem.status == 503:
        all_headers["Retry-After"] = str(RETRY_AFTER_S)
    return Response(problem.model_dump_json(), status_code=problem.status, media_type=MEDIA_TYPE, headers=all_headers)


def problem_of(error: StreetfixError, request_id: str) -> Problem:
    """Convert an error to a problem. This clears the traceback, which would keep the request in memory.

    Args:
        error: to convert.
        request_id: of the request.
    """
    error.__traceback__ = None
    return Problem(
        type=f"/problems/{error.code}",
        title=title_of(type(error)),
        status=STATUS_OF_KIND[error.kind],
        detail=error.message,
        code=error.code,
        field=error.field or None,
        request_id=request_id,
    )


def internal_error(error: Exception, request_id: str) -> Response:
    """Answer an unexpected error. The log gets the traceback; the caller gets only the request id.

    Args:
        error: unexpected.
        request_id: of the request.
    """
    _log.error("request_failed request_id=%s", request_id, exc_info=error)
    error.__traceback__ = None
    problem = Problem(
        type="/problems/internal",
        title="Internal error.",
        status=500,
        detail="The service failed on this request; report the request id to its operator.",
        code="internal",
        field=None,
        request_id=request_id,
    )
    return problem_response(problem)


async def _on_ours(request: Request, error: Exception) -> Response:
    if not isinstance(error, StreetfixError):
        raise error
    return problem_response(problem_of(error, request.state.request_id))


async def _on_invalid(request: Request, error: Exception) -> Response:
    if not isinstance(error, RequestValidationError):
        raise error
    return await _on_ours(request, request_error_from(error.errors()))


async def _on_http(request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        raise error
    path = json.dumps(request.url.path[:200])
    code = CODE_OF_STATUS.get(error.status_code, "bad-request")
    problem = Problem(
        type=f"/problems/{code}",
        title=HTTPStatus(error.status_code).phrase + ".",
        status=error.status_code,
        detail=f"{request.method} {path}: {error.detail}; see the API at /openapi.json",
        code=code,
        field=None,
        request_id=request.state.request_id,
    )
    return problem_response(problem, error.headers)


def title_of(kind_of_error: type[StreetfixError]) -> str:
    """Return the title of a problem: the first line of the docstring of its error class.

    Args:
        kind_of_error: the class.
    """
    return (kind_of_error.__doc__ or "").strip().splitlines()[0]
