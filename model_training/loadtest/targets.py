"""REST and gRPC for a load generator: send bytes, get an outcome."""

import io
import json
import ssl
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

import aiohttp
import grpc
from yarl import URL

from model_training.loadtest.payloads import Payload
from service.client.tls import ClientTls
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub

_AT_ONCE_BYTES = 2**20


@dataclass(frozen=True, slots=True)
class Reply:
    """Outcome of a request.

    Attributes:
        code: ``ok``, or the failure: a status, ``timeout`` or ``connection``.
        status: status of the answer; None without an answer.
        position_m: position of the answer, metres, map frame; None unless it is LOCALIZED.
        spread_mean_m: mean position of an answer that is not LOCALIZED, metres; only for comparison with other answers
            to the same request.
    """

    code: str
    status: str | None = None
    position_m: tuple[float, float, float] | None = None
    spread_mean_m: tuple[float, float, float] | None = None


class Target(Protocol):
    """A service that answers requests."""

    async def ask(self, payload: Payload, timeout_s: float) -> Reply:
        """Send one request and return its outcome.

        Args:
            payload: the request.
            timeout_s: longest time to wait, seconds.
        """
        ...

    async def __aenter__(self) -> Self:
        """Open connections."""
        ...

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the connections."""
        ...


class Rest:
    """``POST /v1/localize`` by aiohttp, which needs a third of httpx's processor time for such bodies (decision log).

    Args:
        url: address of the service.
        key: API key; None without.
        tls: TLS settings of an ``https`` address; None trusts the public authorities.
    """

    def __init__(self, url: str, *, key: str | None, tls: ClientTls | None = None) -> None:
        self._tls = tls
        self._url = URL(f"{url.rstrip('/')}/v1/localize")
        # Compression gains nothing for a few kilobytes, but some servers compress whenever they may.
        self._headers = {"Accept-Encoding": "identity"}
        if key is not None:
            self._headers["Authorization"] = f"Bearer {key}"

    async def __aenter__(self) -> Self:
        """Open a session without a limit of connections."""
        self._session = aiohttp.ClientSession(
            connector=aiohttp.TCPConnector(limit=0, ssl=self._context()),
            headers=self._headers,
            auto_decompress=False,
            trust_env=self._url.host not in ("127.0.0.1", "localhost", "::1"),
        )
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the session."""
        await self._session.close()

    def _context(self) -> ssl.SSLContext | bool:
        """Return the TLS context; True takes the library's default, which has no effect without TLS."""
        return True if self._tls is None or self._url.scheme != "https" else self._tls.context()

    async def ask(self, payload: Payload, timeout_s: float) -> Reply:
        """Send one request and return its outcome.

        Args:
            payload: the request.
            timeout_s: longest time to wait, seconds.
        """
        # aiohttp writes a stream in pieces. Writing more than a mebibyte of bytes at once would block the event loop.
        body = payload.body if len(payload.body) <= _AT_ONCE_BYTES else io.BytesIO(payload.body)
        try:
            async with self._session.post(
                self._url,
                data=body,
                headers={"Content-Type": payload.content_type},
                timeout=aiohttp.ClientTimeout(total=timeout_s),
            ) as response:
                content = await response.read()
        except TimeoutError:
            return Reply("timeout")
        except aiohttp.ClientError:
            return Reply("connection")
        if response.status != 200:
            return Reply(str(response.status))
        answer = json.loads(content)
        pose, spread = answer["pose"], answer["spread"]
        return Reply(
            "ok",
            answer["status"],
            None if pose is None else _xyz(pose["position"]),
            None if spread is None else _xyz(spread["mean"]),
        )


def _xyz(vector: dict[str, float]) -> tuple[float, float, float]:
    return vector["x"], vector["y"], vector["z"]


class Grpc:
    """``LocalizationService.Localize``.

    Args:
        address: HOST:PORT.
        key: API key; None without.
        tls: TLS settings; None uses no TLS.
    """

    def __init__(self, address: str, *, key: str | None, tls: ClientTls | None = None) -> None:
        self._address = address
        self._credentials = None if tls is None else grpc.ssl_channel_credentials(*tls.pems())
        self._metadata = () if key is None else (("authorization", f"Bearer {key}"),)

    async def __aenter__(self) -> Self:
        """Open a channel."""
        options = (("grpc.max_receive_message_length", -1), ("grpc.max_send_message_length", -1))
        self._channel = (
            grpc.aio.insecure_channel(self._address, options=options)
            if self._credentials is None
            else grpc.aio.secure_channel(self._address, self._credentials, options=options)
        )
        self._stub = LocalizationServiceStub(self._channel)  # type: ignore[no-untyped-call]  # generated code
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the channel."""
        await self._channel.close(grace=None)

    async def ask(self, payload: Payload, timeout_s: float) -> Reply:
        """Send one request and return its outcome.

        Args:
            payload: the request.
            timeout_s: longest time to wait, seconds.
        """
        try:
            answer: pb.LocalizeResponse = await self._stub.Localize(
                payload.message, timeout=timeout_s, metadata=self._metadata
            )
        except grpc.aio.AioRpcError as error:
            code = error.code()
            named = {grpc.StatusCode.DEADLINE_EXCEEDED: "timeout", grpc.StatusCode.UNAVAILABLE: "connection"}
            return Reply(named.get(code, code.name))
        at, mean = answer.pose.position, answer.spread.mean
        status = pb.LocalizationStatus.Name(answer.status).removeprefix("LOCALIZATION_STATUS_")
        return Reply(
            "ok",
            status,
            (at.x, at.y, at.z) if answer.HasField("pose") else None,
            (mean.x, mean.y, mean.z) if answer.HasField("spread") else None,
        )
