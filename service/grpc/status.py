"""Errors as google.rpc.Status. One table maps the kinds of the exceptions to codes; the details help a client to react."""

import logging
from datetime import timedelta
from typing import NoReturn

import grpc
from google.protobuf.any_pb2 import Any
from google.protobuf.duration_pb2 import Duration
from google.protobuf.message import Message
from google.rpc import code_pb2, error_details_pb2, status_pb2
from grpc_status import rpc_status

from service.errors import Kind, StreetfixError
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb

CODE_OF_KIND: dict[Kind, int] = {
    "invalid": code_pb2.INVALID_ARGUMENT,
    "unsupported": code_pb2.INVALID_ARGUMENT,
    "too_large": code_pb2.OUT_OF_RANGE,  # RESOURCE_EXHAUSTED would make clients retry the same image
    "not_found": code_pb2.NOT_FOUND,
    "unauthorized": code_pb2.UNAUTHENTICATED,
    "forbidden": code_pb2.PERMISSION_DENIED,
    "busy": code_pb2.RESOURCE_EXHAUSTED,
    "not_ready": code_pb2.UNAVAILABLE,
    "deadline": code_pb2.DEADLINE_EXCEEDED,
}
DOMAIN = "streetfix"
RETRY_AFTER = timedelta(seconds=1)

_log = logging.getLogger("streetfix.grpc")


def status_of(error: StreetfixError) -> status_pb2.Status:
    """Convert an error to a status with details. This clears the traceback, which would keep the request in memory.

    Args:
        error: to convert.
    """
    error.__traceback__ = None
    details: list[Message] = [error_details_pb2.ErrorInfo(reason=error.code, domain=DOMAIN)]
    if error.kind in ("invalid", "unsupported", "too_large"):
        violation = error_details_pb2.BadRequest.FieldViolation(field=error.field, description=error.message)
        details.append(error_details_pb2.BadRequest(field_violations=[violation]))
    if error.kind in ("busy", "not_ready"):
        delay = Duration()
        delay.FromTimedelta(RETRY_AFTER)
        details.append(error_details_pb2.RetryInfo(retry_delay=delay))
    return status_pb2.Status(
        code=CODE_OF_KIND[error.kind], message=error.message, details=[_packed(each) for each in details]
    )


def refuse(context: grpc.ServicerContext, error: StreetfixError) -> NoReturn:
    """End the call with an error.

    Args:
        context: of the call.
        error: to send.

    Raises:
        AssertionError: gRPC did not end the call.
    """
    context.abort_with_status(rpc_status.to_status(status_of(error)))
    raise AssertionError("abort returned")


def fail(context: grpc.ServicerContext, error: Exception, request_id: str) -> NoReturn:
    """End the call with an unexpected error. The log gets the traceback; the caller gets only the request id.

    Args:
        context: of the call.
        error: unexpected.
        request_id: of the call.

    Raises:
        AssertionError: gRPC did not end the call.
    """
    _log.error("request_failed request_id=%s", request_id, exc_info=error)
    error.__traceback__ = None  # it would keep the request in memory
    context.abort(
        grpc.StatusCode.INTERNAL,
        f"the service failed on this request; report the request id {request_id} to its operator",
    )
    raise AssertionError("abort returned")


def problem_message(error: StreetfixError) -> pb.Problem:
    """Convert the error of one request among several. This clears the traceback, which would keep the request in memory.

    Args:
        error: to convert.
    """
    error.__traceback__ = None
    title = (type(error).__doc__ or "").strip().splitlines()[0]
    return pb.Problem(code=error.code, title=title, detail=error.message, field=error.field)


def _packed(message: Message) -> Any:
    packed = Any()
    packed.Pack(message)
    return packed
