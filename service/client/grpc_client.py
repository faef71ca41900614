"""The synchronous gRPC client, with the calls and answers of the HTTP client, and the stream of a moving robot."""

import random
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar, Unpack

import grpc

from service.client import grpc_messages, prepare
from service.client.cells import HEADER, cell_of
from service.client.encode import JPEG_QUALITY, Packing
from service.client.epochs import Epochs
from service.client.grpc_errors import errors_of_grpc, refused_in_batch
from service.client.prepare import (
    BatchOptions,
    Camera,
    Depth,
    Frame,
    RequestOptions,
    Rgb,
    SequenceOptions,
    StreamFrame,
    StreamOptions,
)
from service.client.rest import authorization, geojson
from service.client.retry import Attempts, RetryPolicy
from service.client.stream_answer import StreamAnswer
from service.client.stream_call import StreamCall
from service.client.tls import ClientTls
from service.contract.schema import LocalizeAnswer, MapEntry
from service.errors import RefusedError, RequestError, StreetfixError, UnreachableError
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub
from service.imaging.raw16 import Codec

A = TypeVar("A")
M = TypeVar("M")
#: gRPC's own retries are off: they would multiply with those of ``RetryPolicy`` and ignore ``RetryInfo``.
_OPTIONS = (
    ("grpc.enable_retries", 0),
    ("grpc.max_receive_message_length", -1),
    ("grpc.max_send_message_length", -1),
)


class GrpcClient:
    """Synchronous gRPC client of a service, with the methods of ``Client`` and ``localize_stream``.

    Several threads may use it at the same time.

    Args:
        address: address of the service, ``HOST:PORT``.
        api_key: API key, if the service requires one.
        timeout_s: timeout of one whole attempt, seconds. In a stream it is that of one answer.
        retry: when to try again. The default is ``RetryPolicy()``.
        quality: JPEG quality of the colour image, 1 to 100. None sends PNG.
        depth_codec: codec of the raw16 depth image. lz4 needs less processor time on both sides and more bytes than zstd.
        ca: PEM file of the authorities that may have signed the service's certificate. The default is the file of
            ``STREETFIX_CLIENT_CA``, then of ``SSL_CERT_FILE``, then the public authorities.
        cert: PEM file of the client's own certificate, if the service requires one. The default is the file of
            ``STREETFIX_CLIENT_CERT``.
        key: PEM file of the unencrypted private key of ``cert``. The default is the file of ``STREETFIX_CLIENT_KEY``.
        tls: whether to use TLS. None uses TLS if ``ca`` or ``cert`` is given, as an argument or as a variable
            ``STREETFIX_CLIENT_*``.
        credentials: channel credentials that replace all other TLS settings.
        sleep: function that waits for some seconds between attempts.
        clock: function that returns monotonic seconds.
        draw: function that returns a random number in [0, 1).

    Raises:
        RequestError: the address or the timeout is invalid, only one of ``cert`` and ``key`` is given, or TLS files are given
            together with ``credentials`` or ``tls=False``.
        KeysError: a file of ``ca``, ``cert`` or ``key`` cannot be used.
    """

    def __init__(
        self,
        address: str,
        *,
        api_key: str | None = None,
        timeout_s: float = 30.0,
        retry: RetryPolicy | None = None,
        quality: int | None = JPEG_QUALITY,
        depth_codec: Codec = "zstd",
        ca: str | Path | None = None,
        cert: str | Path | None = None,
        key: str | Path | None = None,
        tls: bool | None = None,
        credentials: grpc.ChannelCredentials | None = None,
        sleep: Callable[[float], None] = time.sleep,
        clock: Callable[[], float] = time.monotonic,
        draw: Callable[[], float] = random.random,
    ) -> None:
        host, _, port = address.rpartition(":")
        if not (host and port.isdecimal()) or "/" in address:
            raise RequestError(
                f"address: {address!r} is not a gRPC address; pass HOST:PORT, such as 127.0.0.1:50051", field="address"
            )
        if not timeout_s > 0:
            raise RequestError(
                f"timeout_s: {timeout_s} is not a valid timeout; pass a positive number of seconds", field="timeout_s"
            )
        self._address, self._timeout_s = address, timeout_s
        self._metadata = () if api_key is None else (("authorization", authorization(api_key)),)
        self._packing = Packing(quality, depth_codec)
        self._policy = retry or RetryPolicy()
        self._sleep, self._clock, self._draw = sleep, clock, draw
        self._tls = ClientTls.of(ca, cert, key)
        if self._tls.is_argument and (tls is False or credentials is not None):
            raise RequestError(
                "ca: ca, cert and key exclude tls=False and credentials; pass only one of them", field="ca"
            )
        if credentials is None and (self._tls.is_wanted if tls is None else tls):
            credentials = grpc.ssl_channel_credentials(*self._tls.pems())
        self._speaks_tls = credentials is not None
        self._is_closed = False
        self._channel = (
            grpc.insecure_channel(address, options=_OPTIONS)
            if credentials is None
            else grpc.secure_channel(address, credentials, options=_OPTIONS)
        )
        self._stub = LocalizationServiceStub(self._channel)  # type: ignore[no-untyped-call]  # generated code

    def __enter__(self) -> Self:
        """Return the client. Its channel stays open inside the block."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the channel."""
        self.close()

    def close(self) -> None:
        """Close the channel. Open streams end, and later calls raise ``RequestError``."""
        self._is_closed = True
        self._channel.close()

    def localize(self, rgb: Rgb, depth: Depth, camera: Camera, **about: Unpack[RequestOptions]) -> LocalizeAnswer:
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
        prepared = prepare.one(rgb, depth, camera, about, self._packing)
        cell = cell_of(prepared.document.prior, prepared.document.map, prepared.before)
        message = grpc_messages.request_message(prepared)
        return self._call(self._stub.Localize, message, grpc_messages.answer_of, cell)

    def localize_sequence(self, frames: Sequence[Frame], **about: Unpack[SequenceOptions]) -> LocalizeAnswer:
        """Localize the first frame of a sequence, as ``Client.localize_sequence`` does.

        Args:
            frames: the first frame is the reference. Each further frame needs ``T_reference_camera``, as from odometry.
            **about: optional data; see ``SequenceOptions``.
        """
        prepared = prepare.sequence(frames, about, self._packing)
        cell = cell_of(prepared.document.prior, prepared.document.map, prepared.before)
        message = grpc_messages.sequence_message(prepared)
        return self._call(self._stub.LocalizeSequence, message, lambda got: grpc_messages.answer_of(got.answer), cell)

    def localize_batch(
        self, frames: Sequence[Frame], **about: Unpack[BatchOptions]
    ) -> list[LocalizeAnswer | RefusedError]:
        """Localize a batch of independent queries, as ``Client.localize_batch`` does.

        Args:
            frames: the queries. ``T_reference_camera`` must be None.
            **about: optional data for every query; see ``BatchOptions``.
        """
        prepared = prepare.several(frames, about, self._packing)
        first, message = prepared.document.requests[0], grpc_messages.batch_message(prepared)
        return self._call(self._stub.LocalizeBatch, message, _outcomes, cell_of(first.prior, first.map))

    def localize_stream(
        self, frames: Iterable[StreamFrame], **about: Unpack[StreamOptions]
    ) -> Generator[StreamAnswer | RefusedError, None, None]:
        """Localize a moving robot frame by frame. The service keeps its track as long as the stream is open.

        The generator takes a frame, sends it, waits for its answer, yields the answer, and only then takes the next frame. So the
        iterable may be a live camera. It runs in the thread of the caller, and its errors reach the caller.

        If the service refuses a frame, the generator yields a ``RefusedError`` in the place of its answer. The next frame begins the
        track again. If the connection is lost, or if the service has no room for another stream, the generator opens the stream
        again, sends the frame again and begins the track again. It does so within the limits of ``RetryPolicy``, which hold for each
        frame. ``belief.epoch`` never falls, also over several connections.

        The stream ends with the last frame, with an error, or with ``close()`` of the generator. A ``for`` loop that ends early closes
        the generator when nothing else refers to it.

        Args:
            frames: the frames of one robot, in order.
            **about: optional data that holds for every frame; see ``StreamOptions``.

        Yields:
            For each frame its answer, or the ``RefusedError`` of the service.

        Raises:
            RequestError: a frame is invalid (``field`` names it), or the client is closed. The frames before have their answers.
            RefusedError: the service ended the stream, for example because of a wrong API key.
            UnavailableError: the service still has no room after the last attempt.
            NoAnswerInTimeError: no answer to a frame within ``timeout_s``.
            UnreachableError: the connection is lost, and the last attempt failed.
            TypeError: ``about`` has an unknown key.
        """
        prepare.only_stream_options(about)
        return self._outcomes_of(frames, about)

    def _outcomes_of(
        self, frames: Iterable[StreamFrame], about: StreamOptions
    ) -> Generator[StreamAnswer | RefusedError, None, None]:
        call: StreamCall | None = None
        last: StreamAnswer | None = None
        epochs = Epochs()
        try:
            for number, frame in enumerate(frames):
                prepared = prepare.stream_frame(number, frame, about, self._packing)
                attempts = Attempts(self._policy, self._clock, self._draw)
                while True:
                    begins = call is None
                    try:
                        with self._errors():
                            call = call or self._open_stream(
                                cell_of(prepared.document.prior, prepared.document.map, last)
                            )
                            response = call.ask(grpc_messages.stream_message(prepared, begins=begins))
                            outcome = _frame_outcome(response)
                        break
                    except StreetfixError as error:
                        if call is not None:
                            call.cancel()
                        call = None
                        epochs.interrupt()
                        wait_s = attempts.wait_after(error)
                    self._sleep(wait_s)
                if isinstance(outcome, StreamAnswer):
                    outcome = last = epochs.counted(outcome)
                yield outcome
            if call is not None:
                # Every frame has its answer, so a connection that is lost now takes nothing from the caller.
                with suppress(UnreachableError), self._errors():
                    call.finish()
        finally:
            if call is not None:
                call.cancel()

    def _open_stream(self, cell: str) -> StreamCall:
        self._require_open()
        metadata = self._metadata_of(cell)
        return StreamCall(self._stub.LocalizeStream, metadata, address=self._address, timeout_s=self._timeout_s)

    def maps(self) -> list[MapEntry]:
        """Return all mounted maps, as ``Client.maps`` does."""
        return self._call(
            self._stub.ListMaps, pb.ListMapsRequest(), lambda got: [grpc_messages.map_of(each) for each in got.maps]
        )

    def streets(self, map_name: str) -> dict[str, Any]:
        """Return a map's streets as GeoJSON, as ``Client.streets`` does.

        Args:
            map_name: name of the map.
        """
        return self._call(self._stub.GetStreets, pb.GetStreetsRequest(map=map_name), lambda got: geojson(got.geojson))

    def coverage(self) -> dict[str, Any]:
        """Return the area in which the maps can answer, as ``Client.coverage`` does."""
        return self._call(self._stub.GetCoverage, pb.GetCoverageRequest(), lambda got: geojson(got.geojson))

    def _call(self, method: Callable[..., M], message: object, read: Callable[[M], A], cell: str | None = None) -> A:
        """Call a method until it succeeds or must not be tried again; a proxy may choose the instance by the cell."""
        attempts = Attempts(self._policy, self._clock, self._draw)
        metadata = self._metadata_of(cell)
        while True:
            try:
                self._require_open()
                with self._errors():
                    return read(method(message, timeout=self._timeout_s, metadata=metadata))
            except StreetfixError as error:
                wait_s = attempts.wait_after(error)
            self._sleep(wait_s)

    def _require_open(self) -> None:
        if self._is_closed:
            raise RequestError(
                "client: it is closed; make its calls, and read its streams, inside its with block", field="client"
            )

    def _metadata_of(self, cell: str | None) -> tuple[tuple[str, str], ...]:
        return self._metadata if cell is None else (*self._metadata, (HEADER.lower(), cell))

    def _errors(self) -> AbstractContextManager[None]:
        return errors_of_grpc(self._address, self._timeout_s, self._tls if self._speaks_tls else None)


def _frame_outcome(message: pb.LocalizeStreamResponse) -> StreamAnswer | RefusedError:
    if message.outcome.HasField("answer"):
        return grpc_messages.stream_answer_of(message)
    return refused_in_batch(message.outcome.problem)


def _outcomes(message: pb.LocalizeBatchResponse) -> list[LocalizeAnswer | RefusedError]:
    return [
        grpc_messages.answer_of(each.answer) if each.HasField("answer") else refused_in_batch(each.problem)
        for each in message.outcomes
    ]
