"""Prometheus metrics of tiled maps: open tiles, requests of tiles in object storage, and fetches."""

import threading
from collections.abc import Sequence

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from service.localization.localizer import Localizer
from service.maps.tiles import TiledMap

#: Fetches take from milliseconds to minutes.
_SECONDS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 60.0, 120.0, 300.0)
_CALLERS, _RESULTS, _KINDS = ("query", "prefetch"), ("hit", "miss"), ("map", "tile")


class TileMetrics:
    """Counters that exist before the maps open, so that the fetches at the start of a service count too. Threads may share them."""

    def __init__(self) -> None:
        self._requests = Counter(
            "streetfix_tile_requests",
            "Tiles of maps in object storage that a query or the prefetch asked the cache for.",
            ["caller", "cache"],
            registry=None,
        )
        self._seconds = Histogram(
            "streetfix_fetch_seconds",
            "Finished fetches from object storage: shared files of a map, or a tile.",
            ["kind"],
            buckets=_SECONDS,
            registry=None,
        )
        self._bytes = Counter("streetfix_fetch_bytes", "Bytes of finished fetches.", ["kind"], registry=None)
        for caller in _CALLERS:  # every series begins with 0, so a rate shows the first event
            for cache in _RESULTS:
                self._requests.labels(caller, cache)
        for kind in _KINDS:
            self._seconds.labels(kind)
            self._bytes.labels(kind)

    def register(self, registry: CollectorRegistry) -> None:
        """Add the metrics to a registry.

        Args:
            registry: of the service.
        """
        for metric in (self._requests, self._seconds, self._bytes):
            registry.register(metric)

    def requested(self, is_cached: bool, ahead: bool) -> None:
        """Count a request of a tile.

        Args:
            is_cached: whether the tile was in the cache.
            ahead: whether no query waits for it.
        """
        self._requests.labels("prefetch" if ahead else "query", "hit" if is_cached else "miss").inc()

    def fetched(self, kind: str, size: int, seconds: float) -> None:
        """Count a finished fetch.

        Args:
            kind: "map" or "tile".
            size: bytes.
            seconds: duration.
        """
        self._seconds.labels(kind).observe(seconds)
        self._bytes.labels(kind).inc(size)


class OpenTilesGauge:
    """Keeps a gauge at the number of open tiles of each map. Threads may share it.

    Args:
        gauge: with the label ``map``.
    """

    def __init__(self, gauge: Gauge) -> None:
        self._gauge, self._counting = gauge, threading.Lock()
        self._mounted: list[TiledMap] = []
        self._named: set[str] = set()

    def mounted(self, localizers: Sequence[Localizer]) -> None:
        """Count the tiles of these maps from now on, and no others.

        Args:
            localizers: all mounted versions of all maps.
        """
        tiled = [each.bundle for each in localizers if isinstance(each.bundle, TiledMap)]
        with self._counting:
            self._mounted = tiled
        for each in tiled:
            each.tiles.watch(self.count)
        self.count()

    def count(self) -> None:
        """Set the gauge to the present numbers."""
        with self._counting:
            totals = dict.fromkeys(self._named, 0)  # of a map that is gone: several processes cannot remove a label
            for each in self._mounted:
                totals[each.name] = totals.get(each.name, 0) + each.open_tiles
            self._named = set(totals)
            for name, total in totals.items():
                self._gauge.labels(name).set(total)
