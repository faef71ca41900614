"""Two hours of mixed traffic at 60 % of the saturating rate, with TLS, keys, metrics, traces, REST, gRPC and streams.

The result is the slope of the service's anonymous memory. Pages of memory-mapped map files come and go with the
system's cache. The report shows them, but they have no bar.
"""

import asyncio
import csv
import json
import signal
import ssl
import time
from collections import Counter, deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import aiohttp
import grpc
import numpy as np
from numpy.typing import NDArray
from scipy.stats import theilslopes

from benchmarks.report import Report
from benchmarks.serving.bodies import multipart
from benchmarks.serving.guard import Collector, Guard, guard
from benchmarks.serving.hostile import part_of
from benchmarks.serving.machines import Held, Server, held
from benchmarks.serving.ratios import MANY, Site
from model_training.datasets.dataset import Dataset
from model_training.loadtest.payloads import Payload
from service.geometry.rigid import SAME_M, inverse, quaternion_xyzw_from
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub

#: Duration for which the bar holds, minutes.
JUDGED_MINUTES = 120.0
LOAD = 0.6
_CAPACITY_S, _SAMPLE_S, _SCRAPE_S, _TELL_S, _WRITE_S, _TIMEOUT_S = 20.0, 10.0, 15.0, 60.0, 600.0, 30.0
_FRAMES = 3  # frames of a sequence, and requests of a batch
_STREAM_FRAMES = 60
#: Weight of each kind of request, and the number of image pairs that it contains.
_MIX = {
    "rest": (38, 1),
    "grpc": (26, 1),
    "stream": (18, 1),
    "sequence": (3, _FRAMES),
    "batch": (3, _FRAMES),
    "refused": (6, 0),
    "listing": (6, 0),
}


@dataclass
class Tally:
    """Requests and their outcomes.

    Attributes:
        sent: number of requests by kind.
        failed: number of requests without the expected answer, by kind and reason.
        told: the first failures in words.
        positions: position of the first answer to each request, metres; later answers must be equal.
        differ: number of answers that differ.
        spans: spans that the collector had received at the last sample.
    """

    sent: Counter[str] = field(default_factory=Counter)
    failed: Counter[str] = field(default_factory=Counter)
    told: list[str] = field(default_factory=list)
    positions: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    differ: int = 0
    spans: int = 0

    def fail(self, kind: str, reason: str) -> None:
        """Count a request without the expected answer.

        Args:
            kind: kind of the request.
            reason: what went wrong.
        """
        self.failed[f"{kind}: {reason[:60]}"] += 1
        if len(self.told) < 20:
            self.told.append(f"{time.strftime('%H:%M:%S')} {kind}: {reason[:300]}")

    def answered(self, what: str, position: tuple[float, float, float] | None) -> None:
        """Compare an answer's position with the first answer to the same request.

        Args:
            what: name of the request.
            position: position in the map frame, metres; None if the answer has no pose.
        """
        if position is not None:
            first = self.positions.setdefault(what, position)
            self.differ += bool(np.abs(np.subtract(first, position)).max() > SAME_M)


@dataclass(frozen=True, slots=True)
class Sample:
    """Resources of the service at a time.

    Attributes:
        at_s: time since the beginning, seconds.
        held: resources of its processes.
        sent: requests sent so far.
        failed: requests failed so far.
        spans: spans received so far.
    """

    at_s: float
    held: Held
    sent: int
    failed: int
    spans: int


class Traffic:
    """Sends each kind of request to a service with TLS and keys, and checks the answers.

    Args:
        server: the service.
        guarded: certificate and keys.
        site: map and queries.
    """

    def __init__(self, server: Server, guarded: Guard, site: Site) -> None:
        self.tally = Tally()
        self._server, self._guard = server, guarded
        self._singles = site.payloads(refine=True)
        self._retrieval = site.payloads(refine=False)
        self._poses = _poses(site)
        self._turn = count()
        self._frames: asyncio.Queue[int | None] = asyncio.Queue(maxsize=200)
        self._trusted: ssl.SSLContext = guarded.trusted
        self._metadata = (("authorization", f"Bearer {guarded.key}"),)

    @asynccontextmanager
    async def open(self) -> AsyncIterator[None]:
        """Open lasting connections and the stream."""
        headers = {"Authorization": f"Bearer {self._guard.key}", "Accept-Encoding": "identity"}
        timeout = aiohttp.ClientTimeout(total=_TIMEOUT_S)
        connector = aiohttp.TCPConnector(limit=0, ssl=self._trusted)
        async with (
            aiohttp.ClientSession(connector=connector, headers=headers, timeout=timeout) as self._session,
            self._channel() as channel,
        ):
            self._stub = LocalizationServiceStub(channel)  # type: ignore[no-untyped-call]  # generated code
            stream = asyncio.create_task(self._stream())
            try:
                yield
            finally:
                await self._frames.put(None)
                await stream

    def _channel(self) -> grpc.aio.Channel:
        options = (("grpc.max_receive_message_length", -1), ("grpc.use_local_subchannel_pool", 1))
        credentials = grpc.ssl_channel_credentials(self._guard.authority)
        return grpc.aio.secure_channel(self._server.grpc, credentials, options=options)

    async def send(self, kind: str) -> None:
        """Send one request of a kind; count every outcome.

        Args:
            kind: kind of the request.
        """
        number = next(self._turn)
        self.tally.sent[kind] += 1
        try:
            async with asyncio.timeout(2 * _TIMEOUT_S):
                await self._kinds[kind](self, number)
        except grpc.aio.AioRpcError as error:
            self.tally.fail(kind, f"{error.code().name} {error.details()}")
        except TimeoutError:
            self.tally.fail(kind, "no answer in time")
        except (aiohttp.ClientError, OSError, ValueError, KeyError) as error:
            self.tally.fail(kind, repr(error))

    async def rest(self, number: int) -> None:
        """Send one query over REST; one in eight without registration.

        Args:
            number: number of the request.
        """
        name, sent = self._single(number)
        content = await self._post("rest", "/v1/localize", sent.body, sent.content_type)
        if content is not None:
            self.tally.answered(f"rest {name}", _position_of(content))

    async def _grpc(self, number: int) -> None:
        name, sent = self._single(number)
        answer = await self._stub.Localize(sent.message, timeout=_TIMEOUT_S, metadata=self._metadata)
        self.tally.answered(f"grpc {name}", _position_in(answer))

    def _single(self, number: int) -> tuple[str, Payload]:
        which = number % len(self._singles)
        return (
            (f"retrieval {which}", self._retrieval[which])
            if number % 8 == 0
            else (f"full {which}", self._singles[which])
        )

    async def _queue_frame(self, number: int) -> None:
        try:
            self._frames.put_nowait(number)
        except asyncio.QueueFull:
            self.tally.fail("stream", "the stream is 200 frames behind")

    async def _stream(self) -> None:
        """Send the queue's frames on one stream after another; each has its own connection, and every third is cancelled."""
        for turn in count():
            async with self._channel() as channel:
                stub = LocalizationServiceStub(channel)  # type: ignore[no-untyped-call]  # generated code
                call = stub.LocalizeStream(metadata=self._metadata)
                if await self._frames_of(call, _STREAM_FRAMES):
                    return
                if turn % 3 == 2:
                    call.cancel()

    async def _frames_of(self, call: Any, most: int) -> bool:
        """Send frames until the stream is old enough; return whether the traffic has ended."""
        before: int | None = None
        number: int | None = 0
        try:
            for _ in range(most):
                number = await self._frames.get()
                if number is None:
                    break
                which = number % len(self._singles)
                message = pb.LocalizeStreamRequest(frame=self._singles[which].message)
                if before is not None:
                    message.previous_from_camera.CopyFrom(_rigid(inverse(self._poses[before]) @ self._poses[which]))
                async with asyncio.timeout(_TIMEOUT_S):
                    await call.write(message)
                    response = await call.read()
                if not isinstance(response, pb.LocalizeStreamResponse):  # EOF
                    self.tally.fail("stream", f"ended by the service: {await call.code()} {await call.details()}")
                    return False
                if response.outcome.HasField("problem"):
                    self.tally.fail("stream", f"{response.outcome.problem.code} {response.outcome.problem.detail}")
                before = which
            async with asyncio.timeout(_TIMEOUT_S):
                await call.done_writing()
                await call.read()
        except (grpc.aio.AioRpcError, asyncio.InvalidStateError, TimeoutError) as error:
            self.tally.fail("stream", repr(error))
            call.cancel()
        return number is None

    async def _sequence(self, number: int) -> None:
        frames = self._several(number)
        relative = [inverse(self._poses[frames[0]]) @ self._poses[k] for k in frames]
        if number % 2:
            documents = [_document(self._singles[k]) for k in frames]
            told = [
                {name: document[name] for name in ("camera", "depth")}
                | ({} if n == 0 else {"T_reference_camera": _as_json(relative[n])})
                for n, document in enumerate(documents)
            ]
            body, content_type = _multipart({"frames": told}, [self._singles[k].message for k in frames])
            content = await self._post("sequence", "/v1/localize/sequence", body, content_type)
            if content is not None:
                self.tally.answered(f"rest sequence {frames[0]}", _position_of(content))
            return
        message = pb.LocalizeSequenceRequest()
        for n, each in enumerate(self._singles[k].message for k in frames):
            frame = message.frames.add(
                rgb=each.rgb, depth=each.depth, camera=each.camera, depth_format=each.depth_format
            )
            if n:
                frame.reference_from_camera.CopyFrom(_rigid(relative[n]))
        response = await self._stub.LocalizeSequence(message, timeout=_TIMEOUT_S, metadata=self._metadata)
        self.tally.answered(f"grpc sequence {frames[0]}", _position_in(response.answer))

    async def _batch(self, number: int) -> None:
        frames = self._several(number)
        messages = [self._singles[k].message for k in frames]
        if number % 2:
            body, content_type = _multipart({"requests": [_document(self._singles[k]) for k in frames]}, messages)
            content = await self._post("batch", "/v1/localize/batch", body, content_type)
            problems = (
                [] if content is None else [each["problem"] for each in content["outcomes"] if each.get("problem")]
            )
            told = [each["code"] for each in problems]
        else:
            request = pb.LocalizeBatchRequest(requests=messages)
            response = await self._stub.LocalizeBatch(request, timeout=_TIMEOUT_S, metadata=self._metadata)
            told = [each.problem.code for each in response.outcomes if each.HasField("problem")]
        if told:
            self.tally.fail("batch", ", ".join(told))

    def _several(self, number: int) -> list[int]:
        return [(number + k) % len(self._singles) for k in range(_FRAMES)]

    async def _refused(self, number: int) -> None:
        """Send requests that must be refused, over REST and gRPC: an invalid key and an invalid image."""
        sent = self._singles[number % len(self._singles)]
        broken = pb.LocalizeRequest()
        broken.CopyFrom(sent.message)
        broken.rgb = sent.message.rgb[:300]
        stranger = (("authorization", "Bearer sf_nobody"),)
        which = number % 4
        if which < 2:
            headers = {"Authorization": "Bearer sf_nobody"} if which == 0 else {}
            body, content_type = _multipart(_document(sent), [broken], numbered=False)
            headers["Content-Type"] = content_type
            async with self._session.post(f"{self._server.url}/v1/localize", data=body, headers=headers) as response:
                problem = await response.json(content_type=None)
            wanted, found = ("unauthorized", "undecodable")[which], str(problem.get("code"))
        else:
            message, metadata = (sent.message, stranger) if which == 2 else (broken, self._metadata)
            try:
                await self._stub.Localize(message, timeout=_TIMEOUT_S, metadata=metadata)
                found = "an answer"
            except grpc.aio.AioRpcError as error:
                found = error.code().name
            wanted = ("UNAUTHENTICATED", "INVALID_ARGUMENT")[which - 2]
        if found != wanted:
            self.tally.fail("refused", f"got {found} instead of {wanted}")

    async def _listing(self, number: int) -> None:
        """Send the requests of a load balancer and a console, each on its own connection."""
        if number % 4 == 3:
            async with self._channel() as channel:
                stub = LocalizationServiceStub(channel)  # type: ignore[no-untyped-call]  # generated code
                answer = await stub.ListMaps(pb.ListMapsRequest(), timeout=_TIMEOUT_S, metadata=self._metadata)
            if not answer.maps:
                self.tally.fail("listing", "gRPC names no map")
            return
        path = ("/readyz", "/v1/maps", "/v1/coverage")[number % 4]
        connector = aiohttp.TCPConnector(ssl=self._trusted, force_close=True)
        async with (
            aiohttp.ClientSession(connector=connector, headers=self._session.headers) as session,
            session.get(f"{self._server.url}{path}") as response,
        ):
            await response.read()
        if response.status != 200:
            self.tally.fail("listing", f"{path}: {response.status}")

    async def scrape(self) -> None:
        """Read the metrics as Prometheus does."""
        self.tally.sent["metrics"] += 1
        try:
            async with self._session.get(f"{self._server.url}/metrics") as response:
                text = await response.text()
            if response.status != 200 or "streetfix_requests_total" not in text:
                self.tally.fail("metrics", f"{response.status}")
        except (aiohttp.ClientError, TimeoutError, OSError) as error:
            self.tally.fail("metrics", repr(error))

    async def _post(self, kind: str, path: str, body: bytes, content_type: str) -> dict[str, Any] | None:
        headers = {"Content-Type": content_type}
        async with self._session.post(f"{self._server.url}{path}", data=body, headers=headers) as response:
            content = await response.read()
        if response.status != 200:
            self.tally.fail(kind, f"{response.status} {content[:200].decode('utf-8', 'replace')}")
            return None
        found: dict[str, Any] = json.loads(content)
        return found

    _kinds: dict[str, Callable[["Traffic", int], Awaitable[None]]] = {  # noqa: RUF012  # never changed
        "rest": rest,
        "grpc": _grpc,
        "stream": _queue_frame,
        "sequence": _sequence,
        "batch": _batch,
        "refused": _refused,
        "listing": _listing,
    }


def soak_rows(report: Report, site: Site, *, minutes: float, rate: float | None, core: int | None) -> None:
    """Add rows of memory, descriptors, threads and failures; Ctrl-C ends early and keeps the rows so far.

    Args:
        report: collects the rows; it is written every ten minutes.
        site: map and queries.
        minutes: duration, minutes.
        rate: image pairs per second; None takes 60 % of what one core answers over REST.
        core: core of the service; None for all.
    """
    asyncio.run(_soak(report, site, minutes=minutes, rate=rate, core=core))


async def _soak(report: Report, site: Site, *, minutes: float, rate: float | None, core: int | None) -> None:
    loop, stop = asyncio.get_running_loop(), asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    threads = {} if core is None else {"threads": 1}
    with guard() as guarded:
        async with Collector() as collector:
            settings: dict[str, Any] = (
                guarded.settings | threads | {"traces_endpoint": collector.endpoint, "traces_share": 1}
            )
            server = await asyncio.to_thread(
                lambda: Server(site.bundle, core=core, trusted=guarded.trusted, **settings)
            )
            try:
                await _drive(report, site, server, guarded, collector, stop, minutes=minutes, rate=rate)
            finally:
                await asyncio.to_thread(server.__exit__, None, None, None)
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.remove_signal_handler(number)


async def _drive(
    report: Report,
    site: Site,
    server: Server,
    guarded: Guard,
    collector: Collector,
    stop: asyncio.Event,
    *,
    minutes: float,
    rate: float | None,
) -> None:
    traffic = Traffic(server, guarded, site)
    async with traffic.open():
        capacity = None if rate is not None else await _capacity(traffic, stop)
        aimed = rate if rate is not None else LOAD * (capacity or 0.0)
        print(f"soak: {aimed:.2f} pairs per second for {minutes:g} minutes, process {server.process.pid}", flush=True)
        traffic.tally = tally = Tally()
        samples: list[Sample] = []
        began, first_spans = time.monotonic(), collector.spans

        async def watch() -> None:
            for due in _every(_SAMPLE_S):
                await asyncio.sleep(max(0.0, began + due - time.monotonic()))
                tally.spans = collector.spans - first_spans
                now = await asyncio.to_thread(held, server.process.pid)
                sent, failed = sum(tally.sent.values()), sum(tally.failed.values())
                samples.append(Sample(time.monotonic() - began, now, sent, failed, tally.spans))

        async def scrape() -> None:
            for due in _every(_SCRAPE_S):
                await asyncio.sleep(max(0.0, began + due - time.monotonic()))
                await traffic.scrape()

        async def tell() -> None:
            for due in _every(_TELL_S):
                await asyncio.sleep(max(0.0, began + due - time.monotonic()))
                print(f"soak: {_line(samples, tally)}", flush=True)
                if due % _WRITE_S == 0:
                    _write(report, samples, tally, aimed=aimed, capacity=capacity)

        beside = [asyncio.create_task(each()) for each in (watch, scrape, tell)]
        running: set[asyncio.Task[None]] = set()
        try:
            await _send(traffic, aimed, began + 60 * minutes, stop, running, server, beside)
            await asyncio.gather(*running)
        finally:
            for task in beside:
                task.cancel()
            await asyncio.gather(*beside, return_exceptions=True)
        if server.process.poll() is not None:
            tally.fail("service", f"the service ended with {server.process.returncode}")
        _write(report, samples, tally, aimed=aimed, capacity=capacity)


async def _send(
    traffic: Traffic,
    rate: float,
    until: float,
    stop: asyncio.Event,
    running: set[asyncio.Task[None]],
    server: Server,
    beside: Sequence[asyncio.Task[None]],
) -> None:
    """Send requests that arrive at random and wait for no answer, until the time is over, a signal comes or the service ends."""
    random, kinds = np.random.default_rng(0), list(_MIX)
    weights = np.array([_MIX[kind][0] for kind in kinds], float)
    shares, pairs = weights / weights.sum(), np.array([_MIX[kind][1] for kind in kinds])
    requests_per_s = rate / float(shares @ pairs)
    due = time.monotonic()
    while due < until and not stop.is_set() and server.process.poll() is None:
        for task in beside:
            if task.done():
                task.result()  # a monitoring task has failed, and a soak without monitoring is worthless
        due += float(random.exponential(1 / requests_per_s))
        await asyncio.sleep(max(0.0, due - time.monotonic()))
        task = asyncio.create_task(traffic.send(kinds[int(random.choice(len(kinds), p=shares))]))
        running.add(task)
        task.add_done_callback(running.discard)


async def _capacity(traffic: Traffic, stop: asyncio.Event) -> float:
    """Return the image pairs per second that clients get over REST if they wait for each answer."""
    until, answered = time.monotonic() + _CAPACITY_S, deque[float]()

    async def client(first: int) -> None:
        for number in count(first, MANY):
            if time.monotonic() >= until or stop.is_set():
                return
            await traffic.rest(8 * number + 1)  # never a request without registration
            answered.append(time.monotonic())

    await asyncio.gather(*(client(k) for k in range(MANY)))
    late = [at for at in answered if until - 0.75 * _CAPACITY_S <= at < until]
    return len(late) / (0.75 * _CAPACITY_S)


def _every(seconds: float) -> Iterator[float]:
    return (seconds * number for number in count(1))


def _line(samples: list[Sample], tally: Tally) -> str:
    sent, failed = sum(tally.sent.values()), sum(tally.failed.values())
    if not samples:
        return f"{sent} sent, {failed} failed"
    last = samples[-1]
    return (
        f"{last.at_s / 60:.0f} min, {sent} sent, {failed} failed, {tally.spans} spans, anonymous {last.held.anonymous_mib:.1f} MiB, "
        f"resident {last.held.resident_mib:.0f} MiB, {last.held.descriptors} descriptors, {last.held.threads} threads"
    )


def _write(report: Report, samples: list[Sample], tally: Tally, *, aimed: float, capacity: float | None) -> None:
    """Add the rows, the series of samples and its plot from the data so far."""
    lasted = samples[-1].at_s / 60 if samples else 0.0
    short = (
        None
        if lasted > JUDGED_MINUTES - 1
        else f"the run took only {lasted:.1f} minutes; the bar is for {JUDGED_MINUTES:g}"
    )
    sent = sum(tally.sent.values())
    hours = np.array([each.at_s for each in samples]) / 3600
    series = {
        name: np.array([asdict(each.held)[name] for each in samples])
        for name in ("anonymous_mib", "private_dirty_mib", "resident_mib", "descriptors", "threads")
    }
    half = len(samples) // 2
    first, second = slice(0, half), slice(half, None)

    def slope(name: str, part: slice) -> float | None:
        return _slope(hours[part], series[name][part])

    report.row(
        "soak.slope_mib_per_hour", slope("anonymous_mib", second), "MiB/h", bar=5, better="lower", n=sent, why=short
    )
    report.row("soak.slope_first_half_mib_per_hour", slope("anonymous_mib", first), "MiB/h", n=sent)
    report.row("soak.private_dirty_slope_mib_per_hour", slope("private_dirty_mib", second), "MiB/h", n=sent)
    report.row("soak.resident_slope_mib_per_hour", slope("resident_mib", second), "MiB/h", n=sent)
    report.row("soak.descriptors_slope_per_hour", slope("descriptors", second), "1/h", n=sent)
    report.row("soak.threads_slope_per_hour", slope("threads", second), "1/h", n=sent)
    if samples:
        report.row("soak.anonymous_mib", samples[-1].held.anonymous_mib, "MiB")
        report.row("soak.resident_mib", samples[-1].held.resident_mib, "MiB")
        report.row("soak.descriptors", samples[-1].held.descriptors, "count")
        report.row("soak.threads", samples[-1].held.threads, "count")
    report.row("soak.minutes", lasted, "min")
    report.row("soak.requests", sent, "count")
    report.row(
        "soak.failed_requests",
        sum(tally.failed.values()),
        "count",
        bar=0,
        better="lower",
        n=sent,
        why=f"first: {tally.told[0]}" if tally.told else None,
    )
    report.row("soak.answers_that_differ", tally.differ, "count", bar=0, better="lower", n=sent)
    report.row("soak.spans", tally.spans, "count")
    report.notes["soak"] = {
        "pairs_per_s": round(aimed, 2),
        "capacity_per_s": None if capacity is None else round(capacity, 2),
        "sent": dict(tally.sent),
        "failed": dict(tally.failed),
        "first_failed": tally.told,
    }
    folder = report.folder / "serving"
    folder.mkdir(parents=True, exist_ok=True)
    _write_series(samples, folder / "soak.csv")
    if samples:
        _draw(hours, series, folder / "soak.png")
    print(f"written: {report.write()}", flush=True)


def _slope(hours: NDArray[np.float64], values: NDArray[Any]) -> float | None:
    """Return the Theil-Sen slope, the median over all pairs of samples, which single jumps do not move; None for fewer than three."""
    return float(theilslopes(values, hours).slope) if len(hours) >= 3 else None


def _write_series(samples: list[Sample], path: Path) -> None:
    part = path.with_suffix(".part")
    with part.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(
            [
                "at_s",
                "anonymous_mib",
                "private_dirty_mib",
                "resident_mib",
                "descriptors",
                "threads",
                "sent",
                "failed",
                "spans",
            ]
        )
        for each in samples:
            now = each.held
            memory = (f"{mib:.2f}" for mib in (now.anonymous_mib, now.private_dirty_mib, now.resident_mib))
            writer.writerow(
                [f"{each.at_s:.0f}", *memory, now.descriptors, now.threads, each.sent, each.failed, each.spans]
            )
    part.rename(path)


def _draw(hours: NDArray[np.float64], series: dict[str, NDArray[Any]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 6), layout="constrained")
    above, middle, below = figure.subplots(3, 1, sharex=True)
    above.plot(hours, series["anonymous_mib"], label="anonymous")
    above.plot(hours, series["private_dirty_mib"], "--", label="private dirty")
    middle.plot(hours, series["resident_mib"], label="resident")
    below.plot(hours, series["descriptors"], label="open descriptors")
    below.plot(hours, series["threads"], label="threads")
    for axes, unit in ((above, "MiB"), (middle, "MiB"), (below, "count")):
        axes.set_ylabel(unit)
        axes.grid(visible=True, alpha=0.3)
        axes.legend()
    below.set_xlabel("hours")
    figure.savefig(path, dpi=110)


def _poses(site: Site) -> list[NDArray[np.float64]]:
    """Return the ground-truth poses of the queries that ``Site.payloads`` sends, in their order.

    Raises:
        RuntimeError: the query set has no ground truth, which the odometry needs.
    """
    frames = list(Dataset(site.dataset).queries(site.queries))
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(site.pairs, len(frames))).round().astype(int))
    poses = [frames[k].T_map_camera for k in chosen]
    if any(pose is None for pose in poses):
        raise RuntimeError(f"{site.queries} of {site.dataset} has no true poses; the soak makes odometry from them")
    return [pose for pose in poses if pose is not None]


def _document(sent: Payload) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(part_of(sent.body, b"request"))
    return found


def _multipart(
    document: dict[str, Any], pairs: Sequence[pb.LocalizeRequest], *, numbered: bool = True
) -> tuple[bytes, str]:
    """Return body and content type of a document with the images of some requests."""
    parts = {"request": json.dumps(document).encode()}
    for k, each in enumerate(pairs):
        suffix = str(k) if numbered else ""
        parts |= {f"rgb{suffix}": each.rgb, f"depth{suffix}": each.depth}
    return multipart(parts)


def _as_json(T: NDArray[np.float64]) -> dict[str, dict[str, float]]:
    return {
        "position": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
        "orientation": dict(zip("xyzw", quaternion_xyzw_from(T[:3, :3]).tolist(), strict=True)),
    }


def _rigid(T: NDArray[np.float64]) -> pb.RigidTransform:
    told = _as_json(T)
    return pb.RigidTransform(position=pb.Vector3(**told["position"]), orientation=pb.Quaternion(**told["orientation"]))


def _position_of(answer: dict[str, Any]) -> tuple[float, float, float] | None:
    pose = answer.get("pose")
    return None if pose is None else (pose["position"]["x"], pose["position"]["y"], pose["position"]["z"])


def _position_in(answer: pb.LocalizeResponse) -> tuple[float, float, float] | None:
    if not answer.HasField("pose"):
        return None
    at = answer.pose.position
    return (at.x, at.y, at.z)
