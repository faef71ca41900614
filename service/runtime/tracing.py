"""Spans of requests and of their stages, for OpenTelemetry; made by hand, since instrumentation of frameworks costs a third of a request.

Nothing of OpenTelemetry is imported unless an endpoint is set.
"""

import time
from typing import TYPE_CHECKING

from service.errors import ExtraMissingError, how_to_install
from service.localization.answer import Timings

if TYPE_CHECKING:
    from opentelemetry.sdk.trace.export import SpanExporter
    from opentelemetry.trace import Span, Tracer

_STAGES = ("decode", "fuse", "encode", "search", "register")


class RequestSpan:
    """One request's span; without a tracer it does nothing."""

    def __init__(self, tracer: "Tracer | None" = None, span: "Span | None" = None) -> None:
        self._tracer = tracer
        self._span = span

    def stages(self, timings: Timings) -> None:
        """Tell the stages of an answer that was just made, one after the other up to now; a request may have several answers."""
        if self._span is None or self._tracer is None or not self._span.is_recording():
            return
        from opentelemetry.trace import set_span_in_context

        inside, at_ns = set_span_in_context(self._span), time.time_ns() - int(1e6 * timings.total_ms)
        for stage in _STAGES:
            ms = float(getattr(timings, f"{stage}_ms"))
            child = self._tracer.start_span(stage, context=inside, start_time=at_ns)
            at_ns += int(1e6 * ms)
            child.end(end_time=at_ns)

    def end(self, method: str, code: str, *, failed: bool) -> None:
        """It is answered, or refused."""
        if self._span is None:
            return
        self._span.update_name(method)
        self._span.set_attribute("streetfix.code", code)
        if failed:
            from opentelemetry.trace import Status, StatusCode

            self._span.set_status(Status(StatusCode.ERROR))
        self._span.end()


class Tracing:
    """Makes spans; ``open`` sends them to an OpenTelemetry collector."""

    def __init__(self, tracer: "Tracer | None" = None) -> None:
        self._tracer = tracer

    @classmethod
    def open(cls, endpoint: str | None, *, share: float, exporter: "SpanExporter | None" = None) -> "Tracing":
        """Send spans by OTLP over HTTP.

        Args:
            endpoint: of the collector, as ``http://127.0.0.1:4318/v1/traces``; None traces nothing.
            share: of the requests that come without a trace of their own; whether the others are traced says their caller.
            exporter: instead of OTLP.

        Raises:
            ExtraMissingError: the extra is not installed.
        """
        if endpoint is None:
            return cls()
        try:
            from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
            from opentelemetry.sdk.resources import Resource
            from opentelemetry.sdk.trace import TracerProvider
            from opentelemetry.sdk.trace.export import BatchSpanProcessor
            from opentelemetry.sdk.trace.sampling import ParentBased, TraceIdRatioBased
        except ImportError as error:
            raise ExtraMissingError(
                f"traces_endpoint needs OpenTelemetry: {how_to_install('otel')}, or leave it out"
            ) from error
        provider = TracerProvider(
            resource=Resource.create({"service.name": "streetfix"}), sampler=ParentBased(TraceIdRatioBased(share))
        )
        provider.add_span_processor(BatchSpanProcessor(exporter or OTLPSpanExporter(endpoint)))  # ends with the process
        return cls(provider.get_tracer("streetfix"))

    def begin(self, face: str, traceparent: str | None) -> RequestSpan:
        """A request has come; ``traceparent`` is its W3C trace context, if it has one."""
        if self._tracer is None:
            return _NOTHING
        from opentelemetry.trace import SpanKind
        from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

        context = TraceContextTextMapPropagator().extract({} if traceparent is None else {"traceparent": traceparent})
        span = self._tracer.start_span(face, context=context, kind=SpanKind.SERVER, attributes={"streetfix.face": face})
        return RequestSpan(self._tracer, span)


_NOTHING = RequestSpan()
