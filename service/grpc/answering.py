"""End every call in the same way: request id, status, one count in the metrics and one line in the log."""

from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from time import perf_counter

import grpc

from service.contract.schema import REQUEST_ID, request_id_of
from service.errors import StreetfixError
from service.grpc.call import Call
from service.grpc.memory import held_by_call
from service.grpc.status import fail, refuse
from service.runtime.engine import Engine
from service.runtime.logs import log_request
from service.runtime.tracing import NO_SPAN


@contextmanager
def answering(
    engine: Engine, method: str, context: grpc.ServicerContext, *, lives_long: bool = False
) -> Iterator[Call]:
    """Provide the call inside the context; end it according to the contract if an error is raised, and count it.

    Args:
        engine: provides metrics, traces and limits.
        method: name of the call, without its service.
        context: of the call.
        lives_long: the call is a stream, whose duration is not measured.
    """
    metadata = {name: value for name, value in context.invocation_metadata() if isinstance(value, str)}
    request_id = request_id_of(metadata.get(REQUEST_ID, ""))
    began, code = perf_counter(), "OK"
    span = NO_SPAN if engine.tracing is None else engine.tracing.begin("grpc", metadata.get("traceparent"))
    try:
        context.send_initial_metadata(((REQUEST_ID, request_id),))
        yield Call(
            engine.admission,
            context,
            span,
            timeout_s=engine.settings.request_timeout_s,
            hold=None if lives_long else held_by_call.get(),
        )
    except StreetfixError as error:
        code = error.code
        refuse(context, error)
    except (GeneratorExit, grpc.RpcError):  # the client has disconnected
        code = "CANCELLED"
        raise
    except CancelledError:  # also a disconnected client; gRPC would treat this error as a defect and log a traceback
        code = "CANCELLED"
        context.abort(grpc.StatusCode.CANCELLED, "the client has disconnected")
    except Exception as error:
        code = "INTERNAL"
        fail(context, error, request_id)
    finally:
        seconds = perf_counter() - began
        engine.metrics.requested("grpc", method, code, None if lives_long else seconds)
        span.end(method, code, failed=code in ("INTERNAL", "deadline"))
        log_request(
            face="grpc",
            method=method,
            code=code,
            seconds=seconds,
            request_id=request_id,
            traceparent=metadata.get("traceparent"),
        )
