"""Convert errors of gRPC calls to ``StreetfixError``."""

from collections.abc import Iterator
from contextlib import contextmanager

import grpc
from google.protobuf.message import Message
from google.rpc import error_details_pb2, status_pb2
from grpc_status import rpc_status

from service.client.problems import refused
from service.client.tls import ClientTls, closed_hint, handshake_error
from service.contract.schema import REQUEST_ID
from service.errors import ForeignServiceError, NoAnswerInTimeError, RefusedError, StreetfixError, UnreachableError
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb


@contextmanager
def errors_of_grpc(address: str, timeout_s: float, tls: ClientTls | None) -> Iterator[None]:
    """Convert the errors of gRPC calls inside the block to ``StreetfixError``.

    Args:
        address: address of the service, for messages.
        timeout_s: timeout of the call, seconds, for messages.
        tls: TLS settings of the client. None if the call does not use TLS.

    Raises:
        HandshakeError: TLS failed.
        RefusedError: the service refused the request.
        NoAnswerInTimeError: the timeout ended.
        UnreachableError: the connection failed.
        ForeignServiceError: the server does not know our calls, or its response violates the contract.
    """
    try:
        yield
    except grpc.RpcError as error:
        raise _of(error, address, timeout_s, tls) from error
    except ValueError as error:
        raise ForeignServiceError(
            f"{address}: the server has another contract ({error}); check the address", field="url"
        ) from error


def no_answer_in_time(address: str, timeout_s: float) -> NoAnswerInTimeError:
    """Return the error for an answer that did not come in time.

    Args:
        address: address of the service.
        timeout_s: the timeout, seconds.
    """
    return NoAnswerInTimeError(
        f"{address}: no answer within {timeout_s:g} s; try again, or raise timeout_s", field="timeout_s"
    )


def refused_in_batch(problem: pb.Problem) -> RefusedError:
    """Return the error for one refused query of a batch, or for one refused frame of a stream.

    Args:
        problem: the problem that the service reported for this query.
    """
    return refused(
        problem.title,
        problem.detail,
        problem=problem.code,
        status="",
        field=problem.field,
        may_come_back=problem.code in ("busy", "not-ready"),
    )


def _of(error: grpc.RpcError, address: str, timeout_s: float, tls: ClientTls | None) -> StreetfixError:
    if not isinstance(error, grpc.Call):
        return UnreachableError(f"{address}: the call failed ({error}); check the address", field="url")
    code, said = error.code(), error.details() or ""
    details = _details(error)
    info = details.get(error_details_pb2.ErrorInfo.DESCRIPTOR.full_name)
    if isinstance(info, error_details_pb2.ErrorInfo):
        return _refused(error, details, info)
    if code == grpc.StatusCode.DEADLINE_EXCEEDED:
        return no_answer_in_time(address, timeout_s)
    if code in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.CANCELLED):
        handshake = None if tls is None else handshake_error(address, said)
        if handshake is not None:
            return handshake
        remedy = "start one with: streetfix serve BUNDLE --grpc-port PORT"
        if "socket closed" in said.lower():
            remedy = closed_hint(speaks_tls=tls is not None, shows_certificate=tls is not None and tls.cert is not None)
        return UnreachableError(f"{address}: no service answers ({said}); {remedy}", field="url")
    if code in (grpc.StatusCode.UNIMPLEMENTED, grpc.StatusCode.UNKNOWN):
        return ForeignServiceError(f"{address}: the server is not Streetfix ({said}); check the address", field="url")
    # Refusals by gRPC itself, such as a message beyond its size limit, and unexpected errors.
    problem = "internal" if code == grpc.StatusCode.INTERNAL else ""
    return refused(code.name, said, problem=problem, status=code.name, request_id=_request_id(error))


def _refused(error: grpc.Call, details: dict[str, Message], info: error_details_pb2.ErrorInfo) -> StreetfixError:
    bad = details.get(error_details_pb2.BadRequest.DESCRIPTOR.full_name)
    fields = bad.field_violations if isinstance(bad, error_details_pb2.BadRequest) else ()
    again = details.get(error_details_pb2.RetryInfo.DESCRIPTOR.full_name)
    wait = again.retry_delay if isinstance(again, error_details_pb2.RetryInfo) else None
    return refused(
        info.reason,
        error.details() or "",
        problem=info.reason,
        status=error.code().name,
        field=fields[0].field if fields else "",
        request_id=_request_id(error),
        may_come_back=wait is not None,
        retry_after_s=None if wait is None else wait.ToTimedelta().total_seconds(),
    )


def _details(error: grpc.Call) -> dict[str, Message]:
    """Return the known details of google.rpc.Status by the full name of their type."""
    try:
        status: status_pb2.Status | None = rpc_status.from_call(error)
    except ValueError:  # status and trailers contradict each other: not our service
        return {}
    found: dict[str, Message] = {}
    for packed in () if status is None else status.details:
        for known in (error_details_pb2.ErrorInfo(), error_details_pb2.BadRequest(), error_details_pb2.RetryInfo()):
            if packed.Unpack(known):
                found[known.DESCRIPTOR.full_name] = known
    return found


def _request_id(error: grpc.Call) -> str:
    return next((str(value) for key, value in error.initial_metadata() or () if key == REQUEST_ID), "")
