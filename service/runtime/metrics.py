"""Prometheus metrics of the service. They hold figures of requests, never their content."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest
from prometheus_client.gc_collector import GCCollector
from prometheus_client.metrics_core import Metric
from prometheus_client.multiprocess import MultiProcessCollector
from prometheus_client.platform_collector import PlatformCollector
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector

from service.localization.answer import Answer, Timings
from service.maps.map import Map
from service.runtime.admission import Admission, MemoryBudget
from service.runtime.map_registry import MOST_REFUSED, MapRegistry
from service.runtime.tile_metrics import OpenTilesGauge, TileMetrics
from service.timing import STAGES

CONTENT_TYPE = CONTENT_TYPE_LATEST
_SECONDS = (0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128, 0.256, 0.512, 1.0, 2.0, 5.0, 10.0, 30.0)
_SHARES = (0.01, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 0.999, 1.0)
_FOLDER = "PROMETHEUS_MULTIPROC_DIR"


class Metrics:
    """Counters, gauges and histograms in their own registry.

    They count for one process, or for all workers of a service together. The environment variable
    ``PROMETHEUS_MULTIPROC_DIR`` of the Prometheus client library decides; ``serve --workers`` sets it.

    Args:
        admission: its queue is measured.
        maps: its map versions are reported.
        memory: its reservations are measured.
        tiles: counters of the cache of maps in object storage.
        cached_tiles: returns the number of tiles in this cache for each map.
    """

    def __init__(
        self,
        admission: Admission,
        maps: MapRegistry,
        memory: MemoryBudget,
        tiles: TileMetrics,
        cached_tiles: Callable[[], Mapping[str, int]],
    ) -> None:
        self._registry = CollectorRegistry()
        self._maps = _Maps(maps, cached_tiles)
        tiles.register(self._registry)
        self._is_one_of_several = _FOLDER in os.environ
        if not self._is_one_of_several:
            for collector in (ProcessCollector, PlatformCollector, GCCollector):
                collector(registry=self._registry)
            self._registry.register(self._maps)
        working = self._gauge("streetfix_working", "Requests that a thread works on now.")
        waiting = self._gauge("streetfix_waiting", "Requests that wait for a thread.")
        self._gauge("streetfix_capacity", "Requests that may be worked on or wait at once.").set(admission.capacity)
        admission.watch(working.set, waiting.set)
        held = self._gauge("streetfix_request_memory_bytes", "Memory that is reserved for requests now.")
        memory.watch(held.set)
        self._open_tiles = OpenTilesGauge(
            self._gauge("streetfix_open_tiles", "Open tiles of each tiled map, of all its versions.", ["map"])
        )
        maps.watch(self._open_tiles.mounted)
        self._gauge("streetfix_request_memory_limit_bytes", "Memory that may be reserved for requests.").set(
            memory.limit
        )
        self._requests = Counter(
            "streetfix_requests",
            "Requests answered, by what became of them.",
            ["face", "method", "code"],
            registry=self._registry,
        )
        self._request_seconds = Histogram(
            "streetfix_request_seconds",
            "From a request's first byte to its answer.",
            ["face", "method"],
            buckets=_SECONDS,
            registry=self._registry,
        )
        self._stage_seconds = Histogram(
            "streetfix_stage_seconds", "Stages of an answer.", ["stage"], buckets=_SECONDS, registry=self._registry
        )
        self._answers = Counter("streetfix_answers", "Answers by status.", ["map", "status"], registry=self._registry)
        self._extrapolated = Counter(
            "streetfix_extrapolated",
            "Answers with a confidence feature outside the range of the calibration data, by feature.",
            ["map", "feature"],
            registry=self._registry,
        )
        self._disruptions = Counter(
            "streetfix_disruptions",
            "Rises of a track's epoch: the robot was displaced, or the track began again.",
            ["map"],
            registry=self._registry,
        )
        self._confidence = Histogram(
            "streetfix_confidence",
            "Confidence of calibrated answers.",
            ["map"],
            buckets=_SHARES,
            registry=self._registry,
        )
        self._frames = Histogram(
            "streetfix_frames",
            "Image pairs that an answer uses.",
            buckets=(1, 2, 3, 4, 5, 8, 16),
            registry=self._registry,
        )

        self._batches = Histogram(
            "streetfix_batch_size", "Requests of a batch.", buckets=(1, 2, 4, 8, 16), registry=self._registry
        )

    def _gauge(self, name: str, what: str, labels: Sequence[str] = ()) -> Gauge:
        """Add a gauge. With several processes its value is the sum over the living ones."""
        return Gauge(name, what, labels, registry=self._registry, multiprocess_mode="livesum")

    def answered(self, answer: Answer, bundle: Map, *, frames: int) -> None:
        """Count an answer and its stages.

        Args:
            answer: to count.
            bundle: map that answered.
            frames: number of image pairs that the answer uses.
        """
        self._answers.labels(bundle.name, answer.status).inc()
        self._frames.observe(frames)
        for feature, _ in answer.extrapolated:
            self._extrapolated.labels(bundle.name, feature).inc()
        if answer.confidence is not None:
            self._confidence.labels(bundle.name).observe(answer.confidence)
        for stage in STAGES:
            self._stage_seconds.labels(stage).observe(_milliseconds(answer.timings, stage) / 1e3)

    def disrupted(self, bundle: Map) -> None:
        """Count a rise of a track's epoch.

        Args:
            bundle: map of the track.
        """
        self._disruptions.labels(bundle.name).inc()

    def batched(self, requests: int) -> None:
        """Count a batch.

        Args:
            requests: number of requests in the batch.
        """
        self._batches.observe(requests)

    def requested(self, face: str, method: str, code: str, seconds: float | None) -> None:
        """Count a request.

        Args:
            face: request handler, ``rest`` or ``grpc``.
            method: operation or call, from a small fixed set.
            code: status code, or the code of a problem.
            seconds: duration; None for a long-lived stream, whose duration has no meaning.
        """
        self._requests.labels(face, method, code).inc()
        if seconds is not None:
            self._request_seconds.labels(face, method).observe(seconds)

    def text(self) -> bytes:
        """Return all metrics in the Prometheus text format."""
        if not self._is_one_of_several:
            return generate_latest(self._registry)
        together = CollectorRegistry()
        MultiProcessCollector(together)  # type: ignore[no-untyped-call]  # the library leaves it untyped
        together.register(self._maps)
        together.register(_Processes(Path(os.environ[_FOLDER])))
        return generate_latest(together)


class _Processes(Collector):
    """Processor time, memory and open files, summed over all workers. Every worker counts the pages that they share."""

    _SUMMED = (
        "process_cpu_seconds",
        "process_resident_memory_bytes",
        "process_virtual_memory_bytes",
        "process_open_fds",
    )

    def __init__(self, folder: Path) -> None:
        self._folder = folder  # the client library keeps one file per living worker there

    def collect(self) -> Iterator[Metric]:
        """Yield the sums under the metric names of a single process."""
        pids = {path.stem.rpartition("_")[2] for path in self._folder.glob("gauge_livesum_*.db")}
        found: dict[str, list[Metric]] = {}
        for pid in pids:
            for metric in ProcessCollector(pid=partial(str, pid), registry=None).collect():
                found.setdefault(metric.name, []).append(metric)
        for name in self._SUMMED:
            metrics = found.get(name, [])
            if metrics:
                total = Metric(name, f"{metrics[0].documentation} Of all workers.", metrics[0].type)
                sample = metrics[0].samples[0]
                total.add_sample(sample.name, sample.labels, sum(each.samples[0].value for each in metrics))
                yield total

    def describe(self) -> Iterable[Metric]:
        """Nothing that could clash."""
        return ()


class _Maps(Collector):
    """Mounted maps and refused bundles at the time of the scrape."""

    def __init__(self, maps: MapRegistry, cached_tiles: Callable[[], Mapping[str, int]]) -> None:
        self._maps, self._cached_tiles = maps, cached_tiles

    def collect(self) -> Iterator[GaugeMetricFamily]:
        """Yield the serving version of each map and the bundles that are not mounted."""
        maps = GaugeMetricFamily(
            "streetfix_map", "Mounted maps; the value is their number of places.", labels=["map", "version"]
        )
        for localizer in self._maps:
            manifest = localizer.bundle.manifest
            maps.add_metric([manifest.name, manifest.version], manifest.counts.places)
        yield maps
        cached = GaugeMetricFamily(
            "streetfix_cached_tiles",
            "Tiles of each tiled map from object storage in the cache on the disk, which workers share.",
            labels=["map"],
        )
        for name, count in self._cached_tiles().items():
            cached.add_metric([name], count)
        yield cached
        refused = self._maps.refused
        yield GaugeMetricFamily(
            "streetfix_bundles_refused", "Bundles in the maps folders that are not mounted.", value=len(refused)
        )
        named = GaugeMetricFamily(
            "streetfix_bundle_refused",
            f"1 for each bundle that is not mounted; at most {MOST_REFUSED} are named.",
            labels=["bundle"],
        )
        for name in sorted({each.bundle[:200] for each in refused[:MOST_REFUSED]}):
            named.add_metric([name], 1)
        yield named

    def describe(self) -> Iterable[GaugeMetricFamily]:
        """Nothing that could clash."""
        return ()


def _milliseconds(timings: Timings, stage: str) -> float:
    return float(getattr(timings, f"{stage}_ms"))
