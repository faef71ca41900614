"""Route for the last answers, for monitoring by operators."""

from typing import Annotated

from fastapi import APIRouter, Query
from starlette.requests import Request

from service.contract import schema
from service.contract.convert import last_answer_from
from service.http.described import problems
from service.http.middleware import require_operator
from service.runtime.engine import Engine
from service.runtime.last_answers import MOST


def router_for(engine: Engine) -> APIRouter:
    """Create the route.

    Args:
        engine: holds the last answers.
    """
    router = APIRouter(tags=["console"])

    @router.get(
        "/v1/answers",
        operation_id="listAnswers",
        summary="The last answers of this process",
        responses=problems(401, 403, 422),
    )
    async def list_answers(
        request: Request, most: Annotated[int, Query(ge=1, le=MOST, description="number of answers at most")] = 50
    ) -> schema.LastAnswers:
        """List figures of the last answers, without image data.

        The figures say where robots are. So the route needs an operator's key, or a service on loopback without keys.
        """
        require_operator(request, engine.settings)
        return schema.LastAnswers(answers=[last_answer_from(each) for each in engine.last_answers.newest(most)])

    return router
