"""The synchronous HTTP client."""

import random
import time
from collections.abc import Callable, Sequence
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


class Client:
    """Synchronous HTTP client of a service. Several threads may use it at the same time.

    Args:
        url: address of the service, ``http://HOST:PORT`` or ``https://HOST:PORT``.
        api_key: API key, if the service requires one.
        timeout_s: timeout of one attempt, seconds. It limits the connection, and the time between two pieces of data.
        retry: when to try again. The default is ``RetryPolicy()``.
        quality: JPEG quality of the colour image, 1 to 100. None sends PNG.
        depth_codec: codec of the raw16 depth image. lz4 needs less processor time on both sides and more bytes than zstd.
        ca: PEM file of the authorities that may have signed the service's certificate. The default is the file of
            ``STREETFIX_CLIENT_CA``, then of ``SSL_CERT_FILE`` and the folder of ``SSL_CERT_DIR``, then the public authorities.
        cert: PEM file of the client's own certificate, if the service requires one. The default is the file of
            ``STREETFIX_CLIENT_CERT``.
        key: PEM file of the unencrypted private key of ``cert``. The default is the file of ``STREETFIX_CLIENT_KEY``.
        transport: httpx transport that replaces sockets, for tests.
        sleep: function that waits for some seconds between attempts.
        clock: function that returns monotonic seconds.
        draw: function that returns a random number in [0, 1).

    Raises:
        RequestError: the address or a number is invalid, TLS files are given for ``http://``, or only one of ``cert`` and
            ``key`` is given.
        KeysError: a file of ``ca``, ``cert`` or ``key`` cannot be used.
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
        transport: httpx.BaseTransport | None = None,
        sleep: Callable[[float], None] = time.sleep,
        clock: Callable[[], float] = time.monotonic,
        draw: Callable[[], float] = random.random,
    ) -> None:
        self._tls = ClientTls.of(ca, cert, key)
        how = rest.settings_for(url, api_key=api_key, timeout_s=timeout_s, tls=self._tls)
        self._url, self._timeout_s = url, timeout_s
        self._packing = Packing(quality, depth_codec)
        self._policy = retry or RetryPolicy()
        self._sleep, self._clock, self._draw = sleep, clock, draw
        self._http = httpx.Client(**how, transport=transport)

    def __enter__(self) -> Self:
        """Return the client. Its connections stay open inside the block."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close all connections."""
        self.close()

    def close(self) -> None:
        """Close all connections."""
        self._http.close()

    def localize(self, rgb: Rgb, depth: Depth, camera: Camera, **about: Unpack[RequestOptions]) -> LocalizeAnswer:
        """Localize one query.

        Args:
            rgb: (H, W, 3), sRGB, or the bytes of a JPEG, PNG or WebP file.
            depth: (H, W), metres along the optical axis as floating-point values, or uint16 (millimetres unless
                ``depth_scale_m`` is given). 0 and NaN mean that nothing was measured. Or the bytes of a 16-bit PNG, TIFF, NPY
                or raw16 file.
            camera: intrinsics of both images, pixels, and their distortion if they are not rectified. Either image may be a
                uniformly resized version of this camera's image.
            **about: optional data; see ``RequestOptions``.

        Raises:
            RequestError: an argument is invalid.
            ExtraMissingError: the package that encodes an array is not installed.
            RefusedError: the service refused the request.
            UnavailableError: the service was temporarily unavailable until the retries ended.
            UnreachableError: no Streetfix service answers, or not in time.
            HandshakeError: TLS failed. The message says what to check.
        """
        return self.call(rest.localize(prepare.one(rgb, depth, camera, about, self._packing)))

    def localize_sequence(self, frames: Sequence[Frame], **about: Unpack[SequenceOptions]) -> LocalizeAnswer:
        """Localize the first frame of a sequence whose relative camera poses are known.

        Args:
            frames: the first frame is the reference. Each further frame needs ``T_reference_camera``, as from odometry.
            **about: optional data; see ``SequenceOptions``.

        Raises:
            StreetfixError: as ``localize``.
        """
        return self.call(rest.localize_sequence(prepare.sequence(frames, about, self._packing)))

    def localize_batch(
        self, frames: Sequence[Frame], **about: Unpack[BatchOptions]
    ) -> list[LocalizeAnswer | RefusedError]:
        """Localize a batch of independent queries.

        Args:
            frames: the queries. ``T_reference_camera`` must be None.
            **about: optional data for every query; see ``BatchOptions``.

        Returns:
            One entry per query in the same order: the answer, or the error with which the service refused this query.

        Raises:
            StreetfixError: as ``localize``, for the batch as a whole.
        """
        return self.call(rest.localize_batch(prepare.several(frames, about, self._packing)))

    def maps(self) -> list[MapEntry]:
        """Return all mounted maps.

        Raises:
            StreetfixError: as ``localize``.
        """
        return self.call(rest.maps())

    def streets(self, map_name: str) -> dict[str, Any]:
        """Return a map's streets as a GeoJSON FeatureCollection.

        The polygons are in map metres, or in WGS-84 if the map is georeferenced.

        Args:
            map_name: name of the map.

        Raises:
            StreetfixError: as ``localize``.
        """
        return self.call(rest.streets(map_name))

    def coverage(self) -> dict[str, Any]:
        """Return the area in which the maps can answer: a GeoJSON FeatureCollection, one MultiPolygon per map.

        Raises:
            StreetfixError: as ``localize``.
        """
        return self.call(rest.coverage())

    def call(self, call: rest.Call[A]) -> A:
        """Send a prepared call and read the response, with retries.

        This is for calls that the other methods do not build, for example with images from files.

        Args:
            call: the prepared HTTP call, for example from ``service.client.rest``.

        Raises:
            StreetfixError: as ``localize``.
        """
        attempts = Attempts(self._policy, self._clock, self._draw)
        while True:
            try:
                with rest.errors_of_httpx(self._url, self._timeout_s, self._tls):
                    response = self._http.request(
                        call.method, call.path, files=call.files or None, headers=call.headers
                    )
                return rest.answer_of(call, response)
            except StreetfixError as error:
                wait_s = attempts.wait_after(error)
            self._sleep(wait_s)
