"""Routes for drawing a map: its cloud and its survey track, in a compact binary format."""

from typing import Annotated, Any

from fastapi import APIRouter, Query
from starlette.responses import Response

from service.console.cloud import LEVELS, Clouds, places_bytes
from service.http.body import RequestRunner
from service.http.described import problems

_BYTES = "application/octet-stream"
_BINARY = {_BYTES: {"schema": {"type": "string", "format": "binary"}}}
_CLOUD: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "`SFC1`, count (uint32), origin and step (3 float64 each; metres, map frame). Then for each point, as uint16: "
        "x, y, z in steps from the origin, and how upright its surface is (0 ground, 65535 wall). All numbers are little-endian. "
        "The first N points form a thinner cloud, for any N.",
        "content": _BINARY,
    },
    **problems(404, 422, 503, 504),
}
_PLACES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "`SFP1`, count (uint32), origin (3 float64; metres, map frame). Then for each place: x, y, z from the origin and "
        "heading (float32; metres, radians), and the number of its street (int32, -1 for none). All numbers are little-endian.",
        "content": _BINARY,
    },
    **problems(404, 422, 503),
}


def router_for(runner: RequestRunner) -> APIRouter:
    """Create the routes.

    Args:
        runner: runs the work; holds the engine.
    """
    router = APIRouter(tags=["console"])
    registry, clouds = runner.engine.registry, Clouds()

    @router.get(
        "/v1/maps/{map}/cloud",
        operation_id="getCloud",
        summary="Get the thinned cloud of a map",
        response_class=Response,
        responses=_CLOUD,
    )
    async def get_cloud(
        map: str,  # noqa: A002  # the contract's name
        points: Annotated[
            int,
            Query(
                ge=1,
                le=LEVELS[-1],
                description="number of points at most. The service rounds it down to one of a few levels",
            ),
        ] = 500_000,
    ) -> Response:
        bundle = registry.get(map).bundle
        return Response(await runner.in_time(lambda: clouds.of(bundle, points)), media_type=_BYTES)

    @router.get(
        "/v1/maps/{map}/places",
        operation_id="getPlaces",
        summary="Get the survey track of a map",
        response_class=Response,
        responses=_PLACES,
    )
    def get_places(map: str) -> Response:  # noqa: A002  # the contract's name
        return Response(places_bytes(registry.get(map).bundle), media_type=_BYTES)

    return router
