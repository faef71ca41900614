"""Watch the maps folders, at the start and while the service runs. A new bundle is opened and warmed up before it serves."""

import logging
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from service.errors import BundleError, SearchError, StreetfixError
from service.localization.localizer import Localizer
from service.maps.checked_tiles import CheckedTiles
from service.maps.manifest import TILES_FOLDER, Manifest, Tile, read_manifest
from service.maps.store.stored_map import StoredMap
from service.maps.tiles import OPEN_BYTES, LocalTiles, OpenSearch, TiledMap, TileSource, open_map
from service.runtime.map_registry import MapRegistry, Refused, bundle_paths, duplicate_version_error, version_of
from service.runtime.serving_table import Key, MapVersion
from service.runtime.wakeup import Wakeup

_log = logging.getLogger("streetfix.maps")
#: Name, size and mtime of every file. A change reveals new content of a folder without reading the files.
Stamp = tuple[tuple[str, int, int], ...]
#: Seconds between two checks for news of other workers. A check compares two numbers.
_POLL_S = 0.25
#: For a worker that cannot open a version that serves in the others: seconds between two attempts, and the number of attempts after
#: which it also tries unchanged files again.
_RETRY_S, _ROUNDS_UNTIL_ANEW = 1.0, 30


#: Stamp that no folder has.
_NEVER: Stamp = (("", 0, 0),)


class _LoggedTiles:
    """Log why a tile cannot be fetched. The answer to the request does not say so, because the reason has addresses and folders."""

    def __init__(self, tiles: TileSource) -> None:
        self._tiles = tiles
        self.has_failed = False

    @property
    def checked(self) -> CheckedTiles:
        return self._tiles.checked

    def used(self, tile: Tile) -> None:
        self._tiles.used(tile)

    def folder(self, tile: Tile, *, ahead: bool = False) -> Path:
        try:
            return self._tiles.folder(tile, ahead=ahead)
        except StreetfixError as error:
            self.has_failed = self.has_failed or not ahead
            level = logging.INFO if ahead else logging.ERROR  # the request that needs the tile tries again
            _log.log(level, "tile_not_fetched tile=%s reason=%s", tile.folder, error.message)
            raise


@dataclass(frozen=True, slots=True)
class _Bundle:
    """A bundle in a maps folder. Only its manifest was read."""

    path: Path
    stamp: Stamp
    manifest: Manifest

    @property
    def version(self) -> MapVersion:
        return version_of(self.manifest)


class MapWatcher:
    """Scans the maps folders periodically, on request, and when another worker has found something.

    Args:
        registry: where bundles are mounted.
        paths: bundles, or folders of bundles, with which the service was started.
        warm: called with every new map before it serves, so that its first request is as fast as the next. If it raises, the map is
            refused for this reason.
        stored: maps in object storage, with which the service was started. Their folders in the cache are folders of bundles.
        open_tile_bytes: limit of the size of all open tiles of a tiled map, bytes.
        open_search: opens the search of a map of many tiles; None takes the search index of the map.
    """

    def __init__(
        self,
        registry: MapRegistry,
        paths: Sequence[Path],
        *,
        warm: Callable[[Localizer], None],
        stored: Sequence[StoredMap] = (),
        open_tile_bytes: int = OPEN_BYTES,
        open_search: OpenSearch | None = None,
    ) -> None:
        self._registry = registry
        self._stored = {each.folder: each for each in stored}
        self._paths = (*paths, *self._stored)
        self._warm, self._open_tile_bytes, self._open_search = warm, open_tile_bytes, open_search
        self._stop, self._wakeup = threading.Event(), Wakeup()
        self._thread: threading.Thread | None = None
        self._checked = CheckedTiles()  # of all maps in folders
        self._manifests: dict[Path, tuple[Stamp, Manifest]] = {}
        self._failed: dict[Path, tuple[Stamp, StreetfixError]] = {}
        self._due: set[Key] = set()  # versions to unmount
        self._only_current = False  # whether a scan drops all versions of stored maps but the current ones

    def open_first(self, *, strict: bool = False, wait: Callable[[float], object] = time.sleep) -> None:
        """Mount the bundles of the folders when the service starts. ``MapRegistry.refused`` lists those that cannot be opened.

        A worker that joins others opens the versions that are mounted there. It returns when it has every serving version.

        Args:
            strict: fail if any bundle cannot be mounted, or if there is none.
            wait: called with the seconds to wait.

        Raises:
            StreetfixError: there are bundles, but none can be mounted; or ``strict`` is not met. A worker that joins others never
                fails so.
        """
        table = self._registry.table
        if not (table.is_shared and table.read().started):
            # A cache may still have later versions of a map that was rolled back in its store.
            self._only_current = True
            self.scan()
            self._only_current = False
            self._require(strict=strict)
        rounds = 0
        while lacking := self._registry.join():
            if (
                rounds % _ROUNDS_UNTIL_ANEW == 0
            ):  # reading a damaged map at every attempt would take time from the answering workers
                self._failed.clear()
            given_up = self._open_lacking(lacking)
            if not self._registry.join(given_up):
                return
            if given_up and rounds == 0:
                versions = " ".join(f"{name}@{version}" for name, version in sorted(given_up))
                _log.error("worker_waits reason=other workers serve what it cannot open: %s", versions)
            rounds += 1
            wait(_RETRY_S)

    def scan(self, *, drop_missing: bool = False) -> list[str]:
        """Mount new bundles.

        The newest bundles of each map are opened first. A bundle that would not stay mounted is not opened.

        Args:
            drop_missing: unmount versions whose folder is gone, and retry refused bundles. Otherwise such versions stay, because a
                folder is missing for a moment while it is replaced.

        Returns:
            What happened, one readable line per event.
        """
        if drop_missing:
            self._failed.clear()
        bundles = self._bundles()
        if drop_missing:
            self._due = self._missing()
        events = self._mount_new(bundles)
        if dropped := self._drop():
            events += dropped + self._mount_new(bundles)  # older versions may fit now
        self._forget_stored()
        self._tell_refused()
        return events

    def cached_tiles(self) -> dict[str, int]:
        """Return the number of tiles in the cache for each mounted tiled map in object storage, by its name."""
        bundles = [localizer.bundle for localizer in self._registry]
        return {
            bundle.name: self._stored[bundle.path.parent].cached_tiles()
            for bundle in bundles
            if bundle.manifest.tiles and bundle.path.parent in self._stored
        }

    def start(self, interval_s: float) -> None:
        """Start a thread that scans the folders.

        Args:
            interval_s: seconds between two scans.
        """
        self._thread = threading.Thread(target=self._run, args=(interval_s,), name="streetfix-maps", daemon=True)
        self._thread.start()

    def look_now(self) -> None:
        """Request a scan that also unmounts missing versions. Safe to call from a signal handler."""
        self._wakeup.set()

    def stop(self) -> None:
        """End the thread."""
        self._stop.set()
        self._wakeup.set()
        if self._thread is not None:
            self._thread.join(timeout=5.0)  # the service must not wait for a map that is being opened

    def _run(self, interval_s: float) -> None:
        table = self._registry.table
        # A worker that joined others has opened only the mounted versions, so it scans for new ones at once.
        next_look, seen = time.monotonic() + (0.0 if table.is_shared else interval_s), table.read()
        while True:
            patience_s = min(max(0.0, next_look - time.monotonic()), threading.TIMEOUT_MAX)
            signalled = self._wakeup.wait(min(patience_s, _POLL_S) if table.is_shared else patience_s)
            if self._stop.is_set():
                return
            if signalled:
                self._wakeup.clear()
            try:
                if time.monotonic() >= next_look:
                    self._forget_failures_of(table.others_offer())
                before, seen = seen, table.read()
                is_news = seen is not before and bool(self._due or table.others_offer())
                if signalled or is_news or time.monotonic() >= next_look:
                    self.scan(drop_missing=signalled)
                    next_look = time.monotonic() + interval_s
                if table.is_shared and any(seen.offers.values()):
                    table.settle()  # a worker that the others wait for may have ended
            except Exception:  # a defect must not end this thread or the service
                _log.exception("map_scan_failed")

    def _forget_failures_of(self, versions: Iterable[MapVersion]) -> None:
        """Forget failures of versions that other workers have open.

        The others wait for this worker, and the cause may have passed (memory, a network disk).
        """
        keys = {each.key for each in versions}
        for path in [path for path in self._failed if path in self._manifests]:
            if manifest_key(self._manifests[path][1]) in keys:
                _log.warning("map_tried_again path=%s reason=other workers have it open", path)
                del self._failed[path]

    def _mount_new(self, bundles: Iterable[_Bundle]) -> list[str]:
        events = []
        for each in sorted(bundles, key=lambda bundle: bundle.version.made_at, reverse=True):
            if self._is_refused(each.path, each.stamp) or not self._registry.wants(each.version):
                continue
            name, version = each.version.key
            if (error := self._mount(each)) is None:
                events.append(f"mounted {name} {version}")
                # At the start the command line prints the serving maps. Later only the log reports them.
                level = logging.INFO if self._thread is None else logging.WARNING
                _log.log(level, "map_mounted name=%s version=%s", name, version)
            else:
                events.append(f"{each.path} is not mounted: {error}")
        return events

    def _mount(self, bundle: _Bundle) -> StreetfixError | None:
        """Open, warm up and mount a bundle; return the error if that fails."""
        fetching, stamp = None, bundle.stamp
        try:
            if (stored := self._stored.get(bundle.path.parent)) is not None:
                fetching = _LoggedTiles(stored.tiles(bundle.path))
            source = fetching or LocalTiles(bundle.path, self._checked)
            opened = open_map(
                bundle.path, source=source, open_bytes=self._open_tile_bytes, open_search=self._open_search
            )
            localizer = Localizer.open(opened, provider=self._registry.provider)
            self._warm(localizer)
            if isinstance(opened, TiledMap):
                opened.tiles.opens_ahead = True  # the warm-up is a random query, and nobody drives there
            self._registry.mount(localizer)
        except StreetfixError as error:
            # The store or the search server may answer again, so the next scan tries again.
            if isinstance(error, SearchError) or (fetching is not None and fetching.has_failed):
                stamp = _NEVER
            return self._refuse(bundle.path, stamp, error)
        except Exception as error:  # any defect refuses only this bundle; the others are still processed
            _log.exception("map_failed path=%s", bundle.path)
            what = f"{bundle.path}: cannot be opened ({type(error).__name__}); see the log of the service"
            return self._refuse(bundle.path, bundle.stamp, BundleError(what))
        self._failed.pop(bundle.path, None)
        return None

    def _open_lacking(self, lacking: Iterable[MapVersion]) -> frozenset[Key]:
        """Open versions that are mounted in other workers; return those that cannot be opened."""
        wanted = {each.key for each in lacking}
        for each in self._bundles():
            key = each.version.key
            if key in wanted and not self._is_refused(each.path, each.stamp) and self._mount(each) is None:
                wanted.remove(key)
        self._tell_refused()
        return frozenset(wanted)

    def _bundles(self) -> list[_Bundle]:
        """Return the bundles that are in the folders now."""
        found = []
        self._refresh_stored()
        present = self._present()
        self._manifests = {path: known for path, known in self._manifests.items() if path in present}
        for path in present:
            stamp = stamp_of(path)
            if path in self._failed and self._failed[path][0] != stamp:
                del self._failed[path]
            known = self._manifests.get(path)
            if known is None or known[0] != stamp:
                try:
                    known = self._manifests[path] = stamp, read_manifest(path)
                except StreetfixError as error:  # the earlier manifest of this folder stays valid
                    if not self._is_refused(path, stamp):
                        self._refuse(path, stamp, error)
                    continue
            found.append(_Bundle(path, *known))
        return found

    def _present(self) -> list[Path]:
        found: list[Path] = []
        for path in self._paths:
            if path in self._stored:
                found += self._stored[path].versions()
                continue
            try:
                found += bundle_paths(path)
                if self._is_refused(path, ()):
                    del self._failed[path]
            except StreetfixError as error:
                if not self._is_refused(path, ()):
                    self._refuse(path, (), error)
        for gone in set(self._failed) - set(found) - set(self._paths):
            del self._failed[gone]
        return found

    def _refresh_stored(self) -> None:
        """Ask the stores for new versions. If a store does not answer, the versions in the cache stay."""
        for folder, stored in self._stored.items():
            try:
                stored.refresh()
                if self._only_current:
                    stored.forget(())
            except StreetfixError as error:
                if not self._is_refused(folder, ()):
                    self._refuse(folder, (), error)
            else:
                self._failed.pop(folder, None)

    def _forget_stored(self) -> None:
        """Delete versions in the cache that no worker has mounted or offers."""
        table = self._registry.table.read()
        known = [*(known.versions for known in table.maps.values()), *table.offers.values()]
        keep = {version.version for versions in known for version in versions}
        for folder, stored in self._stored.items():
            try:
                stored.forget(keep)
            except StreetfixError as error:
                _log.warning("map_cache_not_deleted path=%s reason=%s", folder, error.message)

    def _missing(self) -> set[Key]:
        """Return mounted versions whose folder is gone.

        A version that was replaced inside its folder does not count, so that an operator can roll back to it.
        """
        present = set(self._present())
        held = {manifest_key(manifest) for path, (_, manifest) in self._manifests.items() if path in present}
        unread = [path for path, (_, error) in self._failed.items() if _is_unreadable(error)]
        open_here = [v.bundle for each in self._registry for v in self._registry.versions(each.bundle.name)]
        return {
            manifest_key(bundle.manifest)
            for bundle in open_here
            if not (
                bundle.path in present
                or manifest_key(bundle.manifest) in held
                or any(map(bundle.path.is_relative_to, unread))
            )
        }

    def _drop(self) -> list[str]:
        """Unmount the due versions that are still missing.

        A serving version stays until the other workers have its successor.
        """
        if not self._due:
            return []
        self._due &= self._missing()
        table, waits = self._registry.table.read(), set[Key]()
        for name, known in table.maps.items():
            left = [each.made_at for each in known.versions if each.key not in self._due]
            offers = [each.made_at for each in table.offers.get(self._registry.table.number, ()) if each.name == name]
            if offers and (not left or max(offers) > max(left)):
                waits.add((name, known.serving))
        gone, self._due = self._due - waits, self._due & waits
        # In one change, so that the next serving version is not one that is gone as well.
        self._registry.table.remove(gone)
        for name, version in sorted(gone):
            _log.warning("map_unmounted name=%s version=%s", name, version)
        return [f"unmounted {name} {version}" for name, version in sorted(gone)]

    def _require(self, *, strict: bool) -> None:
        """Raise the error that prevents the first start, if any."""
        errors = [error for _, error in self._failed.values()]
        if errors and (strict or not self._registry.has_open):
            raise errors[0]
        if strict:
            self._require_no_twins()
            if not self._registry.has_open:
                raise BundleError(
                    f"no map bundle found in {', '.join(map(str, self._paths))}; build one with build-map"
                )

    def _require_no_twins(self) -> None:
        seen: dict[Key, Path] = {}
        for path, (_, manifest) in self._manifests.items():
            other = seen.setdefault(manifest_key(manifest), path)
            if other != path:
                raise duplicate_version_error(path, other, manifest)

    def _is_refused(self, path: Path, stamp: Stamp) -> bool:
        return path in self._failed and self._failed[path][0] == stamp

    def _refuse(self, path: Path, stamp: Stamp, error: StreetfixError) -> StreetfixError:
        self._failed[path] = stamp, error
        _log.warning("map_refused path=%s reason=%s", path, error.message)
        return error

    def _tell_refused(self) -> None:
        """Publish the refused bundles to the request handlers.

        Only the name of the folder is shown, and nothing of a store, because a health probe needs no key.
        """
        self._registry.refused = tuple(
            Refused(path.name or str(path), self._shown(path, error))
            for path, (_, error) in sorted(self._failed.items())
        )

    def _shown(self, path: Path, error: StreetfixError) -> str:
        if path in self._stored or path.parent in self._stored:
            return "it cannot be served from its store; the log of the service says why"
        return error.message.replace(f"{path.parent}{os.sep}", "")


def manifest_key(manifest: Manifest) -> Key:
    """Return the name and version by which requests address a bundle.

    Args:
        manifest: of the bundle.
    """
    return manifest.name, manifest.version


def _is_unreadable(error: StreetfixError) -> bool:
    """Whether a folder exists but cannot be read, so that its content is unknown."""
    cause = error.__cause__
    return isinstance(cause, OSError) and not isinstance(cause, FileNotFoundError | NotADirectoryError)


def stamp_of(path: Path) -> Stamp:
    """Return the stamp of a bundle folder as it is now.

    Args:
        path: of the folder.
    """
    files = []
    # os.walk ignores folders that vanish meanwhile, such as those of a bundle that is being removed. The folder of a tile never changes.
    for file in (Path(folder) / name for folder, _, names in _walk_without_tiles(path) for name in names):
        try:
            status = file.stat()
        except OSError:  # the file is being replaced
            continue
        files.append((file.relative_to(path).as_posix(), status.st_size, status.st_mtime_ns))
    return tuple(sorted(files))


def _walk_without_tiles(path: Path) -> Iterator[tuple[str, list[str], list[str]]]:
    for folder, folders, names in os.walk(path):
        if Path(folder) == path and TILES_FOLDER in folders:
            folders.remove(TILES_FOLDER)
        yield folder, folders, names
