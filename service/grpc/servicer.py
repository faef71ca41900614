"""The calls of LocalizationService. They use the same engine and the same admission as REST."""

from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import AbstractContextManager
from time import perf_counter

import grpc

from service.contract.convert import (
    answer_from,
    fields_under,
    map_entry_from,
    odometry_std_of,
    query_from,
    sequence_from,
    transform_of,
)
from service.contract.coverage import coverage_geojson
from service.contract.schema import MOST_FRAMES
from service.errors import BusyError, DeadlineError, RequestError, StreetfixError
from service.grpc.answering import answering
from service.grpc.call import Call
from service.grpc.deadline_watchdog import DeadlineWatchdog
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceServicer
from service.grpc.memory import MessageMemory
from service.grpc.messages import (
    answer_message,
    map_message,
    odometry_std_from,
    request_from,
    sequence_request_from,
    transform_from,
)
from service.grpc.status import problem_message
from service.runtime.engine import Engine, Located
from service.runtime.stream import Stream
from service.runtime.tracing import RequestSpan


class Servicer(LocalizationServiceServicer):
    """Answers calls. Each call runs in a thread of the gRPC server, which waits while a worker of the engine does the work.

    Args:
        engine: does the work.
        watchdog: ends streams that send no frame.
        memory: for the messages of streams.
    """

    def __init__(self, engine: Engine, watchdog: DeadlineWatchdog, memory: MessageMemory) -> None:
        self._engine = engine
        self._watchdog = watchdog
        self._memory = memory

    def Localize(self, request: pb.LocalizeRequest, context: grpc.ServicerContext) -> pb.LocalizeResponse:
        """Localize one image pair.

        Args:
            request: the pair.
            context: of the call.
        """
        with self._answering("Localize", context) as call:
            return call.run(lambda: self._localize(request, call.span))

    def LocalizeBatch(
        self, request: pb.LocalizeBatchRequest, context: grpc.ServicerContext
    ) -> pb.LocalizeBatchResponse:
        """Localize several image pairs, each as if it were sent alone.

        Args:
            request: the pairs.
            context: of the call.

        Raises:
            RequestError: there is no pair, or there are too many. Inside the call it becomes the status.
        """
        with self._answering("LocalizeBatch", context) as call:
            if not 1 <= len(request.requests) <= MOST_FRAMES:
                raise RequestError(
                    f"requests: the batch has {len(request.requests)} requests; send 1 to {MOST_FRAMES}",
                    field="requests",
                )
            self._engine.metrics.batched(len(request.requests))
            begun = [self._begin(call, each) for each in request.requests]
            outcomes = [_outcome(call, number, each) for number, each in enumerate(begun)]
            return pb.LocalizeBatchResponse(outcomes=outcomes)

    def LocalizeSequence(
        self, request: pb.LocalizeSequenceRequest, context: grpc.ServicerContext
    ) -> pb.LocalizeSequenceResponse:
        """Localize several frames as one.

        Args:
            request: the frames.
            context: of the call.
        """
        with self._answering("LocalizeSequence", context) as call:

            def work() -> Located:
                pictures = [(frame.rgb, frame.depth) for frame in request.frames]
                located = self._engine.localize_sequence(*sequence_from(sequence_request_from(request), pictures))
                call.span.stages(located.answer.timings)
                return located

            return pb.LocalizeSequenceResponse(answer=answer_message(answer_from(call.run(work))))

    def LocalizeStream(
        self, request_iterator: Iterator[pb.LocalizeStreamRequest], context: grpc.ServicerContext
    ) -> Iterator[pb.LocalizeStreamResponse]:
        """Localize the frames of a moving robot, one answer per frame.

        Args:
            request_iterator: the frames.
            context: of the call.
        """
        # A stream holds a thread and memory for its next frame until it ends.
        with self._answering("LocalizeStream", context, lives_long=True) as call, self._memory.stream():
            stream, number = Stream(self._engine), 0
            while (request := self._next_frame(number, request_iterator, context)) is not None:
                yield self._next_of(stream, number, request, call)
                number += 1
                del request  # before the next one is read, because memory is reserved for one

    def ListMaps(self, request: pb.ListMapsRequest, context: grpc.ServicerContext) -> pb.ListMapsResponse:
        """List all mounted maps.

        Args:
            request: empty.
            context: of the call.
        """
        del request
        with self._answering("ListMaps", context):
            registry = self._engine.registry
            entries = [
                map_entry_from(localizer.bundle, registry.versions(localizer.bundle.name)) for localizer in registry
            ]
            return pb.ListMapsResponse(maps=[map_message(entry) for entry in entries])

    def GetStreets(self, request: pb.GetStreetsRequest, context: grpc.ServicerContext) -> pb.GetStreetsResponse:
        """Return the streets of a map as GeoJSON.

        Args:
            request: names the map.
            context: of the call.
        """
        with self._answering("GetStreets", context):
            return pb.GetStreetsResponse(geojson=self._engine.registry.get(request.map).bundle.streets_geojson())

    def GetCoverage(self, request: pb.GetCoverageRequest, context: grpc.ServicerContext) -> pb.GetCoverageResponse:
        """Return the coverage of one map or of all maps as GeoJSON.

        Args:
            request: names the map, or none for all.
            context: of the call.
        """
        with self._answering("GetCoverage", context), self._engine.memory.hold() as hold:
            registry = self._engine.registry
            localizers = [registry.get(request.map)] if request.HasField("map") else list(registry)
            collection = coverage_geojson([localizer.bundle for localizer in localizers], hold)
            return pb.GetCoverageResponse(geojson=collection)

    def _localize(self, request: pb.LocalizeRequest, span: RequestSpan) -> pb.LocalizeResponse:
        query = query_from(request_from(request), rgb=request.rgb, depth=request.depth)
        located = self._engine.localize(query)
        span.stages(located.answer.timings)
        return answer_message(answer_from(located))

    def _begin(self, call: Call, request: pb.LocalizeRequest) -> Future[pb.LocalizeResponse]:
        """Submit one request of a batch. A refused request returns a failed future."""
        try:
            return call.submit(lambda: self._localize(request, call.span))
        except BusyError as error:
            refused: Future[pb.LocalizeResponse] = Future()
            refused.set_exception(error)
            return refused

    def _next_frame(
        self, number: int, requests: Iterator[pb.LocalizeStreamRequest], context: grpc.ServicerContext
    ) -> pb.LocalizeStreamRequest | None:
        """Read the next message; None at the end of the stream.

        Raises:
            RequestError: its bytes do not parse.
        """
        with fields_under(f"frame {number}"):
            try:
                with self._watchdog.time_limit(self._engine.settings.grpc_idle_s, context.cancel):
                    return next(requests, None)
            except RequestError as error:
                error.field = error.field.removeprefix(
                    "frame."
                )  # errors of a frame that parses name their fields without it
                raise

    def _next_of(
        self, stream: Stream, number: int, request: pb.LocalizeStreamRequest, call: Call
    ) -> pb.LocalizeStreamResponse:
        def work() -> tuple[Located, int]:
            frame = request.frame
            query = query_from(request_from(frame), rgb=frame.rgb, depth=frame.depth)
            odometry = None
            if request.HasField("previous_from_camera"):
                name = "previous_from_camera"
                with fields_under(name):
                    odometry = transform_of(transform_from(request.previous_from_camera), name)
            std = None
            if request.HasField("odometry_std"):
                with fields_under("odometry_std"):
                    std = odometry_std_from(request.odometry_std)
            std_of_step = odometry_std_of(std, "odometry_std", known=odometry is not None)
            located, frames = stream.localize(query, odometry, std_of_step)
            call.span.stages(located.answer.timings)
            return located, frames

        began, code = perf_counter(), "OK"
        call.begin_again()
        try:
            with fields_under(f"frame {number}"):
                located, frames = call.run(work)
            answer = answer_message(answer_from(located))
            return pb.LocalizeStreamResponse(outcome=pb.Outcome(answer=answer), frames=frames)
        except DeadlineError as error:
            code = error.code
            raise
        except StreetfixError as error:
            code = error.code
            stream.forget()
            return pb.LocalizeStreamResponse(outcome=pb.Outcome(problem=problem_message(error)))
        finally:
            self._engine.metrics.requested("grpc", "LocalizeStream.frame", code, perf_counter() - began)

    def _answering(
        self, method: str, context: grpc.ServicerContext, *, lives_long: bool = False
    ) -> AbstractContextManager[Call]:
        return answering(self._engine, method, context, lives_long=lives_long)


def _outcome(call: Call, number: int, begun: Future[pb.LocalizeResponse]) -> pb.Outcome:
    try:
        with fields_under(f"requests.{number}"):
            return pb.Outcome(answer=call.result(begun))
    except DeadlineError:
        raise
    except StreetfixError as error:
        return pb.Outcome(problem=problem_message(error))
