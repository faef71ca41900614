"""A map in object storage as a folder on the disk, whose tiles appear on demand."""

import hashlib
import os
import re
import shutil
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import partial
from pathlib import Path

from service.errors import BundleError
from service.maps.checked_tiles import Checked, CheckedTiles, mark_of
from service.maps.content import NOT_SERVED
from service.maps.manifest import FILE, TILES_FOLDER, FileEntry, Manifest, Tile, parsed_manifest, read_manifest
from service.maps.store.cache import TileCache, is_used_now
from service.maps.store.fetch import (
    OnBytes,
    fetch_files,
    manifest_of_version,
    shared_files,
    shared_prefix,
    tile_manifest,
)
from service.maps.store.remote import Remote, split_version
from service.maps.tiles import files_unread
from service.maps.writer import sha256_of

#: Time between two marks of an open tile as used, s.
USED_EVERY_S = 60.0
#: A version that no process has marked as used for this time, s, is deleted by a service that serves one version only.
UNUSED_S = 7 * 24 * 3600.0
_UNUSUAL = re.compile(r"[^A-Za-z0-9._-]+")


#: Follows a fetch. Gets its kind ("map" for the shared files of a map, or "tile"), its URL and the bytes of all files. The context gives a
#: function that is called with the number of bytes of each piece, from several threads.
Follow = Callable[[str, str, int], AbstractContextManager[OnBytes]]

#: Takes note of a request of a tile: whether the cache has the tile, and whether the request is ahead of all queries.
OnRequest = Callable[[bool, bool], object]


def _unseen(*_: object) -> AbstractContextManager[OnBytes]:
    """Follow a fetch that nobody watches."""
    return nullcontext(lambda _: None)


class StoredMap:
    """A map under a URL, and its folder in the cache. Threads and processes may share the cache.

    The URL names the current version of the map, or one version: ``URL@VERSION``. Both have the same folder.

    ``folder`` has a folder for each version of the map, with ``manifest.json`` and the shared files. Its folder ``tiles`` has the tiles
    that ``StoreTiles`` has fetched. All versions share them. A map without tiles is fetched whole. Files that the service does not read
    are left out. A file that another version in the cache has is a hard link.

    Args:
        url: such as ``s3://bucket/maps/town``, or with a version ``s3://bucket/maps/town@3f9c2a7be01d4586``.
        cache: the cache.
        follow: follows the fetches.
        on_request: takes note of the requests of tiles.
        is_searched_elsewhere: whether a server chooses the tiles of maps with many tiles. Then their search indices are left out.

    Attributes:
        url: as given, without a final slash and without the version.
        pinned: the version that the URL names; None follows the current one.
        folder: folder of the map in the cache.

    Raises:
        BundleError: the URL is not valid.
    """

    def __init__(
        self,
        url: str,
        cache: TileCache,
        follow: Follow = _unseen,
        on_request: OnRequest = lambda *_: None,
        *,
        is_searched_elsewhere: bool = False,
    ) -> None:
        self._is_searched_elsewhere = is_searched_elsewhere
        self.url, self.pinned = split_version(url)
        self._cache, self._follow, self._on_request = cache, follow, on_request
        self._checked = CheckedTiles()  # of all versions
        key = hashlib.sha256(self.url.encode()).hexdigest()[:12]
        self.folder = cache.folder / f"{_UNUSUAL.sub('_', self.url.rpartition('/')[2])[:64]}-{key}"
        self._remote: Remote | None = None
        self._etag: str | None = None
        self._version: str | None = None

    def refresh(self) -> None:
        """Fetch the shared files of the pinned or the current version, unless the cache has them.

        The store sends the current manifest only if it has changed since the last call. A pinned version never changes, so nothing is
        requested if the cache has it.

        Raises:
            BundleError: the store cannot be read or lacks the pinned version, a file is damaged, or the cache cannot be used.
            ExtraMissingError: obstore is not installed.
        """
        if self.pinned is not None:
            target = self.folder / self.pinned
            with self._cache.error_context():
                is_used_now(target)
            if not (target / FILE).exists():
                manifest, data = manifest_of_version(self._opened(), self.pinned)
                self._cache.once(target, partial(self._fetch_version, manifest, data))
            self._complete(target)
            return
        remote = self._opened()
        found = remote.read(FILE, unless=self._etag)
        if found is None:
            return
        data, etag = found
        manifest = parsed_manifest(data, f"{self.url}/{FILE}")
        target = self.folder / manifest.version
        self._cache.once(target, partial(self._fetch_version, manifest, data))
        with self._cache.error_context():
            if (target / FILE).read_bytes() != data:  # the same content, built again
                newer = target / f".{FILE}.{os.getpid()}"
                newer.write_bytes(data)
                newer.replace(target / FILE)
        self._complete(target)
        self._etag, self._version = etag, manifest.version

    def versions(self) -> list[Path]:
        """Return the folders of the versions in the cache that may be served: only the pinned one, if one is pinned."""
        return sorted(each.parent for each in self.folder.glob(f"{self.pinned or '[!.]*'}/{FILE}"))

    def cached_tiles(self) -> int:
        """Return the number of tiles in the cache, of all versions and for all processes that share the cache."""
        return sum(1 for _ in (self.folder / TILES_FOLDER).glob("[!.]*"))

    def tiles(self, version: Path) -> "StoreTiles":
        """Return the source of the tiles of a version.

        Args:
            version: folder of the version, in ``folder``.
        """
        return StoreTiles(self._opened(), self._cache, version, self._follow, self._checked, self._on_request)

    def forget(self, keep: Collection[str]) -> None:
        """Delete the folders of other versions than these and the current one. The bound of the cache deletes their tiles.

        Services with other pinned versions may share the cache. Each service marks the versions that it keeps as used. With a pinned
        version, only versions without a mark for ``UNUSED_S`` are deleted.

        Args:
            keep: versions.

        Raises:
            BundleError: the cache cannot be used.
        """
        if self.pinned is None and self._version is None:
            return
        mine, now_s = {*keep, self.pinned, self._version}, time.time()
        for each in [found.parent for found in self.folder.glob(f"[!.]*/{FILE}")]:
            with self._cache.error_context(), suppress(FileNotFoundError):  # another process deletes it
                if each.name in mine:
                    is_used_now(each)
                elif self.pinned is None or now_s - each.stat().st_mtime > UNUSED_S:
                    self._cache.delete(each)

    def _opened(self) -> Remote:
        if self._remote is None:
            self._remote = Remote.open(self.url)
        return self._remote

    def _fetch_version(self, manifest: Manifest, data: bytes, into: Path) -> None:
        self._fetch_files(manifest, self._wanted(manifest), into)
        (into / FILE).write_bytes(data)

    def _complete(self, version: Path) -> None:
        """Fetch the files of a version that a service without use for them has left out."""
        manifest = read_manifest(version)
        if all((version / name).exists() for name in self._wanted(manifest)):
            return

        def fetch(into: Path) -> None:
            files = self._wanted(manifest)
            self._fetch_files(
                manifest, {name: entry for name, entry in files.items() if not (version / name).exists()}, into
            )

        added = version.parent / f".{version.name}.added"
        self._cache.once(added, fetch)
        with self._cache.error_context():
            for each in [file for file in added.rglob("*") if file.is_file()]:
                target = version / each.relative_to(added)
                target.parent.mkdir(parents=True, exist_ok=True)
                with suppress(FileNotFoundError):  # another process has moved it
                    each.replace(target)
            shutil.rmtree(added, ignore_errors=True)

    def _wanted(self, manifest: Manifest) -> dict[str, FileEntry]:
        """Return the files of a version, outside of its tiles, that the service reads."""
        unread = files_unread(manifest, is_searched_elsewhere=self._is_searched_elsewhere)
        return shared_files(manifest, f"{self.url}/{FILE}", leave_out=unread)

    def _fetch_files(self, manifest: Manifest, files: dict[str, FileEntry], into: Path) -> None:
        """Link the files that another version in the cache has, and fetch the others."""
        remote, known = self._opened(), self._known_by_hash()
        for name, entry in list(files.items()):
            if entry.sha256 in known and _link(known[entry.sha256], entry, into / name):
                del files[name]
        with self._follow("map", self.url, sum(each.size for each in files.values())) as on_bytes:
            fetch_files(remote, shared_prefix(remote, manifest), files, into, on_bytes=on_bytes)

    def _known_by_hash(self) -> dict[str, Path]:
        """Return the shared files of all versions in the cache by their hash."""
        known: dict[str, Path] = {}
        for found in self.folder.glob(f"[!.]*/{FILE}"):
            with suppress(BundleError):  # of another format, or being deleted
                files = read_manifest(found.parent).files
                known |= {
                    entry.sha256: found.parent / name for name, entry in files.items() if (found.parent / name).exists()
                }
        return known


def _link(known: Path, entry: FileEntry, target: Path) -> bool:
    """Link a file of the cache if it has the content that is expected; return whether it has."""
    try:
        if known.stat().st_size != entry.size or sha256_of(known) != entry.sha256:  # damaged on the disk
            return False
        target.parent.mkdir(parents=True, exist_ok=True)
        os.link(known, target)
    except OSError:  # left out or being deleted, or a file system without hard links
        return False
    return True


class StoreTiles:
    """The tiles of a map in object storage: a source of folders (``TileSource``). Threads may share it.

    Args:
        remote: the store of the map.
        cache: the cache.
        version: folder of a version of the map in the cache.
        follow: follows the fetches.
        checked: what this process has checked of the tiles of the map, also for other versions; None begins.
        on_request: takes note of the requests of tiles.

    Attributes:
        checked: as given, or new.
    """

    def __init__(
        self,
        remote: Remote,
        cache: TileCache,
        version: Path,
        follow: Follow = _unseen,
        checked: CheckedTiles | None = None,
        on_request: OnRequest = lambda *_: None,
    ) -> None:
        self._remote, self._cache, self._version, self._follow = remote, cache, version, follow
        self._on_request = on_request
        self.checked = checked or CheckedTiles()
        self._used_s: dict[str, float] = {}
        self._shared: Mapping[str, Path] | None = None

    def folder(self, tile: Tile, *, ahead: bool = False) -> Path:
        """Return the folder with the bundle of a tile; fetch it unless the cache has it.

        The bundle lacks the files that the service does not read. The bound of the cache may delete the folder later. Open files stay
        readable. If the folder is gone before it was opened, ask again.

        Args:
            tile: of the map's manifest.
            ahead: no request waits for it.

        Raises:
            BundleError: the store cannot be read, a file is damaged, or the cache cannot be used.
        """
        folder = self._version.parent / tile.folder
        with self._cache.error_context():
            is_there = is_used_now(folder)
        self._on_request(is_there, ahead)
        if not is_there:
            self._cache.once(folder, partial(self._fetch, tile))
        return folder

    def used(self, tile: Tile) -> None:
        """Mark a tile as used, so that the bound of the cache deletes others first. It costs nothing more than once a minute.

        Args:
            tile: an open tile.
        """
        now_s = time.monotonic()
        if now_s - self._used_s.get(tile.version, -USED_EVERY_S) >= USED_EVERY_S:
            self._used_s[tile.version] = now_s
            with suppress(OSError):  # the cache may delete the tile sooner, and it stays open
                is_used_now(self._version.parent / tile.folder)

    def _fetch(self, tile: Tile, into: Path) -> None:
        manifest, data = tile_manifest(self._remote, tile)
        files = {name: entry for name, entry in manifest.files.items() if name not in NOT_SERVED}
        shared = self._shared_by_hash()
        for name in [name for name, entry in files.items() if entry.sha256 in shared]:
            with suppress(OSError):  # a file system without hard links, or the version is being removed: fetch the file
                (into / name).parent.mkdir(parents=True, exist_ok=True)
                os.link(shared[files[name].sha256], into / name)
                del files[name]
        self._cache.reserve(into, {name: entry.size for name, entry in files.items()} | {FILE: len(data)})
        total = sum(each.size for each in files.values())
        with self._follow("tile", f"{self._remote.url}/{tile.folder}", total) as on_bytes:
            fetch_files(self._remote, f"{tile.folder}/", files, into, on_bytes=on_bytes)
        (into / FILE).write_bytes(data)
        self.checked.add(tile.version, mark_of(into), Checked.HASHES)  # the mark stays when the folder gets its name

    def _shared_by_hash(self) -> Mapping[str, Path]:
        """Return the shared files of the map by their hash. A tile has copies of some, which are hard links in the cache.

        There are none if another service has deleted the folder of the version meanwhile.
        """
        if self._shared is None:
            try:
                files = read_manifest(self._version).files
            except BundleError:
                return {}
            self._shared = {
                entry.sha256: self._version / name for name, entry in files.items() if name not in NOT_SERVED
            }
        return self._shared
