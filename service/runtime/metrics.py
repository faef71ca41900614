"""What an operator watches, for Prometheus; nothing of a request but its figures."""

from collections.abc import Iterable, Iterator

from prometheus_client import CollectorRegistry, Counter, Histogram
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest
from prometheus_client.gc_collector import GCCollector
from prometheus_client.platform_collector import PlatformCollector
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector

from service.localization.answer import Answer, Timings
from service.maps.reader import MapBundle
from service.runtime.admission import Admission
from service.runtime.map_registry import MapRegistry

CONTENT_TYPE = CONTENT_TYPE_LATEST
_SECONDS = (0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128, 0.256, 0.512, 1.0, 2.0, 5.0, 10.0, 30.0)
_SHARES = (0.01, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 0.999, 1.0)
_STAGES = ("decode", "fuse", "encode", "search", "register")


class Metrics:
    """Counters and histograms of one process, with a registry of their own.

    Args:
        admission: whose queue is watched.
        maps: whose versions are named.
    """

    def __init__(self, admission: Admission, maps: MapRegistry) -> None:
        self._registry = CollectorRegistry()
        for collector in (ProcessCollector, PlatformCollector, GCCollector):
            collector(registry=self._registry)
        self._registry.register(_Now(admission, maps))
        self._requests = Counter(
            "streetfix_requests",
            "Requests answered, by what became of them.",
            ["face", "method", "code"],
            registry=self._registry,
        )
        self._request_seconds = Histogram(
            "streetfix_request_seconds", "From a request's first byte to its answer.", ["face", "method"], buckets=_SECONDS,
            registry=self._registry,
        )  # fmt: skip
        self._stage_seconds = Histogram(
            "streetfix_stage_seconds", "Stages of an answer.", ["stage"], buckets=_SECONDS, registry=self._registry
        )
        self._answers = Counter("streetfix_answers", "Answers by status.", ["map", "status"], registry=self._registry)
        self._confidence = Histogram(
            "streetfix_confidence",
            "Confidence of calibrated answers.",
            ["map"],
            buckets=_SHARES,
            registry=self._registry,
        )
        self._frames = Histogram(
            "streetfix_frames",
            "Picture pairs that an answer rests on.",
            buckets=(1, 2, 3, 4, 5, 8, 16),
            registry=self._registry,
        )

    def answered(self, answer: Answer, bundle: MapBundle, *, frames: int) -> None:
        """Count an answer and its stages."""
        self._answers.labels(bundle.name, answer.status).inc()
        self._frames.observe(frames)
        if answer.confidence is not None:
            self._confidence.labels(bundle.name).observe(answer.confidence)
        for stage in _STAGES:
            self._stage_seconds.labels(stage).observe(_milliseconds(answer.timings, stage) / 1e3)

    def requested(self, face: str, method: str, code: str, seconds: float | None) -> None:
        """Count a request.

        Args:
            face: rest or grpc.
            method: operation or call, one of a few.
            code: status, or the code of a problem.
            seconds: that it took; None where that says nothing, as of a stream's life.
        """
        self._requests.labels(face, method, code).inc()
        if seconds is not None:
            self._request_seconds.labels(face, method).observe(seconds)

    def text(self) -> bytes:
        """In Prometheus' text format."""
        return generate_latest(self._registry)


class _Now(Collector):
    """What is true at the moment of asking."""

    def __init__(self, admission: Admission, maps: MapRegistry) -> None:
        self._admission = admission
        self._maps = maps

    def collect(self) -> Iterator[GaugeMetricFamily]:
        """Queue and maps."""
        admission = self._admission
        yield _gauge("streetfix_working", "Requests that a worker runs now.", admission.working)
        yield _gauge("streetfix_waiting", "Requests that wait for a worker.", admission.waiting)
        yield _gauge("streetfix_capacity", "Requests that may be worked on or wait at once.", admission.capacity)
        maps = GaugeMetricFamily(
            "streetfix_map", "Mounted maps; the value is their number of places.", labels=["map", "version"]
        )
        for localizer in self._maps:
            manifest = localizer.bundle.manifest
            maps.add_metric([manifest.name, manifest.version], manifest.counts.places)
        yield maps

    def describe(self) -> Iterable[GaugeMetricFamily]:
        """Nothing that could clash."""
        return ()


def _gauge(name: str, what: str, value: float) -> GaugeMetricFamily:
    family = GaugeMetricFamily(name, what)
    family.add_metric([], value)
    return family


def _milliseconds(timings: Timings, stage: str) -> float:
    return float(getattr(timings, f"{stage}_ms"))
