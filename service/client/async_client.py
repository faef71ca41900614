"""The asynchronous HTTP client, for asyncio programs."""

import asyncio
import random
import time
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar, Unpack

import httpx

from service.client import prepare, rest
from service.client.encode import JPEG_QUALITY, Packing
from service.client.prepare import BatchOptions, Camera, Depth, Frame, RequestOptions, Rgb, SequenceOptions
from service.client.retry import Attempts, RetryPolicy
from service.client.tls import ClientTls
from service.contract.schema import LocalizeAnswer, MapEntry
from service.errors import RefusedError, StreetfixError
from service.imaging.raw16 import Codec

A = TypeVar("A")


class AsyncClient:
    """Asynchronous HTTP client of a service, for one event loop. Arguments and errors are those of ``Client``.

    Images are encoded in a thread, so that the event loop is not blocked.
    """

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        timeout_s: float = 30.0,
        retry: RetryPolicy | None = None,
        quality: int | None = JPEG_QUALITY,
        depth_codec: Codec = "zstd",
        ca: str | Path | None = None,
        cert: str | Path | None = None,
        key: str | Path | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
        clock: Callable[[], float] = time.monotonic,
        draw: Callable[[], float] = random.random,
    ) -> None:
        self._tls = ClientTls.of(ca, cert, key)
        how = rest.settings_for(url, api_key=api_key, timeout_s=timeout_s, tls=self._tls)
        self._url, self._timeout_s = url, timeout_s
        self._packing = Packing(quality, depth_codec)
        self._policy = retry or RetryPolicy()
        self._sleep, self._clock, self._draw = sleep, clock, draw
        self._http = httpx.AsyncClient(**how, transport=transport)

    async def __aenter__(self) -> Self:
        """Return the client. Its connections stay open inside the block."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close all connections."""
        await self.close()

    async def close(self) -> None:
        """Close all connections."""
        await self._http.aclose()

    async def localize(self, rgb: Rgb, depth: Depth, camera: Camera, **about: Unpack[RequestOptions]) -> LocalizeAnswer:
        """Localize one query, as ``Client.localize`` does.

        Args:
            rgb: (H, W, 3), sRGB, or the bytes of a JPEG, PNG or WebP file.
            depth: (H, W), metres along the optical axis as floating-point values, or uint16 (millimetres unless
                ``depth_scale_m`` is given). 0 and NaN mean that nothing was measured. Or the bytes of a 16-bit PNG, TIFF, NPY
                or raw16 file.
            camera: intrinsics of both images, pixels, and their distortion if they are not rectified. Either image may be a
                uniformly resized version of this camera's image.
            **about: optional data; see ``RequestOptions``.
        """
        prepared = await asyncio.to_thread(prepare.one, rgb, depth, camera, about, self._packing)
        return await self.call(rest.localize(prepared))

    async def localize_sequence(self, frames: Sequence[Frame], **about: Unpack[SequenceOptions]) -> LocalizeAnswer:
        """Localize the first frame of a sequence, as ``Client.localize_sequence`` does.

        Args:
            frames: the first frame is the reference. Each further frame needs ``T_reference_camera``, as from odometry.
            **about: optional data; see ``SequenceOptions``.
        """
        prepared = await asyncio.to_thread(prepare.sequence, frames, about, self._packing)
        return await self.call(rest.localize_sequence(prepared))

    async def localize_batch(
        self, frames: Sequence[Frame], **about: Unpack[BatchOptions]
    ) -> list[LocalizeAnswer | RefusedError]:
        """Localize a batch of independent queries, as ``Client.localize_batch`` does.

        Args:
            frames: the queries. ``T_reference_camera`` must be None.
            **about: optional data for every query; see ``BatchOptions``.
        """
        prepared = await asyncio.to_thread(prepare.several, frames, about, self._packing)
        return await self.call(rest.localize_batch(prepared))

    async def maps(self) -> list[MapEntry]:
        """Return all mounted maps, as ``Client.maps`` does."""
        return await self.call(rest.maps())

    async def streets(self, map_name: str) -> dict[str, Any]:
        """Return a map's streets as GeoJSON, as ``Client.streets`` does.

        Args:
            map_name: name of the map.
        """
        return await self.call(rest.streets(map_name))

    async def coverage(self) -> dict[str, Any]:
        """Return the area in which the maps can answer, as ``Client.coverage`` does."""
        return await self.call(rest.coverage())

    async def call(self, call: rest.Call[A]) -> A:
        """Send a prepared call and read the response, with retries, as ``Client.call`` does.

        Args:
            call: the prepared HTTP call, for example from ``service.client.rest``.
        """
        attempts = Attempts(self._policy, self._clock, self._draw)
        while True:
            try:
                with rest.errors_of_httpx(self._url, self._timeout_s, self._tls):
                    response = await self._http.request(
                        call.method, call.path, files=call.files or None, headers=call.headers
                    )
                return rest.answer_of(call, response)
            except StreetfixError as error:
                wait_s = attempts.wait_after(error)
            await self._sleep(wait_s)
