"""The client's error for a refused request, the same over REST and gRPC."""

from service.errors import RefusedError, UnavailableError


def refused(
    title: str,
    detail: str,
    *,
    problem: str,
    status: str,
    field: str = "",
    request_id: str = "",
    may_come_back: bool = False,
    retry_after_s: float | None = None,
) -> RefusedError:
    """Return the error for a problem that the service reported.

    Args:
        title: kind of the problem.
        detail: what happened and what to do.
        problem: code of the problem.
        status: status code of HTTP or gRPC as text. Empty for a query of a gRPC batch.
        field: field of the request that is wrong. Empty if none is.
        request_id: id with which the operator finds the request in the log.
        may_come_back: True if the service refused only temporarily. Then the error is an ``UnavailableError``.
        retry_after_s: advised wait before the next attempt, seconds. None without advice.
    """
    where = f" [field {field}]" if field else ""
    error = (UnavailableError if may_come_back else RefusedError)(
        f"the service refused: {title}\n  {detail}{where}\n  request id {request_id or 'unknown'}",
        field=field,
        problem=problem,
        detail=detail,
        status=status,
        request_id=request_id,
    )
    if isinstance(error, UnavailableError):
        error.retry_after_s = retry_after_s
    return error
