"""The two faces, as a load generator sees them: bytes out, an outcome back."""

import json
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

import grpc
import httpx

from model_training.loadtest.payloads import Payload
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub


@dataclass(frozen=True, slots=True)
class Reply:
    """What came back.

    Attributes:
        code: ``ok``, or what went wrong: a status, ``timeout``, ``connection``.
        status: of the answer, where there is one.
        position_m: of the answer.
    """

    code: str
    status: str | None = None
    position_m: tuple[float, float, float] | None = None


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
    """``POST /v1/localize``."""

    def __init__(self, url: str, *, key: str | None) -> None:
        own = httpx.URL(url).host in ("127.0.0.1", "localhost", "::1")
        # Nothing is gained by compressing a few kilobytes, and some servers do it wherever they may.
        self._headers = {"Accept-Encoding": "identity"}
        if key is not None:
            self._headers["Authorization"] = f"Bearer {key}"
        limits = httpx.Limits(max_connections=None, max_keepalive_connections=256)
        self._client = httpx.AsyncClient(base_url=url, limits=limits, trust_env=not own, headers=self._headers)

    async def __aenter__(self) -> Self:
        """Open connections."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close them."""
        await self._client.aclose()

    async def ask(self, payload: Payload, timeout_s: float) -> Reply:
        """Send one request and wait for what becomes of it."""
        try:
            response = await self._client.post(
                "/v1/localize", content=payload.body, headers={"Content-Type": payload.content_type}, timeout=timeout_s
            )
        except httpx.TimeoutException:
            return Reply("timeout")
        except httpx.TransportError:
            return Reply("connection")
        if response.status_code != 200:
            return Reply(str(response.status_code))
        answer = json.loads(response.content)
        at = answer["pose"]["position"]
        return Reply("ok", answer["status"], (at["x"], at["y"], at["z"]))


class Grpc:
    """``LocalizationService.Localize``."""

    def __init__(self, address: str, *, key: str | None) -> None:
        self._address = address
        self._metadata = () if key is None else (("authorization", f"Bearer {key}"),)

    async def __aenter__(self) -> Self:
        """Open a channel."""
        options = (("grpc.max_receive_message_length", -1), ("grpc.max_send_message_length", -1))
        self._channel = grpc.aio.insecure_channel(self._address, options=options)
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
        at = answer.pose.position
        status = pb.LocalizationStatus.Name(answer.status).removeprefix("LOCALIZATION_STATUS_")
        return Reply("ok", status, (at.x, at.y, at.z))
