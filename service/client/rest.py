"""Prepare HTTP calls from requests, and convert responses to answers or errors. The clients send the calls."""

import json
import math
import ssl
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any, Generic, TypeVar
from urllib.parse import quote

import httpx
from pydantic import BaseModel, ValidationError

from service.client.cells import HEADER, cell_of
from service.client.prepare import PreparedRequest
from service.client.problems import refused
from service.client.tls import ClientTls, closed_hint, handshake_error, ssl_reason
from service.contract import schema
from service.errors import ForeignServiceError, NoAnswerInTimeError, RefusedError, RequestError, UnreachableError

A = TypeVar("A")
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
#: HTTP statuses of a temporary refusal.
_COME_BACK = (429, 503)


@dataclass(frozen=True, slots=True, eq=False)
class Call(Generic[A]):
    """A prepared HTTP call.

    Attributes:
        method: HTTP method.
        path: path below the service's address.
        read: function that reads the answer from the body of a successful response. It raises ValueError (or
            ValidationError) if the body is not an answer.
        files: parts of a multipart body: file name, content and media type, by part name.
        headers: further headers.
    """

    method: str
    path: str
    read: Callable[[bytes], A]
    files: dict[str, tuple[str, bytes, str]] = field(default_factory=dict)
    headers: dict[str, str] = field(default_factory=dict)


class Problem(BaseModel):
    """A problem that the service reported (RFC 9457). Missing fields keep their defaults.

    Attributes:
        title: kind of the problem.
        detail: what happened and what to do.
        code: code of the problem.
        field: field of the request that is wrong.
        request_id: id with which the operator finds the request in the log.
        status: HTTP status.
    """

    title: str = ""
    detail: str = ""
    code: str = ""
    field: str | None = None
    request_id: str = ""
    status: int = 0


class _Outcome(BaseModel):
    answer: schema.LocalizeAnswer | None = None
    problem: Problem | None = None


class _Outcomes(BaseModel):
    outcomes: list[_Outcome]


def localize(prepared: PreparedRequest[schema.LocalizeRequest]) -> Call[schema.LocalizeAnswer]:
    """Return the call for a single query.

    Args:
        prepared: the request and its encoded images.
    """
    (rgb, depth), *_ = prepared.pictures
    return Call(
        "POST",
        "/v1/localize",
        schema.LocalizeAnswer.model_validate_json,
        _parts(prepared, rgb=rgb, depth=depth),
        {HEADER: cell_of(prepared.document.prior, prepared.document.map, prepared.before)},
    )


def localize_sequence(prepared: PreparedRequest[schema.SequenceRequest]) -> Call[schema.LocalizeAnswer]:
    """Return the call for a sequence.

    Args:
        prepared: the request and its encoded images.
    """
    return Call(
        "POST",
        "/v1/localize/sequence",
        schema.LocalizeAnswer.model_validate_json,
        _numbered(prepared),
        {HEADER: cell_of(prepared.document.prior, prepared.document.map, prepared.before)},
    )


def localize_batch(prepared: PreparedRequest[schema.BatchRequest]) -> Call[list[schema.LocalizeAnswer | RefusedError]]:
    """Return the call for a batch of independent queries.

    Args:
        prepared: the request and its encoded images.
    """

    def read(body: bytes) -> list[schema.LocalizeAnswer | RefusedError]:
        return [_outcome(each) for each in _Outcomes.model_validate_json(body).outcomes]

    first = prepared.document.requests[0]
    cell = cell_of(first.prior, first.map)
    return Call("POST", "/v1/localize/batch", read, _numbered(prepared), {HEADER: cell})


def maps() -> Call[list[schema.MapEntry]]:
    """Return the call for the list of mounted maps."""
    return Call("GET", "/v1/maps", lambda body: schema.MapList.model_validate_json(body).maps)


def streets(map_name: str) -> Call[dict[str, Any]]:
    """Return the call for the GeoJSON of a map's streets.

    Args:
        map_name: name of the map.
    """
    return Call("GET", f"/v1/maps/{quote(map_name, safe='')}/streets", geojson)


def coverage() -> Call[dict[str, Any]]:
    """Return the call for the GeoJSON of the area in which the maps can answer."""
    return Call("GET", "/v1/coverage", geojson)


def geojson(body: bytes) -> dict[str, Any]:
    """Parse a GeoJSON FeatureCollection.

    Args:
        body: the JSON text.

    Raises:
        ValueError: the text is no FeatureCollection.
    """
    found = json.loads(body)
    if not isinstance(found, dict) or found.get("type") != "FeatureCollection":
        raise ValueError("not a FeatureCollection")
    return found


def settings_for(url: str, *, api_key: str | None, timeout_s: float, tls: ClientTls) -> dict[str, Any]:
    """Return the keyword arguments for ``httpx.Client`` and ``httpx.AsyncClient``.

    Args:
        url: address of the service.
        api_key: API key. None sends none.
        timeout_s: timeout of one attempt, seconds.
        tls: TLS settings. They apply only to ``https://``.

    Raises:
        RequestError: the address is invalid, the timeout is not positive, no service has such an API key, or TLS arguments are given for
            ``http://``.
        KeysError: a TLS file cannot be used.
    """
    if not (timeout_s > 0 and math.isfinite(timeout_s)):
        raise RequestError(
            f"timeout_s: {timeout_s} is not a valid timeout; pass a positive number of seconds", field="timeout_s"
        )
    try:
        address = httpx.URL(url)
    except (httpx.InvalidURL, TypeError) as error:
        raise RequestError(f"url: {url!r} is not a URL ({error}); pass http://HOST:PORT", field="url") from error
    if address.scheme not in ("http", "https") or not address.host or "%" in address.host:
        raise RequestError(f"url: {url!r} is not a URL; pass http://HOST:PORT", field="url")
    if address.scheme == "http" and tls.is_argument:
        raise RequestError(f"url: {url!r} has no TLS, but ca, cert or key is given; pass https://", field="url")
    return {
        "base_url": url.rstrip("/"),
        "timeout": timeout_s,
        # Without TLS httpx would still load all public authorities. An empty context saves that time.
        "verify": tls.context() if address.scheme == "https" else ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT),
        "headers": {} if api_key is None else {"Authorization": authorization(api_key)},
        # A proxy of the environment is for other machines. It cannot reach the loopback of this machine.
        "trust_env": address.host not in _LOOPBACK,
    }


def authorization(api_key: str) -> str:
    """Return the value of the header that has the API key.

    Args:
        api_key: API key.

    Raises:
        RequestError: it is empty, or has a character that no key has, such as the line break at the end of a file.
    """
    if not api_key or not api_key.isascii() or not api_key.isprintable() or " " in api_key:
        what = "is empty" if not api_key else "has a space, a line break or another character that no key has"
        raise RequestError(f"api_key: it {what}; pass the key that `streetfix keys` showed", field="api_key")
    return f"Bearer {api_key}"


def answer_of(call: Call[A], response: httpx.Response) -> A:
    """Return the answer of a response.

    Args:
        call: the call that was sent.
        response: its response.

    Raises:
        RefusedError: the service refused the request.
        ForeignServiceError: the response does not come from Streetfix, or follows another contract.
    """
    if not response.is_success:
        raise _problem_of(response)
    try:
        return call.read(response.content)
    except ValueError as error:  # includes ValidationError and JSONDecodeError
        raise ForeignServiceError(
            f"{response.url}: the server is not Streetfix, or has another contract; check the address", field="url"
        ) from error


@contextmanager
def errors_of_httpx(url: str, timeout_s: float, tls: ClientTls) -> Iterator[None]:
    """Convert the errors of httpx inside the block to ``StreetfixError``.

    Args:
        url: address of the service.
        timeout_s: timeout of the attempt, seconds, for messages.
        tls: TLS settings of the client.

    Raises:
        HandshakeError: TLS failed.
        NoAnswerInTimeError: the timeout ended after the connection was made.
        UnreachableError: the connection failed.
        ForeignServiceError: the response cannot be decoded, or has too many redirects.
        RequestError: the request cannot be sent.
    """
    try:
        yield
    except httpx.ConnectTimeout as error:
        raise UnreachableError(
            f"{url}: no connection within {timeout_s:g} s; check the address, and that the service runs", field="url"
        ) from error
    except httpx.TimeoutException as error:
        raise NoAnswerInTimeError(
            f"{url}: no answer within {timeout_s:g} s; try again, or raise timeout_s", field="timeout_s"
        ) from error
    except (httpx.DecodingError, httpx.TooManyRedirects) as error:
        raise ForeignServiceError(
            f"{url}: the server is not Streetfix ({error}); check the address", field="url"
        ) from error
    except (httpx.UnsupportedProtocol, httpx.LocalProtocolError, httpx.InvalidURL, httpx.CookieConflict) as error:
        raise RequestError(
            f"{url}: the request cannot be sent ({error}); check the address and the key", field="url"
        ) from error
    except (httpx.HTTPError, httpx.StreamError) as error:
        reason = str(error) or type(error).__name__
        tls_reason = ssl_reason(error)
        handshake = None if tls_reason is None else handshake_error(url, tls_reason)
        if handshake is not None:
            raise handshake from error
        remedy = "start one with: streetfix serve BUNDLE"
        if not isinstance(error, httpx.ConnectError):
            remedy = closed_hint(speaks_tls=url.startswith("https:"), shows_certificate=tls.cert is not None)
        raise UnreachableError(f"{url}: no service answers ({reason}); {remedy}", field="url") from error


def _problem_of(response: httpx.Response) -> RefusedError:
    try:
        problem = Problem.model_validate_json(response.content)
    except ValidationError:
        problem = Problem()
    may_come_back = response.status_code in _COME_BACK
    if not problem.code and not may_come_back:
        raise ForeignServiceError(
            f"{response.url}: the server (status {response.status_code}) is not Streetfix; check the address",
            field="url",
        )
    return refused(
        problem.title or response.reason_phrase,
        problem.detail,
        problem=problem.code,
        status=str(response.status_code),
        field=problem.field or "",
        request_id=problem.request_id or response.headers.get(schema.REQUEST_ID, ""),
        may_come_back=may_come_back,
        retry_after_s=retry_after_s(response.headers.get("Retry-After")),
    )


def retry_after_s(header: str | None, *, now: datetime | None = None) -> float | None:
    """Return the seconds of a ``Retry-After`` header, or None if the header is missing or malformed.

    Args:
        header: value of the header, a number of seconds or a date (RFC 9110).
        now: current time with time zone, for tests. None reads the clock.
    """
    if header is None:
        return None
    if header.strip().isdecimal():
        return float(header)
    try:
        moment = parsedate_to_datetime(header)
    except ValueError:
        return None
    if moment.tzinfo is None:  # RFC 9110: dates are always in GMT
        moment = moment.replace(tzinfo=UTC)
    return max(0.0, (moment - (now or datetime.now(UTC))).total_seconds())


def _outcome(outcome: _Outcome) -> schema.LocalizeAnswer | RefusedError:
    if outcome.answer is not None:
        return outcome.answer
    if outcome.problem is None:
        raise ValueError("an outcome has neither an answer nor a problem")
    problem = outcome.problem
    return refused(
        problem.title,
        problem.detail,
        problem=problem.code,
        status=str(problem.status),
        field=problem.field or "",
        request_id=problem.request_id,
        may_come_back=problem.status in _COME_BACK,
    )


def _parts(prepared: PreparedRequest[Any], **pictures: bytes) -> dict[str, tuple[str, bytes, str]]:
    files = {name: (name, data, "application/octet-stream") for name, data in pictures.items()}
    document: bytes = prepared.document.model_dump_json(exclude_unset=True).encode()
    return files | {"request": ("request.json", document, "application/json")}


def _numbered(prepared: PreparedRequest[Any]) -> dict[str, tuple[str, bytes, str]]:
    pictures: dict[str, bytes] = {}
    for number, (rgb, depth) in enumerate(prepared.pictures):
        pictures |= {f"rgb{number}": rgb, f"depth{number}": depth}
    return _parts(prepared, **pictures)
