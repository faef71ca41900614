"""The client that waits for its answers."""

import random
import time
from collections.abc import Callable, Sequence
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


class Client:
    """A service over HTTP; safe to call from several threads.

    Args:
        url: of the service, ``http://HOST:PORT``.
        api_key: where the service asks for one.
        timeout_s: for one attempt: to connect, and between two pieces of what is sent or comes back.
        retry: when to ask again.
        quality: of the JPEG that colour is sent as, 1 to 100; None sends PNG.
        depth_codec: of the raw16 that depth is sent as; lz4 costs both sides less time and the link more bytes than zstd.
        ca: PEM file of the authorities that may have signed the service's certificate; else the file of ``STREETFIX_CLIENT_CA``, of
            ``SSL_CERT_FILE``, and the public authorities.
        cert: PEM file of the client's own certificate, where the service asks for one; else that of ``STREETFIX_CLIENT_CERT``.
        key: PEM file of its private key, not encrypted; else that of ``STREETFIX_CLIENT_KEY``.
        transport: httpx', in place of sockets.
        sleep: waits between attempts.
        clock: monotonic seconds.
        draw: a random number in [0, 1).

    Raises:
        RequestError: the address is none, a number makes no sense, or a certificate lacks its key.
        KeysError: a file of ``ca``, ``cert`` or ``key`` cannot be used.
    """

    def __init__(
        self, url: str, *, api_key: str | None = None, timeout_s: float = 30.0, retry: RetryPolicy | None = None,
        quality: int | None = JPEG_QUALITY, depth_codec: Codec = "zstd",
        ca: str | Path | None = None, cert: str | Path | None = None, key: str | Path | None = None,
        transport: httpx.BaseTransport | None = None,
        sleep: Callable[[float], None] = time.sleep, clock: Callable[[], float] = time.monotonic,
        draw: Callable[[], float] = random.random,
    ) -> None:  # fmt: skip
        self._tls = ClientTls.of(ca, cert, key)
        how = rest.settings_for(url, api_key=api_key, timeout_s=timeout_s, tls=self._tls)
        self._url, self._timeout_s = url, timeout_s
        self._packing = Packing(quality, depth_codec)
        self._policy = retry or RetryPolicy()
        self._sleep, self._clock, self._draw = sleep, clock, draw
        self._http = httpx.Client(**how, transport=transport)

    def __enter__(self) -> Self:
        """Keep connections open inside."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close them."""
        self.close()

    def close(self) -> None:
        """Close all connections."""
        self._http.close()

    def localize(self, rgb: Rgb, depth: Depth, camera: Camera, **about: Unpack[About]) -> LocalizeAnswer:
        """Ask where a pair of pictures was taken.

        Args:
            rgb: (H, W, 3) uint8, sRGB.
            depth: (H, W), metres along the optical axis as floating values, or uint16 (millimetres unless ``depth_scale_m`` says
                otherwise); 0 and NaN where nothing was measured.
            camera: rectified intrinsics, pixels; either picture may be a uniformly resized one of its.
            **about: what else is known; see ``About``.

        Raises:
            RequestError: an argument makes no sense.
            RefusedError: the service answered with a problem.
            UnavailableError: it refused for now, and did so until patience ended.
            UnreachableError: nothing answers.
            HandshakeError: TLS failed; the message says what to check.
        """
        return self.call(rest.localize(asking.one(rgb, depth, camera, about, self._packing)))

    def localize_sequence(self, frames: Sequence[Frame], **about: Unpack[AboutSequence]) -> LocalizeAnswer:
        """Ask where the first of some frames was taken, whose cameras are known against each other, as by odometry.

        Raises:
            StreetfixError: as ``localize``.
        """
        return self.call(rest.localize_sequence(asking.sequence(frames, about, self._packing)))

    def localize_batch(
        self, frames: Sequence[Frame], **about: Unpack[AboutSequence]
    ) -> list[LocalizeAnswer | RefusedError]:
        """Ask where each of some pairs was taken, each on its own; what one is refused with stands in its place.

        Raises:
            StreetfixError: as ``localize``, of the batch as a whole.
        """
        return self.call(rest.localize_batch(asking.several(frames, about, self._packing)))

    def maps(self) -> list[MapEntry]:
        """All mounted maps.

        Raises:
            StreetfixError: as ``localize``.
        """
        return self.call(rest.maps())

    def streets(self, map_name: str) -> dict[str, Any]:
        """A map's streets, a GeoJSON FeatureCollection of polygons in map metres, or WGS-84 where the map is georeferenced.

        Raises:
            StreetfixError: as ``localize``.
        """
        return self.call(rest.streets(map_name))

    def coverage(self) -> dict[str, Any]:
        """Where the maps can answer, a GeoJSON FeatureCollection with a MultiPolygon of each.

        Raises:
            StreetfixError: as ``localize``.
        """
        return self.call(rest.coverage())

    def call(self, call: rest.Call[A]) -> A:
        """Send a call of one's own making, as one with pictures from files, and read what comes back.

        Raises:
            StreetfixError: as ``localize``.
        """
        attempts = Attempts(self._policy, self._clock, self._draw)
        while True:
            try:
                with rest.errors_of_httpx(self._url, self._timeout_s, self._tls):
                    response = self._http.request(call.method, call.path, files=call.files or None)
                return rest.answer_of(call, response)
            except StreetfixError as error:
                wait_s = attempts.wait_after(error)
            self._sleep(wait_s)
