"""OpenTelemetry spans of requests and their stages.

The service creates its spans itself, because automatic instrumentation of the frameworks costs a third of a request.
It imports OpenTelemetry only if an endpoint is set.
"""

import time
from typing import TYPE_CHECKING

from service.errors import ExtraMissingError, how_to_install
from service.localization.answer import Timings
from service.timing import STAGES

if TYPE_CHECKING:
    from opentelemetry.sdk.trace.export import SpanExporter
    from opentelemetry.trace import Span, Tracer


class RequestSpan:
    """The span of one request. Without a tracer it does nothing.

    Args:
        tracer: creates the spans of the stages; None records nothing.
        span: of the request; None records nothing.
    """

    def __init__(self, tracer: "Tracer | None" = None, span: "Span | None" = None) -> None:
        self._tracer = tracer
        self._span = span

    def stages(self, timings: Timings) -> None:
        """Record a child span for each stage of an answer.

        The spans follow each other. The first one starts ``total_ms`` before now, so call this right after the answer.
        Call it once per answer if a request has several.

        Args:
            timings: of the answer.
        """
        if self._span is None or self._tracer is None or not self._span.is_recording():
            return
        from opentelemetry.trace import set_span_in_context

        inside, at_ns = set_span_in_context(self._span), time.time_ns() - int(1e6 * timings.total_ms)
        for stage in STAGES:
            ms = float(getattr(timings, f"{stage}_ms"))
            child = self._tracer.start_span(stage, context=inside, start_time=at_ns)
            at_ns += int(1e6 * ms)
            child.end(end_time=at_ns)

    def end(self, method: str, code: str, *, failed: bool) -> None:
        """End the span of a request that was answered or refused.

        Args:
            method: operation or call; it becomes the name of the span.
            code: status code, or the code of a problem.
            failed: mark the span as an error.
        """
        if self._span is None:
            return
        self._span.update_name(method)
        self._span.set_attribute("streetfix.code", code)
        if failed:
            from opentelemetry.trace import Status, StatusCode

            self._span.set_status(Status(StatusCode.ERROR))
        self._span.end()


#: Span of a request that is not traced.
NO_SPAN = RequestSpan()


class Tracing:
    """Creates the spans of requests. Use ``open`` to send them to an OpenTelemetry collector.

    Args:
        tracer: of OpenTelemetry.
    """

    def __init__(self, tracer: "Tracer") -> None:
        self._tracer = tracer

    @classmethod
    def open(cls, endpoint: str, *, share: float, exporter: "SpanExporter | None" = None) -> "Tracing":
        """Send spans by OTLP over HTTP.

        Args:
            endpoint: of the collector, as ``http://127.0.0.1:4318/v1/traces``.
            share: 0 to 1, of the requests without a trace context that are traced. For the others the caller decides.
            exporter: used instead of OTLP; None exports by OTLP.

        Raises:
            ExtraMissingError: the extra is not installed.
        """
        try:
            from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
            from opentelemetry.sdk.resources import Resource
            from opentelemetry.sdk.trace import TracerProvider
            from opentelemetry.sdk.trace.export import BatchSpanProcessor
            from opentelemetry.sdk.trace.sampling import ParentBased, TraceIdRatioBased
        except ImportError as error:
            raise ExtraMissingError(
                f"traces_endpoint needs OpenTelemetry; {how_to_install('otel')}, or omit the setting"
            ) from error
        provider = TracerProvider(
            resource=Resource.create({"service.name": "streetfix"}), sampler=ParentBased(TraceIdRatioBased(share))
        )
        provider.add_span_processor(BatchSpanProcessor(exporter or OTLPSpanExporter(endpoint)))  # ends with the process
        return cls(provider.get_tracer("streetfix"))

    def begin(self, face: str, traceparent: str | None) -> RequestSpan:
        """Begin the span of a request.

        Args:
            face: request handler, ``rest`` or ``grpc``.
            traceparent: W3C trace context of the request; None if it has none.
        """
        from opentelemetry.trace import SpanKind
        from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

        context = TraceContextTextMapPropagator().extract({} if traceparent is None else {"traceparent": traceparent})
        span = self._tracer.start_span(face, context=context, kind=SpanKind.SERVER, attributes={"streetfix.face": face})
        return RequestSpan(self._tracer, span)
