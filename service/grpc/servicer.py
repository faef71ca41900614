"""The calls of LocalizationService, on the same engine and the same admission as REST."""

import re
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager
from time import perf_counter
from typing import TypeVar

import grpc

from service.contract.convert import answer_from, fields_under, map_entry_from, query_from, sequence_from, transform_of
from service.contract.coverage import coverage_geojson
from service.contract.schema import MOST_FRAMES
from service.errors import BusyError, DeadlineError, RequestError, StreetfixError
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceServicer
from service.grpc.messages import answer_message, map_message, request_from, sequence_request_from, transform_from
from service.grpc.status import fail, problem_message, refuse
from service.runtime.engine import Engine, Located
from service.runtime.logs import log_request
from service.runtime.stream import Stream

T = TypeVar("T")
REQUEST_ID = "x-request-id"
_ACCEPTABLE = re.compile(r"[A-Za-z0-9._-]{1,64}")


class Servicer(LocalizationServiceServicer):
    """Answers calls; each runs in a thread of the gRPC server, which waits while a worker of the engine does the work."""

    def __init__(self, engine: Engine, *, streams: int) -> None:
        self._engine = engine
        self._streams_left = streams  # each holds a thread as long as it lives

    def Localize(self, request: pb.LocalizeRequest, context: grpc.ServicerContext) -> pb.LocalizeResponse:
        """One pair."""
        with _answering(self._engine, "Localize", context):
            return self._run(context, lambda: self._localize(request))

    def LocalizeBatch(
        self, request: pb.LocalizeBatchRequest, context: grpc.ServicerContext
    ) -> pb.LocalizeBatchResponse:
        """Several pairs, each as if it had come alone."""
        with _answering(self._engine, "LocalizeBatch", context):
            if not 1 <= len(request.requests) <= MOST_FRAMES:
                raise RequestError(
                    f"requests: there are {len(request.requests)}; send 1 to {MOST_FRAMES}", field="requests"
                )
            begun = [self._begin(context, each) for each in request.requests]
            outcomes = [self._outcome(context, number, each) for number, each in enumerate(begun)]
            return pb.LocalizeBatchResponse(outcomes=outcomes)

    def LocalizeSequence(
        self, request: pb.LocalizeSequenceRequest, context: grpc.ServicerContext
    ) -> pb.LocalizeSequenceResponse:
        """Frames as one."""
        with _answering(self._engine, "LocalizeSequence", context):

            def work() -> Located:
                pictures = [(frame.rgb, frame.depth) for frame in request.frames]
                return self._engine.localize_sequence(*sequence_from(sequence_request_from(request), pictures))

            return pb.LocalizeSequenceResponse(answer=answer_message(answer_from(self._run(context, work))))

    def LocalizeStream(
        self, request_iterator: Iterator[pb.LocalizeStreamRequest], context: grpc.ServicerContext
    ) -> Iterator[pb.LocalizeStreamResponse]:
        """A robot that drives."""
        with _answering(self._engine, "LocalizeStream", context):
            if self._streams_left <= 0:
                raise BusyError("all streams are taken; close one, or send sequences instead")
            self._streams_left -= 1
            try:
                stream = Stream(self._engine)
                for number, request in enumerate(request_iterator):
                    yield self._next_of(stream, number, request, context)
            finally:
                self._streams_left += 1

    def ListMaps(self, request: pb.ListMapsRequest, context: grpc.ServicerContext) -> pb.ListMapsResponse:
        """All mounted maps."""
        del request
        with _answering(self._engine, "ListMaps", context):
            registry = self._engine.registry
            entries = [
                map_entry_from(localizer.bundle, registry.versions(localizer.bundle.name)) for localizer in registry
            ]
            return pb.ListMapsResponse(maps=[map_message(entry) for entry in entries])

    def GetStreets(self, request: pb.GetStreetsRequest, context: grpc.ServicerContext) -> pb.GetStreetsResponse:
        """GeoJSON."""
        with _answering(self._engine, "GetStreets", context):
            return pb.GetStreetsResponse(geojson=self._engine.registry.get(request.map).bundle.streets_geojson())

    def GetCoverage(self, request: pb.GetCoverageRequest, context: grpc.ServicerContext) -> pb.GetCoverageResponse:
        """GeoJSON."""
        with _answering(self._engine, "GetCoverage", context):
            registry = self._engine.registry
            asked = [registry.get(request.map)] if request.HasField("map") else list(registry)
            return pb.GetCoverageResponse(geojson=coverage_geojson([localizer.bundle for localizer in asked]))

    def _localize(self, request: pb.LocalizeRequest) -> pb.LocalizeResponse:
        query = query_from(request_from(request), rgb=request.rgb, depth=request.depth)
        return answer_message(answer_from(self._engine.localize(query)))

    def _begin(self, context: grpc.ServicerContext, request: pb.LocalizeRequest) -> Future[pb.LocalizeResponse]:
        """One request of a batch; refused ones come back as failed."""
        try:
            return self._submit(context, lambda: self._localize(request))
        except BusyError as error:
            refused: Future[pb.LocalizeResponse] = Future()
            refused.set_exception(error)
            return refused

    def _outcome(self, context: grpc.ServicerContext, number: int, begun: Future[pb.LocalizeResponse]) -> pb.Outcome:
        try:
            with fields_under(f"requests.{number}"):
                return pb.Outcome(answer=self._result(context, begun))
        except DeadlineError:
            raise
        except StreetfixError as error:
            return pb.Outcome(problem=problem_message(error))

    def _next_of(
        self, stream: Stream, number: int, request: pb.LocalizeStreamRequest, context: grpc.ServicerContext
    ) -> pb.LocalizeStreamResponse:
        def work() -> tuple[Located, int]:
            frame = request.frame
            query = query_from(request_from(frame), rgb=frame.rgb, depth=frame.depth)
            odometry = None
            if request.HasField("previous_from_camera"):
                name = "previous_from_camera"
                with fields_under(name):
                    odometry = transform_of(transform_from(request.previous_from_camera), name)
            return stream.localize(query, odometry)

        try:
            with fields_under(f"frame {number}"):
                located, frames = self._run(context, work)
        except DeadlineError:
            raise
        except StreetfixError as error:
            stream.forget()
            return pb.LocalizeStreamResponse(outcome=pb.Outcome(problem=problem_message(error)))
        return pb.LocalizeStreamResponse(outcome=pb.Outcome(answer=answer_message(answer_from(located))), frames=frames)

    def _run(self, context: grpc.ServicerContext, work: Callable[[], T]) -> T:
        return self._result(context, self._submit(context, work))

    def _submit(self, context: grpc.ServicerContext, work: Callable[[], T]) -> Future[T]:
        """Queue work that is dropped if the caller goes away while it waits."""
        future = self._engine.admission.submit(work)

        def drop() -> None:
            future.cancel()

        if not context.add_callback(drop):
            drop()
        return future

    def _result(self, context: grpc.ServicerContext, future: Future[T]) -> T:
        left = context.time_remaining()
        most = self._engine.settings.request_timeout_s
        try:
            return future.result(timeout=most if left is None else min(left, most))
        except (TimeoutError, CancelledError) as error:
            future.cancel()
            raise DeadlineError(
                f"no answer within {min(left or most, most):.3g} s; allow more time, or try again later"
            ) from error


@contextmanager
def _answering(engine: Engine, call: str, context: grpc.ServicerContext) -> Iterator[None]:
    """Whatever is raised inside ends the call as the contract says, and is counted."""
    metadata = {name: value for name, value in context.invocation_metadata() if isinstance(value, str)}
    given = metadata.get(REQUEST_ID, "")
    request_id = given if _ACCEPTABLE.fullmatch(given) else uuid.uuid4().hex
    context.send_initial_metadata(((REQUEST_ID, request_id),))
    began, code = perf_counter(), "OK"
    try:
        yield
    except StreetfixError as error:
        code = error.code
        refuse(context, error)
    except GeneratorExit:
        code = "CANCELLED"
        raise
    except Exception as error:
        code = "INTERNAL"
        fail(context, error, request_id)
    finally:
        seconds = perf_counter() - began
        engine.metrics.requested("grpc", call, code, seconds)
        log_request(
            face="grpc",
            method=call,
            code=code,
            seconds=seconds,
            request_id=request_id,
            traceparent=metadata.get("traceparent"),
        )
