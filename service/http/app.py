"""The REST request handler: builds an ASGI application for an engine."""

from importlib.metadata import version as installed_version
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from service.contract import schema
from service.contract.oscp import GeoPoseRequest
from service.http import problems, reference
from service.http.body import RequestRunner
from service.http.middleware import AllowedHosts, AuthMiddleware, HostMiddleware, RequestIdMiddleware
from service.http.routes import answers, console, drawing, explain, health, localize, maps, oscp, samples
from service.runtime.engine import Engine
from service.runtime.keys import KeyRing

_DESCRIPTION = """Streetfix localizes one RGB image and one depth image against a LiDAR map: street, position and heading.

Lengths are in metres, angles in degrees. Quaternions are x, y, z, w. The map frame is right-handed with z up. The camera
frame is x right, y down, z forward. Headings are counter-clockwise from map x, in (-180, 180]. Every error is
`application/problem+json`. Every response has an `X-Request-Id`."""


def create_app(engine: Engine, keys: KeyRing | None = None) -> FastAPI:
    """Create the application. It neither opens nor closes the engine.

    Args:
        engine: open.
        keys: of the allowed callers; None allows everybody.
    """
    version = installed_version("streetfix")
    # Swagger UI and ReDoc are disabled, because they load scripts and styles from other hosts.
    app = FastAPI(
        title="Streetfix",
        version=version,
        description=_DESCRIPTION,
        redirect_slashes=False,
        docs_url=None,
        redoc_url=None,
    )
    runner = RequestRunner(engine)
    app.include_router(localize.router_for(runner))
    app.include_router(oscp.router_for(runner))
    app.include_router(maps.router_for(engine))
    app.include_router(health.router_for(engine, version))
    if engine.settings.console:
        for routes in (console.router_for(), drawing.router_for(runner), explain.router_for(runner)):
            app.include_router(routes)
        for routes in (samples.router_for(engine.settings), answers.router_for(engine)):
            app.include_router(routes)
    app.include_router(reference.router_for(app, leads_from_root=not engine.settings.console))
    if keys is not None:
        app.add_middleware(AuthMiddleware, keys=keys)
    app.add_middleware(HostMiddleware, hosts=AllowedHosts.of(engine.settings))
    app.add_middleware(
        RequestIdMiddleware, requested=engine.metrics.requested, tracing=engine.tracing
    )  # added last, so it is the outermost
    problems.install(app)
    app.openapi = lambda: _openapi_of(app)  # type: ignore[method-assign]  # FastAPI's documented way
    return app


def create_health_app(engine: Engine) -> FastAPI:
    """Create the application of the health port. It needs no key.

    It serves ``/livez`` and ``/readyz``, and ``/metrics`` if the settings enable it.

    Args:
        engine: open.
    """
    wanted = {"/livez", "/readyz"} | ({"/metrics"} if engine.settings.health_metrics else set())
    app = FastAPI(openapi_url=None, redirect_slashes=False)
    router = health.router_for(engine, installed_version("streetfix"))
    router.routes = [route for route in router.routes if getattr(route, "path", None) in wanted]
    app.include_router(router)
    app.add_middleware(RequestIdMiddleware, requested=engine.metrics.requested, tracing=engine.tracing)
    problems.install(app)
    return app


def _openapi_of(app: FastAPI) -> dict[str, Any]:
    """OpenAPI document with the schemas that no route declares.

    Routes do not declare them, because this package parses bodies and writes problems itself.
    """
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        schemas = document["components"]["schemas"]
        for model in (
            schema.LocalizeRequest,
            schema.SequenceRequest,
            schema.BatchRequest,
            schema.ServeVersion,
            GeoPoseRequest,
            problems.Problem,
        ):
            written = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas.update(written.pop("$defs", {}))
            schemas[model.__name__] = written
        app.openapi_schema = document
    return app.openapi_schema
