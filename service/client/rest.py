"""Requests of the contract as HTTP, and what comes back as answers or errors of ours; sending is the clients' own."""

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

from service.client.asking import Asked
from service.client.problems import refused
from service.client.tls import ClientTls, closed_hint, handshake_error, ssl_reason
from service.contract import schema
from service.errors import ForeignServiceError, NoAnswerInTimeError, RefusedError, RequestError, UnreachableError

A = TypeVar("A")
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
#: Statuses that say "not now".
_COME_BACK = (429, 503)


@dataclass(frozen=True, slots=True, eq=False)
class Call(Generic[A]):
    """One call.

    Attributes:
        method: of HTTP.
        path: below the service's address.
        read: the answer from the body of a good response; ValueError (or ValidationError) says that it is none.
        files: parts of a multipart body.
    """

    method: str
    path: str
    read: Callable[[bytes], A]
    files: dict[str, tuple[str, bytes, str]] = field(default_factory=dict)


class Problem(BaseModel):
    """What a service refused and why, as far as it said so (RFC 9457)."""

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


def localize(asked: Asked[schema.LocalizeRequest]) -> Call[schema.LocalizeAnswer]:
    """A single pair."""
    (rgb, depth), *_ = asked.pictures
    return Call("POST", "/v1/localize", schema.LocalizeAnswer.model_validate_json, _parts(asked, rgb=rgb, depth=depth))


def localize_sequence(asked: Asked[schema.SequenceRequest]) -> Call[schema.LocalizeAnswer]:
    """Frames as one."""
    return Call("POST", "/v1/localize/sequence", schema.LocalizeAnswer.model_validate_json, _numbered(asked))


def localize_batch(asked: Asked[schema.BatchRequest]) -> Call[list[schema.LocalizeAnswer | RefusedError]]:
    """Pairs each on its own."""

    def read(body: bytes) -> list[schema.LocalizeAnswer | RefusedError]:
        return [_outcome(each) for each in _Outcomes.model_validate_json(body).outcomes]

    return Call("POST", "/v1/localize/batch", read, _numbered(asked))


def maps() -> Call[list[schema.MapEntry]]:
    """All mounted maps."""
    return Call("GET", "/v1/maps", lambda body: schema.MapList.model_validate_json(body).maps)


def streets(map_name: str) -> Call[dict[str, Any]]:
    """GeoJSON of a map's streets."""
    return Call("GET", f"/v1/maps/{quote(map_name, safe='')}/streets", geojson)


def coverage() -> Call[dict[str, Any]]:
    """GeoJSON of where the maps can answer."""
    return Call("GET", "/v1/coverage", geojson)


def geojson(body: bytes) -> dict[str, Any]:
    """A FeatureCollection.

    Raises:
        ValueError: it is none.
    """
    found = json.loads(body)
    if not isinstance(found, dict) or found.get("type") != "FeatureCollection":
        raise ValueError("no FeatureCollection")
    return found


def settings_for(url: str, *, api_key: str | None, timeout_s: float, tls: ClientTls) -> dict[str, Any]:
    """What both of httpx' clients are made with.

    Raises:
        RequestError: the address is none, the time is not positive, or TLS is described for an address without TLS.
        KeysError: a file of TLS cannot be used.
    """
    if not (timeout_s > 0 and math.isfinite(timeout_s)):
        raise RequestError(f"timeout_s: {timeout_s} is no time to wait; give seconds", field="timeout_s")
    try:
        address = httpx.URL(url)
    except (httpx.InvalidURL, TypeError) as error:
        raise RequestError(f"url: {url!r} is no address ({error}); give http://HOST:PORT", field="url") from error
    if address.scheme not in ("http", "https") or not address.host or "%" in address.host:
        raise RequestError(f"url: {url!r} is no address; give http://HOST:PORT", field="url")
    if address.scheme == "http" and tls.is_argument:
        raise RequestError(
            f"url: {url!r} is an address without TLS, but ca, cert or key is given; give https://", field="url"
        )
    return {
        "base_url": url.rstrip("/"), "timeout": timeout_s,
        # Without TLS the library would still load all public authorities; this context trusts nobody.
        "verify": tls.context() if address.scheme == "https" else ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT),
        "headers": {} if api_key is None else {"Authorization": f"Bearer {api_key}"},
        # A proxy named in the environment is for other machines: it could not reach this one's loopback.
        "trust_env": address.host not in _LOOPBACK,
    }  # fmt: skip


def answer_of(call: Call[A], response: httpx.Response) -> A:
    """What a response says.

    Raises:
        RefusedError: a problem.
        ForeignServiceError: it is no response of a Streetfix.
    """
    if not response.is_success:
        raise _problem_of(response)
    try:
        return call.read(response.content)
    except ValueError as error:  # ValidationError and JSONDecodeError among them
        raise ForeignServiceError(
            f"{response.url}: what answers there is no Streetfix, or of another contract; check the address", field="url"
        ) from error  # fmt: skip


@contextmanager
def errors_of_httpx(url: str, timeout_s: float, tls: ClientTls) -> Iterator[None]:
    """Errors of the library as ours.

    Args:
        url: of the service.
        timeout_s: that it had.
        tls: that the client spoke, where the address is one of TLS.

    Raises:
        HandshakeError: TLS failed.
        NoAnswerInTimeError: the time has ended after the service was reached.
        UnreachableError: the connection failed.
        RequestError: the request cannot be sent.
    """
    try:
        yield
    except httpx.ConnectTimeout as error:
        raise UnreachableError(
            f"{url}: no connection within {timeout_s:g} s; is the service there?", field="url"
        ) from error
    except httpx.TimeoutException as error:
        raise NoAnswerInTimeError(
            f"{url}: no answer within {timeout_s:g} s; ask again, or give more timeout_s", field="timeout_s"
        ) from error
    except (httpx.DecodingError, httpx.TooManyRedirects) as error:
        raise ForeignServiceError(
            f"{url}: what answers there is no Streetfix ({error}); check the address", field="url"
        ) from error
    except (httpx.UnsupportedProtocol, httpx.LocalProtocolError, httpx.InvalidURL, httpx.CookieConflict) as error:
        raise RequestError(
            f"{url}: this cannot be sent ({error}); check the address and the key", field="url"
        ) from error
    except (httpx.HTTPError, httpx.StreamError) as error:
        reason = str(error) or type(error).__name__
        told = ssl_reason(error)
        handshake = None if told is None else handshake_error(url, told)
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
            f"{response.url}: what answers there (status {response.status_code}) is no Streetfix; check the address",
            field="url",
        )
    return refused(
        problem.title or response.reason_phrase, problem.detail, problem=problem.code, status=str(response.status_code),
        field=problem.field or "", request_id=problem.request_id or response.headers.get("X-Request-Id", ""),
        may_come_back=may_come_back, retry_after_s=retry_after_s(response.headers.get("Retry-After")),
    )  # fmt: skip


def retry_after_s(header: str | None, *, now: datetime | None = None) -> float | None:
    """Seconds that ``Retry-After`` says, as a number or as a date; None where it says nothing that makes sense."""
    if header is None:
        return None
    if header.strip().isdecimal():
        return float(header)
    try:
        moment = parsedate_to_datetime(header)
    except ValueError:
        return None
    if moment.tzinfo is None:  # RFC 9110: GMT in any case
        moment = moment.replace(tzinfo=UTC)
    return max(0.0, (moment - (now or datetime.now(UTC))).total_seconds())


def _outcome(outcome: _Outcome) -> schema.LocalizeAnswer | RefusedError:
    if outcome.answer is not None:
        return outcome.answer
    if outcome.problem is None:
        raise ValueError("an outcome that is neither an answer nor a problem")
    told = outcome.problem
    return refused(
        told.title, told.detail, problem=told.code, status=str(told.status), field=told.field or "", request_id=told.request_id,
        may_come_back=told.status in _COME_BACK,
    )  # fmt: skip


def _parts(asked: Asked[Any], **pictures: bytes) -> dict[str, tuple[str, bytes, str]]:
    files = {name: (name, data, "application/octet-stream") for name, data in pictures.items()}
    document: bytes = asked.document.model_dump_json(exclude_unset=True).encode()
    return files | {"request": ("request.json", document, "application/json")}


def _numbered(asked: Asked[Any]) -> dict[str, tuple[str, bytes, str]]:
    pictures: dict[str, bytes] = {}
    for number, (rgb, depth) in enumerate(asked.pictures):
        pictures |= {f"rgb{number}": rgb, f"depth{number}": depth}
    return _parts(asked, **pictures)
