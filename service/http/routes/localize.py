"""POST /v1/localize for one image pair, a sequence and a batch."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from fastapi import APIRouter
from pydantic import BaseModel, Field
from starlette.requests import Request
from starlette.responses import Response

from service.contract import schema
from service.contract.convert import answer_from, fields_under, parsed, query_from, sequence_from
from service.errors import StreetfixError
from service.http.body import MOST_PARTS, Body, RequestRunner, document_of, numbered_pictures, require_parts
from service.http.described import LOCALIZE_BODY, numbered_body, problems
from service.http.geopose import GEOPOSE, sure_geopose
from service.http.problems import Problem, problem_of
from service.runtime.engine import Engine, Located
from service.runtime.tracing import RequestSpan


def router_for(runner: RequestRunner) -> APIRouter:
    """Create the routes.

    Args:
        runner: reads the bodies; holds the engine.
    """
    router = APIRouter(tags=["localization"])
    engine = runner.engine

    @router.post(
        "/v1/localize",
        operation_id="localize",
        summary="Localize one image pair",
        response_model=schema.LocalizeAnswer,
        responses=problems(404, 413, 415, 422, 503, 504),
        openapi_extra={"requestBody": LOCALIZE_BODY},
    )
    async def localize(request: Request) -> Response:
        """Return street, pose with covariance, and confidence for one RGB image and one depth image.

        The service looks up the most similar places of the map. It registers the depth image on the map cloud from each of them.
        The answer is the best supported pose. With `options.refine` false, the answer is the mean of the best hypothesis' places.
        """
        return await ask(request, _single)

    @router.post(
        "/v1/localize/sequence",
        operation_id="localizeSequence",
        summary="Localize frames of a traversal, or the cameras of a rig, as one",
        response_model=schema.LocalizeAnswer,
        responses=problems(404, 413, 415, 422, 503, 504),
        openapi_extra={"requestBody": numbered_body("SequenceRequest")},
    )
    async def localize_sequence(request: Request) -> Response:
        """Return the pose of the first frame.

        The other frames resolve the ambiguity of the first frame, for example in a street of repeating blocks.
        Every other frame has `T_reference_camera`: odometry, or the pose of the camera on the rig.
        """
        return await ask(request, _sequence)

    @router.post(
        "/v1/localize/batch",
        operation_id="localizeBatch",
        summary="Localize several image pairs, each on its own",
        response_model=BatchAnswer,
        responses=problems(413, 415, 422, 503, 504),
        openapi_extra={"requestBody": numbered_body("BatchRequest")},
    )
    async def localize_batch(request: Request) -> Response:
        """Return an outcome for each request, in their order.

        An outcome is an answer, or the problem that the request would also have got alone.
        """
        return await ask(request, _batch)

    async def ask(request: Request, work: Work) -> Response:
        async def answer(body: Body) -> Response:
            headers = request.headers
            given = MultipartRequest(
                body,
                headers.get("content-type", ""),
                request.state.request_id,
                request.state.span,
                geopose_alone=work is not _batch and wants_geopose(headers.get("accept", "")),
            )
            media_type = GEOPOSE if given.geopose_alone else "application/json"
            return Response(await work(engine, given), media_type=media_type, headers={"Vary": "Accept"})

        return await runner(request, answer)

    return router


class Outcome(BaseModel):
    """An answer, or what went wrong."""

    answer: schema.LocalizeAnswer | None
    problem: Problem | None


class BatchAnswer(BaseModel):
    """Outcomes in the order of the requests."""

    outcomes: list[Outcome] = Field(description="one of each is null")


@dataclass(frozen=True, slots=True)
class MultipartRequest:
    """A complete body and what its request says.

    Attributes:
        body: the body.
        content_type: header of the request.
        request_id: of the request.
        span: of the request.
        geopose_alone: answer with a GeoPose only.
    """

    body: Body
    content_type: str
    request_id: str
    span: RequestSpan
    geopose_alone: bool = False

    def parts(self) -> dict[str, bytes]:
        """Split the body into its parts by name."""
        return self.body.split(self.content_type, max_parts=MOST_PARTS)


Work = Callable[[Engine, MultipartRequest], Awaitable[bytes]]


async def _single(engine: Engine, given: MultipartRequest) -> bytes:
    def work() -> bytes:
        parts = given.parts()
        require_parts(parts, ("rgb", "depth", "request"))
        request = parsed(parts["request"], schema.LocalizeRequest)
        return _written(engine.localize(query_from(request, rgb=parts["rgb"], depth=parts["depth"])), given)

    return await given.body.run(work)


async def _sequence(engine: Engine, given: MultipartRequest) -> bytes:
    def work() -> bytes:
        parts = given.parts()
        request = parsed(document_of(parts), schema.SequenceRequest)
        queries, transforms = sequence_from(request, numbered_pictures(parts, len(request.frames)))
        return _written(engine.localize_sequence(queries, transforms), given)

    return await given.body.run(work)


async def _batch(engine: Engine, given: MultipartRequest) -> bytes:
    """Answer a batch. Each request takes a worker as a single request does; one beyond the queue gets its own problem."""

    def split() -> list[tuple[schema.LocalizeRequest, bytes, bytes]]:
        parts = given.parts()
        requests = parsed(document_of(parts), schema.BatchRequest).requests
        pictures = numbered_pictures(parts, len(requests))
        return [(request, *pair) for request, pair in zip(requests, pictures, strict=True)]

    async def one(number: int, request: schema.LocalizeRequest, rgb: bytes, depth: bytes) -> Outcome:
        def work() -> schema.LocalizeAnswer:
            located = engine.localize(query_from(request, rgb=rgb, depth=depth))
            given.span.stages(located.answer.timings)
            return answer_from(located)

        try:
            with fields_under(f"requests.{number}"):
                return Outcome(answer=await given.body.run(work), problem=None)
        except StreetfixError as error:
            return Outcome(answer=None, problem=problem_of(error, given.request_id))

    requests = await given.body.run(split)
    engine.metrics.batched(len(requests))
    outcomes = await asyncio.gather(*(one(number, *each) for number, each in enumerate(requests)))
    return BatchAnswer(outcomes=list(outcomes)).model_dump_json(by_alias=True).encode()


def _written(located: Located, given: MultipartRequest) -> bytes:
    given.span.stages(located.answer.timings)
    answer = answer_from(located)
    if not given.geopose_alone:
        return answer.model_dump_json(by_alias=True).encode()
    return sure_geopose(answer).model_dump_json().encode()


def wants_geopose(accept: str) -> bool:
    """Return whether a caller prefers GeoPose to the JSON answer of this service.

    Args:
        accept: value of the header. The highest quality wins; the first entry breaks ties.
    """
    best, wanted = 0.0, False
    for entry in accept.split(","):
        name, *parameters = (word.strip().lower() for word in entry.split(";"))
        quality = 1.0
        for parameter in parameters:
            key, _, value = parameter.partition("=")
            if key.strip() == "q":
                try:
                    quality = float(value)
                except ValueError:
                    quality = 0.0
        if quality > best and name in (GEOPOSE, "application/json", "application/*", "*/*"):
            best, wanted = quality, name == GEOPOSE
    return wanted
