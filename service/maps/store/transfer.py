"""Copy whole maps into a store and out of it. An interrupted copy continues."""

import fcntl
import os
import shutil
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from service.errors import BundleError
from service.maps.manifest import FILE, TILES_FOLDER, FileEntry, Manifest, Tile, parsed_manifest, read_manifest
from service.maps.store.cache import make_once, sync_tree
from service.maps.store.fetch import (
    VERSIONS_FOLDER,
    concurrently,
    fetch_files,
    is_manifest_of,
    manifest_of_version,
    parsed_tile_manifest,
    shared_files,
    shared_prefix,
    tile_manifest,
)
from service.maps.store.remote import Remote, split_version
from service.maps.writer import sha256_of

#: Progress callback: stage, finished units, all units.
Report = Callable[[str, int, int], object]
_MB = 1_000_000


@dataclass(frozen=True, slots=True)
class Copied:
    """What a copy did.

    Attributes:
        manifest: of the map.
        tiles: tiles that were copied.
        kept: tiles that were there already.
        size: bytes that were copied.
    """

    manifest: Manifest
    tiles: int
    kept: int
    size: int


class _Progress:
    """Count copied bytes from several threads."""

    def __init__(self, stage: str, total: int, report: Report) -> None:
        self._stage, self._total, self._report = stage, total, report
        self._lock = threading.Lock()
        self._done = self.copied = 0

    def add(self, size: int) -> None:
        with self._lock:
            self.copied += size
            self._tell(size)

    def skip(self, size: int) -> None:
        with self._lock:
            self._tell(size)

    def _tell(self, size: int) -> None:
        self._done += size
        self._report(self._stage, self._done // _MB, self._total // _MB)


def push(folder: Path, url: str, *, report: Report = lambda *_: None) -> Copied:
    """Copy a map into a store.

    Tiles that the store has are skipped. The manifest of each tile comes after its files, and the manifest of the map last. So
    readers see the version before until the new one is whole. Tiles and shared files of earlier versions stay.

    Args:
        folder: of the map, tiled or not.
        url: URL of the map in the store, such as ``s3://bucket/maps/town``.
        report: called with the copied MB.

    Raises:
        BundleError: the URL names a version, the map is damaged, or the store cannot be written.
        ExtraMissingError: obstore is not installed.
    """
    if split_version(url)[1] is not None:
        raise BundleError(
            f"{url} names a version, but a push writes that of the map; leave out '@VERSION'", field="url"
        )
    manifest = read_manifest(folder)
    remote = Remote.open(url, create=True)
    data = _read(folder / FILE)
    shared = shared_files(manifest, str(folder / FILE))
    missing = _missing_tiles(remote, manifest)
    progress = _Progress("push (MB)", _size_of(shared) + sum(each.size for each in manifest.tiles), report)
    progress.skip(sum(each.size for each in manifest.tiles) - sum(each.size for each in missing))
    for tile in missing:
        place = folder / tile.folder
        in_tile = _read(place / FILE)
        _put_files(
            remote, f"{tile.folder}/", place, parsed_tile_manifest(in_tile, tile, str(place / FILE)).files, progress
        )
        remote.put(f"{tile.folder}/{FILE}", in_tile)
    prefix = f"{VERSIONS_FOLDER}/{manifest.version}/"
    if remote.read_if_there(prefix + FILE) is not None:
        progress.skip(_size_of(shared))
    else:
        _put_files(remote, prefix, folder, shared, progress)
        remote.put(prefix + FILE, data)
    if remote.read_if_there(FILE) != data:
        remote.put(FILE, data)
    return Copied(manifest, len(missing), len(manifest.tiles) - len(missing), progress.copied)


def pull(url: str, out: Path, *, report: Report = lambda *_: None) -> Copied:
    """Copy a whole map out of a store.

    Finished tiles stay in ``.NAME.pulling`` beside ``out`` until the map is whole.

    Args:
        url: URL of the map in the store; ``URL@VERSION`` copies that version, and not the current one.
        out: folder of the map; it must not exist.
        report: called with the copied MB.

    Raises:
        BundleError: the folder exists, a file of the store is missing or damaged, the store cannot be read, or the file system reports an
            error.
        ExtraMissingError: obstore is not installed.
    """
    if out.exists():
        raise BundleError(f"{out}: already exists; choose another folder", field="out")
    url, version = split_version(url)
    remote = Remote.open(url)
    if version is None:
        found = remote.read(FILE)
        data = b"" if found is None else found[0]
        manifest = parsed_manifest(data, f"{remote.url}/{FILE}")
    else:
        manifest, data = manifest_of_version(remote, version)
    pulling = out.parent / f".{out.name}.pulling"
    try:
        pulling.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(pulling, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            copied = _pull(remote, manifest, data, pulling, report)
            sync_tree(pulling)
            pulling.rename(out)
        finally:
            os.close(descriptor)
    except BlockingIOError as error:
        raise BundleError(f"{out}: another process pulls a map there; wait for it", field="out") from error
    except OSError as error:
        raise BundleError(
            f"{error.filename or pulling} cannot be written ({error.strerror}); free disk space or choose another folder",
            field="out",
        ) from error
    return copied


def _pull(remote: Remote, manifest: Manifest, data: bytes, into: Path, report: Report) -> Copied:
    shared = shared_files(manifest, f"{remote.url}/{FILE}")
    progress = _Progress("pull (MB)", _size_of(shared) + sum(each.size for each in manifest.tiles), report)
    wanted = {each.version for each in manifest.tiles}
    for left in into.iterdir():  # by an interrupted copy, perhaps of another version
        if left.name != TILES_FOLDER or not manifest.tiles:
            shutil.rmtree(left) if left.is_dir() else left.unlink()
    copied = 0
    for left in (into / TILES_FOLDER).glob("*"):
        if left.name not in wanted:
            shutil.rmtree(left)
    for tile in manifest.tiles:
        place = into / tile.folder
        if place.is_dir():
            if is_manifest_of(tile, (place / FILE).read_bytes(), str(place / FILE)):
                progress.skip(tile.size)
                continue
            shutil.rmtree(place)
        make_once(place, partial(_pull_tile, remote, tile, progress))
        copied += 1
    fetch_files(remote, shared_prefix(remote, manifest), shared, into, on_bytes=progress.add)
    (into / FILE).write_bytes(data)
    return Copied(manifest, copied, len(manifest.tiles) - copied, progress.copied)


def _pull_tile(remote: Remote, tile: Tile, progress: _Progress, into: Path) -> None:
    manifest, data = tile_manifest(remote, tile)
    fetch_files(remote, f"{tile.folder}/", manifest.files, into, on_bytes=progress.add)
    (into / FILE).write_bytes(data)


def _missing_tiles(remote: Remote, manifest: Manifest) -> list[Tile]:
    """Return the tiles whose manifests the store lacks."""
    missing = []

    def look(tile: Tile, go_on: Callable[[], None]) -> None:
        go_on()
        name = f"{tile.folder}/{FILE}"
        if not is_manifest_of(tile, remote.read_if_there(name), f"{remote.url}/{name}"):
            missing.append(tile)

    concurrently(partial(look, each) for each in manifest.tiles)
    return sorted(missing, key=lambda each: (each.column, each.row))


def _put_files(remote: Remote, prefix: str, folder: Path, files: Mapping[str, FileEntry], progress: _Progress) -> None:
    def put(name: str, entry: FileEntry, go_on: Callable[[], None]) -> None:
        go_on()
        file = folder / name
        try:
            is_right = file.stat().st_size == entry.size and sha256_of(file) == entry.sha256
        except OSError as error:
            raise BundleError(
                f"{file}: cannot be read ({error.strerror}); copy or build the map again", field=name
            ) from error
        if not is_right:
            raise BundleError(
                f"{file}: size or hash do not match the manifest; copy or build the map again", field=name
            )
        go_on()
        remote.put(prefix + name, file)
        progress.add(entry.size)

    concurrently(partial(put, name, entry) for name, entry in files.items())


def _size_of(files: Mapping[str, FileEntry]) -> int:
    return sum(each.size for each in files.values())


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise BundleError(
            f"{path}: cannot be read ({error.strerror}); copy or build the map again", field=FILE
        ) from error
