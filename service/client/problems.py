"""What a service refuses, as an error of ours, the same through every face."""

from service.errors import RefusedError, UnavailableError


def refused(
    title: str, detail: str, *, problem: str, status: str, field: str = "", request_id: str = "",
    may_come_back: bool = False, retry_after_s: float | None = None,
) -> RefusedError:  # fmt: skip
    """The error for a problem that a service answered with.

    Args:
        title: what kind of problem it is.
        detail: what happened and what to do.
        problem: its code.
        status: as the face spelled it.
        field: at fault.
        request_id: by which the operator finds it.
        may_come_back: the service refused for now only.
        retry_after_s: its advice, if it gave one.
    """
    where = f" [field {field}]" if field else ""
    error = (UnavailableError if may_come_back else RefusedError)(
        f"the service refused: {title}\n  {detail}{where}\n  request id {request_id or 'unknown'}",
        field=field, problem=problem, detail=detail, status=status, request_id=request_id,
    )  # fmt: skip
    if isinstance(error, UnavailableError):
        error.retry_after_s = retry_after_s
    return error
