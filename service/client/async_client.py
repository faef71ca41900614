"""The client for those who do something else meanwhile."""

import asyncio
import random
import time
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar, Unpack

import httpx

from service.client import asking, rest
from service.client.asking import About, AboutSequence, Camera, Depth, Frame, Rgb
from service.client.encode import JPEG_QUALITY, Packing
from service.client.retry import Attempts, RetryPolicy
from service.client.tls import ClientTls
from service.contract.schema import LocalizeAnswer, MapEntry
from service.errors import RefusedError, StreetfixError
from service.imaging.raw16 import Codec

A = TypeVar("A")


class AsyncClient:
    """A service over HTTP, as ``Client`` has it, arguments and errors alike; for one event loop.

    Pictures are encoded in a thread, so that the loop goes on.
    """

    def __init__(
        self, url: str, *, api_key: str | None = None, timeout_s: float = 30.0, retry: RetryPolicy | None = None,
        quality: int | None = JPEG_QUALITY, depth_codec: Codec = "zstd",
        ca: str | Path | None = None, cert: str | Path | None = None, key: str | Path | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep, clock: Callable[[], float] = time.monotonic,
        draw: Callable[[], float] = random.random,
    ) -> None:  # fmt: skip
        self._tls = ClientTls.of(ca, cert, key)
        how = rest.settings_for(url, api_key=api_key, timeout_s=timeout_s, tls=self._tls)
        self._url, self._timeout_s = url, timeout_s
        self._packing = Packing(quality, depth_codec)
        self._policy = retry or RetryPolicy()
        self._sleep, self._clock, self._draw = sleep, clock, draw
        self._http = httpx.AsyncClient(**how, transport=transport)

    async def __aenter__(self) -> Self:
        """Keep connections open inside."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close them."""
        await self.close()

    async def close(self) -> None:
        """Close all connections."""
        await self._http.aclose()

    async def localize(self, rgb: Rgb, depth: Depth, camera: Camera, **about: Unpack[About]) -> LocalizeAnswer:
        """As ``Client.localize``."""
        asked = await asyncio.to_thread(asking.one, rgb, depth, camera, about, self._packing)
        return await self.call(rest.localize(asked))

    async def localize_sequence(self, frames: Sequence[Frame], **about: Unpack[AboutSequence]) -> LocalizeAnswer:
        """As ``Client.localize_sequence``."""
        asked = await asyncio.to_thread(asking.sequence, frames, about, self._packing)
        return await self.call(rest.localize_sequence(asked))

    async def localize_batch(
        self, frames: Sequence[Frame], **about: Unpack[AboutSequence]
    ) -> list[LocalizeAnswer | RefusedError]:
        """As ``Client.localize_batch``."""
        asked = await asyncio.to_thread(asking.several, frames, about, self._packing)
        return await self.call(rest.localize_batch(asked))

    async def maps(self) -> list[MapEntry]:
        """As ``Client.maps``."""
        return await self.call(rest.maps())

    async def streets(self, map_name: str) -> dict[str, Any]:
        """As ``Client.streets``."""
        return await self.call(rest.streets(map_name))

    async def coverage(self) -> dict[str, Any]:
        """As ``Client.coverage``."""
        return await self.call(rest.coverage())

    async def call(self, call: rest.Call[A]) -> A:
        """As ``Client.call``."""
        attempts = Attempts(self._policy, self._clock, self._draw)
        while True:
            try:
                with rest.errors_of_httpx(self._url, self._timeout_s, self._tls):
                    response = await self._http.request(call.method, call.path, files=call.files or None)
                return rest.answer_of(call, response)
            except StreetfixError as error:
                wait_s = attempts.wait_after(error)
            await self._sleep(wait_s)
