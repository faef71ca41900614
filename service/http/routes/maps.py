"""GET /v1/maps and what belongs to a map."""

from typing import Any

from fastapi import APIRouter
from starlette.responses import Response

from service.http import schema
from service.http.convert import map_entry_from
from service.http.routes.localize import problems
from service.runtime.engine import Engine

GEOJSON = "application/geo+json"
_STREETS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "A GeoJSON FeatureCollection of polygons; empty where the map has no streets.",
        "content": {GEOJSON: {"schema": {"type": "object"}}},
    },
    **problems(404, 422),
}


def router_for(engine: Engine) -> APIRouter:
    """The routes, bound to an engine."""
    router = APIRouter(tags=["maps"])

    @router.get("/v1/maps", operation_id="listMaps", summary="All mounted maps")
    async def list_maps() -> schema.MapList:
        return schema.MapList(maps=[map_entry_from(localizer.bundle) for localizer in engine.registry])

    @router.get(
        "/v1/maps/{map}/streets",
        operation_id="getStreets",
        summary="The streets of a map",
        response_class=Response,
        responses=_STREETS,
    )
    def get_streets(map: str) -> Response:  # noqa: A002  # the contract's name
        return Response(engine.registry.get(map).bundle.streets_geojson(), media_type=GEOJSON)

    return router
