"""Sees new bundles in the mounted folders, opens and warms them, and only then lets them serve."""

import logging
import os
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from service.errors import StreetfixError
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.runtime.map_registry import MapRegistry, bundle_paths

_log = logging.getLogger("streetfix.maps")
#: Name, size and time of every file: what tells one content of a folder from another without reading it.
Stamp = tuple[tuple[str, int, int], ...]


class MapWatcher:
    """Looks at folders every so often, and at once when it is told to.

    Args:
        registry: where bundles are mounted.
        paths: bundles, or folders that hold some, as the service was started with.
        warm: called with every new map before it serves, so that its first request is no slower than the next.
        after: called after every look.
    """

    def __init__(
        self,
        registry: MapRegistry,
        paths: Sequence[Path],
        *,
        warm: Callable[[Localizer], None],
        after: Callable[[], None] = lambda: None,
    ) -> None:
        self._registry = registry
        self._paths = tuple(paths)
        self._warm = warm
        self._after = after
        self._stop, self._told = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._seen: dict[Path, Stamp] = {}
        self._failed: dict[Path, Stamp] = {}
        self._holds: dict[Path, tuple[str, str]] = {}  # name and version that were seen at a path
        for version in [each for localizer in registry for each in registry.versions(localizer.bundle.name)]:
            self._saw(version, stamp_of(version.bundle.path))

    def scan(self, *, drop_missing: bool = False) -> list[str]:
        """Mount what is new; what happened, for people.

        Args:
            drop_missing: take out what lies in no folder any more; else it stays, since a folder that is being replaced is missing
                for a moment.
        """
        told = []
        present = self._bundles()
        for path in present:
            stamp = stamp_of(path)
            if self._seen.get(path) == stamp or self._failed.get(path) == stamp:
                continue
            try:
                localizer = Localizer.open(MapBundle.open(path), provider=self._registry.provider)
                self._warm(localizer)
            except Exception as error:  # whatever it is, this bundle does not serve, and the others are looked at
                self._failed[path] = stamp
                told.append(f"{path} is not mounted: {error}")
                _log.warning("map_refused path=%s reason=%s", path, error)
                continue
            self._saw(localizer, stamp)
            self._registry.mount(localizer)
            manifest = localizer.bundle.manifest
            told.append(f"mounted {manifest.name} {manifest.version}")
            _log.warning("map_mounted name=%s version=%s", manifest.name, manifest.version)
        if drop_missing and (dropped := self._drop(present)):
            told += dropped + self.scan()
        return told

    def start(self, interval_s: float) -> None:
        """Look every so many seconds, in a thread of its own."""
        self._thread = threading.Thread(target=self._run, args=(interval_s,), name="streetfix-maps", daemon=True)
        self._thread.start()

    def look_now(self) -> None:
        """Look at once, and take out what is missing; safe to call from a signal handler."""
        self._told.set()

    def stop(self) -> None:
        """End the thread."""
        self._stop.set()
        self._told.set()
        if self._thread is not None:
            self._thread.join(timeout=5.0)  # a map that is being opened must not keep the service from leaving

    def _run(self, interval_s: float) -> None:
        while True:
            told = self._told.wait(interval_s)
            if self._stop.is_set():
                return
            self._told.clear()
            try:
                self.scan(drop_missing=told)
                self._after()
            except Exception:  # a defect here must not end the watching, nor the service
                _log.exception("map_scan_failed")

    def _bundles(self) -> list[Path]:
        found: list[Path] = []
        for path in self._paths:
            try:
                found += bundle_paths(path)
            except StreetfixError:  # empty for the moment
                continue
        return found

    def _saw(self, localizer: Localizer, stamp: Stamp) -> None:
        path, manifest = localizer.bundle.path, localizer.bundle.manifest
        self._seen[path], self._holds[path] = stamp, (manifest.name, manifest.version)

    def _drop(self, present: list[Path]) -> list[str]:
        told = []
        for path in set(self._seen) - set(present):
            del self._seen[path]
            gone = self._holds.pop(path)
            for twin in [each for each, holds in self._holds.items() if holds == gone]:
                self._seen.pop(twin, None)  # it was not mounted beside its twin, and is looked at again
            for localizer in [v for each in self._registry for v in self._registry.versions(each.bundle.name)]:
                bundle = localizer.bundle
                if bundle.path == path:
                    self._registry.unmount(bundle.name, bundle.manifest.version)
                    told.append(f"unmounted {bundle.name} {bundle.manifest.version}")
                    _log.warning("map_unmounted name=%s version=%s", bundle.name, bundle.manifest.version)
        return told


def stamp_of(path: Path) -> Stamp:
    """Of a bundle's folder as it is now."""
    files = []
    # os.walk passes over folders that vanish under it, as those of a bundle that is being removed do.
    for file in (Path(folder) / name for folder, _, names in os.walk(path) for name in names):
        try:
            status = file.stat()
        except OSError:  # being replaced
            continue
        files.append((file.relative_to(path).as_posix(), status.st_size, status.st_mtime_ns))
    return tuple(sorted(files))
