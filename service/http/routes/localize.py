"""POST /v1/localize."""

import asyncio
from http import HTTPStatus
from typing import Any

from fastapi import APIRouter
from starlette.requests import Request
from starlette.responses import Response

from service.errors import BusyError, DeadlineError
from service.http import schema
from service.http.body import read_body, split_multipart
from service.http.convert import answer_from, query_from_parts
from service.http.problems import MEDIA_TYPE
from service.runtime.engine import Engine

_REQUEST_BODY: dict[str, Any] = {
    "required": True,
    "content": {
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "required": ["rgb", "depth", "request"],
                "additionalProperties": False,
                "properties": {
                    "rgb": {"type": "string", "format": "binary", "description": "JPEG, PNG or WebP"},
                    "depth": {
                        "type": "string",
                        "format": "binary",
                        "description": "16-bit PNG, TIFF, NPY or raw16+zstd (SFD1, the cheapest); "
                        "CARLA's 24-bit PNG with depth.encoding = carla",
                    },
                    "request": {"$ref": "#/components/schemas/LocalizeRequest"},
                },
            },
            "encoding": {
                "rgb": {"contentType": "image/jpeg, image/png, image/webp"},
                "depth": {"contentType": "image/png, image/tiff, application/octet-stream"},
                "request": {"contentType": "application/json"},
            },
        }
    },
}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The documented problems of a route."""
    content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {status: {"description": HTTPStatus(status).phrase, "content": content} for status in statuses}


def router_for(engine: Engine) -> APIRouter:
    """The route, bound to an engine."""
    router = APIRouter(tags=["localization"])
    settings = engine.settings
    bodies = asyncio.Semaphore(engine.admission.capacity)  # bounds the memory of bodies that are still coming in

    @router.post(
        "/v1/localize",
        operation_id="localize",
        summary="Localize one pair of pictures",
        response_model=schema.LocalizeAnswer,
        responses=problems(404, 413, 415, 422, 503, 504),
        openapi_extra={"requestBody": _REQUEST_BODY},
    )
    async def localize(request: Request) -> Response:
        """Street, position and heading of one RGB and one depth picture.

        The answer rests on retrieval: its position is the similarity-weighted mean of the best hypothesis' places.
        `prior` is a reserved name, refused until it means something; `options.refine` allows what a later release does.
        """
        if bodies.locked():
            raise BusyError(
                f"{engine.admission.capacity} requests are coming in or wait already; try again in a second"
            )
        try:
            async with asyncio.timeout(settings.request_timeout_s), bodies:
                return await _answer(engine, request)
        except TimeoutError as error:
            raise DeadlineError(
                f"no answer within {settings.request_timeout_s:g} s; send the body faster, or try again later"
            ) from error

    return router


async def _answer(engine: Engine, request: Request) -> Response:
    limits = engine.settings.limits
    body = await read_body(request, max_bytes=limits.max_request_bytes)
    content_type = request.headers.get("content-type", "")

    def work() -> bytes:
        query = query_from_parts(split_multipart(body, content_type, max_parts=limits.max_parts))
        return answer_from(engine.localize(query)).model_dump_json(by_alias=True).encode()

    answer = await asyncio.wrap_future(engine.admission.submit(work))
    return Response(answer, media_type="application/json")
