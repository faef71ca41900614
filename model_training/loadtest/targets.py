"""The two faces, as a load generator sees them: bytes out, an outcome back."""

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
    """What came back.

    Attributes:
        code: ``ok``, or what went wrong: a status, ``timeout``, ``connection``.
        status: of the answer, where there is one.
        position_m: of the answer; None unless it is LOCALIZED.
        spread_mean_m: of an answer that is not LOCALIZED; only compared with other answers to the same request.
    """

    code: str
    status: str | None = None
    position_m: tuple[float, float, float] | None = None
    spread_mean_m: tuple[float, float, float] | None = None


class Target(Protocol):
    """Something that answers."""

    async def ask(self, payload: Payload, timeout_s: float) -> Reply:
        """Send one request and wait for what becomes of it."""
        ...

    async def __aenter__(self) -> Self:
        """Open connections."""
        ...

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close them."""
        ...


class Rest:
    """``POST /v1/localize``, by aiohttp: for bodies of this size it takes a third of httpx's processor time (decision log).

    Args:
        url: of the service.
        key: of its API.
        tls: of an ``https`` address; None trusts the public authorities.
    """

    def __init__(self, url: str, *, key: str | None, tls: ClientTls | None = None) -> None:
        self._tls = tls
        self._url = URL(f"{url.rstrip('/')}/v1/localize")
        # Nothing is gained by compressing a few kilobytes, and some servers do it wherever they may.
        self._headers = {"Accept-Encoding": "identity"}
        if key is not None:
            self._headers["Authorization"] = f"Bearer {key}"

    async def __aenter__(self) -> Self:
        """Be ready to open as many connections as it takes."""
        self._session = aiohttp.ClientSession(
            connector=aiohttp.TCPConnector(limit=0, ssl=self._context()), headers=self._headers, auto_decompress=False,
            trust_env=self._url.host not in ("127.0.0.1", "localhost", "::1"),
        )  # fmt: skip
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close them."""
        await self._session.close()

    def _context(self) -> ssl.SSLContext | bool:
        """Of TLS; True takes the library's, which is not asked without TLS."""
        return True if self._tls is None or self._url.scheme != "https" else self._tls.context()

    async def ask(self, payload: Payload, timeout_s: float) -> Reply:
        """Send one request and wait for what becomes of it."""
        # aiohttp writes a stream in pieces: bytes of over a mebibyte would hold up everything else.
        body = payload.body if len(payload.body) <= _AT_ONCE_BYTES else io.BytesIO(payload.body)
        try:
            async with self._session.post(
                self._url, data=body, headers={"Content-Type": payload.content_type},
                timeout=aiohttp.ClientTimeout(total=timeout_s),
            ) as response:  # fmt: skip
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
            "ok", answer["status"], None if pose is None else _xyz(pose["position"]), None if spread is None else _xyz(spread["mean"])
        )  # fmt: skip


def _xyz(vector: dict[str, float]) -> tuple[float, float, float]:
    return vector["x"], vector["y"], vector["z"]


class Grpc:
    """``LocalizationService.Localize``.

    Args:
        address: HOST:PORT.
        key: of its API.
        tls: to speak; None speaks without.
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
        """Close it."""
        await self._channel.close(grace=None)

    async def ask(self, payload: Payload, timeout_s: float) -> Reply:
        """Send one request and wait for what becomes of it."""
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
            "ok", status, (at.x, at.y, at.z) if answer.HasField("pose") else None,
            (mean.x, mean.y, mean.z) if answer.HasField("spread") else None,
        )  # fmt: skip
