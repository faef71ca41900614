"""Routes for maps: list, serving version, streets and coverage."""

import asyncio
from typing import Any

from fastapi import APIRouter
from starlette.requests import Request
from starlette.responses import Response

from service.contract import schema
from service.contract.convert import map_entry_from, parsed
from service.contract.coverage import coverage_geojson
from service.http.body import read_body
from service.http.described import problems
from service.http.middleware import require_operator
from service.runtime.engine import Engine

GEOJSON = "application/geo+json"
_STREETS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "A GeoJSON FeatureCollection of polygons. It is empty if the map has no streets.",
        "content": {GEOJSON: {"schema": {"type": "object"}}},
    },
    **problems(404, 422, 503),
}

_MOST_BYTES = 4096
_SERVE_VERSION: dict[str, Any] = {
    "required": True,
    "content": {"application/json": {"schema": {"$ref": "#/components/schemas/ServeVersion"}}},
}
_COVERAGE: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "A GeoJSON FeatureCollection with one MultiPolygon per map. Coordinates are longitude and latitude if the map is "
        "georeferenced, else metres of the map frame. `properties.frame` names the frame.",
        "content": {GEOJSON: {"schema": {"type": "object"}}},
    },
    **problems(413, 503),
}


def router_for(engine: Engine) -> APIRouter:
    """Create the routes.

    Args:
        engine: holds the maps.
    """
    router = APIRouter(tags=["maps"])

    @router.get("/v1/maps", operation_id="listMaps", summary="List all mounted maps")
    async def list_maps() -> schema.MapList:
        registry = engine.registry
        return schema.MapList(
            maps=[map_entry_from(each.bundle, registry.versions(each.bundle.name)) for each in registry]
        )

    @router.put(
        "/v1/maps/{map}/serving",
        operation_id="serveVersion",
        summary="Select the serving version of a map",
        responses=problems(401, 403, 404, 413, 422),
        openapi_extra={"requestBody": _SERVE_VERSION},
    )
    async def serve_version(map: str, request: Request) -> schema.MapEntry:  # noqa: A002
        """Roll back, or forward again, in one step. Running requests end on the version that they began with.

        All workers change at the same time. As soon as one worker has answered from the chosen version, none answers from the
        version before. The choice also holds if a worker restarts. It ends when a version that is newer than all open ones is
        mounted, or when the chosen version is removed. After a restart, the service serves the newest version. To keep an old
        version permanently, remove the new version from the folder. The route needs an operator's key
        (`streetfix keys --operator`), or a service on loopback without keys.
        """
        require_operator(request, engine.settings)
        with engine.memory.hold() as hold:
            async with asyncio.timeout(engine.settings.request_timeout_s):
                content = await read_body(request, max_bytes=_MOST_BYTES, hold=hold)
            wanted = parsed(bytes(content), schema.ServeVersion)
        served = engine.serve_version(map, wanted.version)
        return map_entry_from(served.bundle, engine.registry.versions(map))

    @router.get(
        "/v1/maps/{map}/streets",
        operation_id="getStreets",
        summary="Get the streets of a map",
        response_class=Response,
        responses=_STREETS,
    )
    def get_streets(map: str) -> Response:  # noqa: A002  # the contract's name
        return Response(engine.registry.get(map).bundle.streets_geojson(), media_type=GEOJSON)

    @router.get(
        "/v1/coverage",
        operation_id="getCoverage",
        summary="Get the area where the maps can answer",
        response_class=Response,
        responses=_COVERAGE,
    )
    def get_coverage() -> Response:
        with engine.memory.hold() as hold:
            collection = coverage_geojson([localizer.bundle for localizer in engine.registry], hold)
            response = Response(collection, media_type=GEOJSON)
            hold.leave_with(response)
        return response

    return router
