"""Routes for orchestrators: liveness, readiness, metrics and version."""

from fastapi import APIRouter
from starlette.responses import Response

from service.contract import schema
from service.errors import NotReadyError
from service.http.described import problems
from service.runtime.engine import Engine
from service.runtime.map_registry import MOST_REFUSED, NO_MAP
from service.runtime.metrics import CONTENT_TYPE
from service.runtime.threads import pools, usable_cores


def router_for(engine: Engine, version: str) -> APIRouter:
    """Create the routes.

    Args:
        engine: its state is reported.
        version: of the installed package.
    """
    router = APIRouter(tags=["operation"])

    @router.get("/livez", operation_id="getLiveness", summary="Report whether the process is alive")
    async def livez() -> schema.Health:
        return schema.Health()

    @router.get(
        "/readyz",
        operation_id="getReadiness",
        summary="Report whether the service has a map to answer from",
        responses=problems(503),
    )
    async def readyz() -> schema.Readiness:
        """Return 200 as soon as one map is mounted.

        Damaged map bundles do not change the status; `refused` lists them. The status is 503 without a map, for example while the
        maps folder is empty. The status is also 503 while the service shuts down.
        """
        refused = engine.registry.refused[:MOST_REFUSED]
        if engine.is_draining:
            raise NotReadyError("the service is stopping; use another instance")
        if not engine.is_ready:
            reasons = "".join(f"; {each.bundle} is not mounted: {each.reason}" for each in refused)
            raise NotReadyError(f"{NO_MAP}{reasons}")
        return schema.Readiness(
            refused=[schema.RefusedBundle(bundle=each.bundle, reason=each.reason) for each in refused],
            open_tiles=sum(localizer.bundle.open_tiles for localizer in engine.registry),
            cached_tiles=sum(engine.watcher.cached_tiles().values()),
        )

    @router.get(
        "/metrics",
        operation_id="getMetrics",
        summary="Get the metrics for Prometheus",
        response_class=Response,
        responses={
            200: {
                "content": {"text/plain": {"schema": {"type": "string"}}},
                "description": "The text format of Prometheus.",
            }
        },
    )
    def get_metrics() -> Response:
        return Response(engine.metrics.text(), headers={"content-type": CONTENT_TYPE})

    @router.get(
        "/v1/version", operation_id="getVersion", summary="Get the version, the resources and the maps of the service"
    )
    async def get_version() -> schema.Version:
        maps = [localizer.bundle.manifest for localizer in engine.registry]
        return schema.Version(
            version=version,
            threads=engine.threads,
            cores=usable_cores(),
            pools=pools(),
            maps=[schema.MapVersion(name=manifest.name, version=manifest.version) for manifest in maps],
        )

    return router
