"""POST /v1/explain: an answer, and what the machine saw on the way to it."""

from fastapi import APIRouter
from starlette.requests import Request
from starlette.responses import Response

from service.console.explain import explain
from service.console.message import explanation_message
from service.contract import schema
from service.contract.convert import parsed, query_from
from service.http.asking import Asking
from service.http.body import Body
from service.http.parts import MOST_PARTS, require_parts
from service.http.routes.localize import LOCALIZE_BODY, problems


def router_for(asking: Asking) -> APIRouter:
    """The route, bound to an engine."""
    router = APIRouter(tags=["console"])
    engine = asking.engine

    @router.post(
        "/v1/explain",
        operation_id="explain",
        summary="Localize one pair of pictures, and show what the machine saw",
        response_model=schema.Explanation,
        responses=problems(404, 413, 415, 422, 503, 504),
        openapi_extra={"requestBody": LOCALIZE_BODY},
    )
    async def post_explain(request: Request) -> Response:
        """The answer that `/v1/localize` gives, with pictures for people. It costs more: robots ask there."""

        async def answer(body: Body) -> Response:
            content_type = request.headers.get("content-type", "")

            def work() -> bytes:
                parts = body.split(content_type, max_parts=MOST_PARTS)
                require_parts(parts, ("rgb", "depth", "request"))
                asked = parsed(parts["request"], schema.LocalizeRequest)
                explanation = explain(engine, query_from(asked, rgb=parts["rgb"], depth=parts["depth"]))
                request.state.span.stages(explanation.located.answer.timings)
                return explanation_message(explanation).model_dump_json(by_alias=True).encode()

            return Response(await body.run(work), media_type="application/json")

        return await asking(request, answer)

    return router
