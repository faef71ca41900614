"""POST /v1/explain: an answer with its intermediate results as images."""

from fastapi import APIRouter
from starlette.requests import Request
from starlette.responses import Response

from service.console.explain import explain
from service.console.message import explanation_message
from service.contract import schema
from service.contract.convert import parsed, query_from
from service.http.body import MOST_PARTS, Body, RequestRunner, require_parts
from service.http.described import LOCALIZE_BODY, problems


def router_for(runner: RequestRunner) -> APIRouter:
    """Create the route.

    Args:
        runner: reads the bodies; holds the engine.
    """
    router = APIRouter(tags=["console"])
    engine = runner.engine

    @router.post(
        "/v1/explain",
        operation_id="explain",
        summary="Localize one image pair, with the intermediate results as images",
        response_model=schema.Explanation,
        responses=problems(404, 413, 415, 422, 503, 504),
        openapi_extra={"requestBody": LOCALIZE_BODY},
    )
    async def post_explain(request: Request) -> Response:
        """Return the answer of `/v1/localize`, with images for people.

        This route costs more than `/v1/localize`. Robots use `/v1/localize`.
        """

        async def answer(body: Body) -> Response:
            content_type = request.headers.get("content-type", "")

            def work() -> bytes:
                parts = body.split(content_type, max_parts=MOST_PARTS)
                require_parts(parts, ("rgb", "depth", "request"))
                document = parsed(parts["request"], schema.LocalizeRequest)
                explanation = explain(engine, query_from(document, rgb=parts["rgb"], depth=parts["depth"]))
                request.state.span.stages(explanation.located.answer.timings)
                return explanation_message(explanation).model_dump_json(by_alias=True).encode()

            return Response(await body.run(work), media_type="application/json")

        return await runner(request, answer)

    return router
