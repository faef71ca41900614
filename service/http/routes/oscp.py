"""The OSCP GeoPose Protocol 2.0, so that its clients work without changes."""

import re
import time
import uuid
from typing import Annotated, Any

from fastapi import APIRouter, Query
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from service.contract.convert import answer_from, parsed
from service.contract.oscp import GeoPoseAnswer, GeoPoseRequest, accuracy_of, query_of
from service.http.body import Body, RequestRunner
from service.http.described import problems
from service.http.geopose import sure_geopose

#: Copies of a JSON body in memory: its bytes, its strings, and the images decoded from them.
_COPIES = 3
MEDIA_TYPE = "application/vnd.oscp+json;version=2.0"
_VERSION = re.compile(r"application/vnd\.oscp\+json\s*;\s*version\s*=\s*\"?([0-9.]+)", re.IGNORECASE)
_BODY: dict[str, Any] = {
    "required": True,
    "content": {"application/json": {"schema": {"$ref": "#/components/schemas/GeoPoseRequest"}}},
}


def router_for(runner: RequestRunner) -> APIRouter:
    """Create the routes.

    Args:
        runner: reads the bodies; holds the engine.
    """
    router = APIRouter(tags=["geopose"])
    engine = runner.engine

    @router.get(
        "/geopose", operation_id="getGeoPoseStatus", summary="Tell whether the service speaks the OSCP GeoPose Protocol"
    )
    async def status() -> dict[str, str]:
        return {"status": "running", "protocol": "OSCP GeoPose Protocol", "version": "2.0"}

    @router.post(
        "/geopose",
        operation_id="postGeoPose",
        summary="Localize by the OSCP GeoPose Protocol 2.0",
        response_model=GeoPoseAnswer,
        responses=problems(400, 404, 413, 422, 503, 504),
        openapi_extra={"requestBody": _BODY},
    )
    async def geopose(request: Request, map: Annotated[str | None, Query(max_length=64)] = None) -> Response:  # noqa: A002
        """Return the pose of a camera on the Earth: colour and DEPTH readings in, a GeoPose out.

        `Accept: application/vnd.oscp+json;version=2.0` names the version. A request that names no version gets this one: no Accept,
        `*/*`, or `application/json`, as the reference clients send. The service refuses any other version.

        Intrinsics follow COLMAP: the corner of the first pixel is (0, 0). DEPTH is a 16-bit PNG in millimetres or a float TIFF in
        metres. The axes of the accelerometer follow W3C. `heightAboveGround` of the camera's parameters is a field of this service:
        the height of the camera above the ground, metres. `map` names one of several maps. Without it, the nearest map to the last of
        `priorPoses`, or to the geolocation reading, answers.

        If the answer is not LOCALIZED, the response is the problem `no-pose`, because the protocol cannot express uncertainty.
        """
        _require_version(request.headers.get("accept", ""))

        async def answer(body: Body) -> Response:
            def work() -> bytes:
                document = parsed(body.whole(copies=_COPIES), GeoPoseRequest)
                located = answer_from(engine.localize(query_of(document, map)))
                geopose = sure_geopose(located)  # refuses an answer that is not LOCALIZED
                envelope = GeoPoseAnswer(
                    id=document.id or uuid.uuid4().hex,
                    timestamp=time.time_ns() // 1_000_000,
                    accuracy=accuracy_of(located.require_pose().covariance),
                    geopose=geopose,
                )
                return envelope.model_dump_json().encode()

            return Response(await body.run(work), media_type=MEDIA_TYPE)

        return await runner(request, answer)

    return router


def _require_version(accept: str) -> None:
    """Refuse another version of the protocol. An ``Accept`` header without the OSCP media type passes."""
    found = _VERSION.search(accept)
    if found is None and "vnd.oscp" not in accept.lower():
        return
    if found is None or found[1].split(".")[0] != "2":
        said = "missing" if found is None else found[1]
        raise HTTPException(400, f"the protocol version in Accept is {said}; send Accept: {MEDIA_TYPE}")
