"""What an orchestrator asks."""

from fastapi import APIRouter
from starlette.responses import Response

from service.contract import schema
from service.errors import NotReadyError
from service.http.routes.localize import problems
from service.runtime.engine import Engine
from service.runtime.metrics import CONTENT_TYPE
from service.runtime.threads import pools, usable_cores


def router_for(engine: Engine, version: str) -> APIRouter:
    """The routes, bound to an engine."""
    router = APIRouter(tags=["operation"])

    @router.get("/livez", operation_id="getLiveness", summary="Whether the process lives")
    async def livez() -> schema.Health:
        return schema.Health()

    @router.get(
        "/readyz", operation_id="getReadiness", summary="Whether a map is open to answer from", responses=problems(503)
    )
    async def readyz() -> schema.Health:
        if not engine.is_ready:
            what = "the service is leaving" if engine.is_draining else "no map is mounted; mount a map bundle"
            raise NotReadyError(what)
        return schema.Health()

    @router.get(
        "/metrics",
        operation_id="getMetrics",
        summary="What Prometheus scrapes",
        response_class=Response,
        responses={
            200: {"content": {"text/plain": {"schema": {"type": "string"}}}, "description": "Prometheus' text format."}
        },
    )
    def get_metrics() -> Response:
        return Response(engine.metrics.text(), headers={"content-type": CONTENT_TYPE})

    @router.get("/v1/version", operation_id="getVersion", summary="What runs here")
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
