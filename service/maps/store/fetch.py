"""Fetch bundles from a store: many files at once, each checked against its manifest."""

import os
import threading
from collections.abc import Callable, Collection, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from pathlib import Path

from service.errors import BundleError
from service.maps.manifest import FILE, TILES_FOLDER, FileEntry, Manifest, Tile, parsed_manifest
from service.maps.store.remote import Remote

#: Objects that are transferred at once.
THREADS = 8
#: Folder of the versions of a map in a store. It has the manifest and the shared files of each version.
VERSIONS_FOLDER = "versions"
#: Called with the number of bytes of each piece that was transferred, from several threads.
OnBytes = Callable[[int], object]


class _StoppedError(Exception):
    """Another transfer has failed."""


def concurrently(works: Iterable[Callable[[Callable[[], None]], object]]) -> None:
    """Run functions in threads. After a failure, the others stop.

    Args:
        works: each gets a function to call now and then, which raises after a failure of another one.

    Raises:
        Exception: the first that one of them raised.
    """
    failed = threading.Event()

    def go_on() -> None:
        if failed.is_set():
            raise _StoppedError

    with ThreadPoolExecutor(THREADS, thread_name_prefix="streetfix-store") as pool:
        try:
            pending = [pool.submit(work, go_on) for work in works]
            for each in as_completed(pending):
                each.result()
        except BaseException:
            failed.set()
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def fetch_files(
    remote: Remote, prefix: str, files: Mapping[str, FileEntry], into: Path, *, on_bytes: OnBytes = lambda _: None
) -> None:
    """Fetch files, the largest first, and check size and hash of each.

    Args:
        remote: the store of the map.
        prefix: path below the URL, with a slash at the end; or empty.
        files: expected size and hash of each file, by its path. The paths are confined (``is_confined``).
        into: folder for the files. A file that is there is written over from its start.
        on_bytes: called for each piece.

    Raises:
        BundleError: a file is missing, cannot be read, or has another size or hash.
        OSError: a file cannot be written.
    """

    def fetch(name: str, entry: FileEntry, go_on: Callable[[], None]) -> None:
        def count(read: int) -> None:
            go_on()
            on_bytes(read)

        target = into / name
        target.parent.mkdir(parents=True, exist_ok=True)
        with os.fdopen(os.open(target, os.O_WRONLY | os.O_CREAT, 0o644), "wb") as stream:
            remote.save(prefix + name, entry, stream, on_bytes=count)

    largest_first = sorted(files.items(), key=lambda each: each[1].size, reverse=True)
    concurrently(partial(fetch, name, entry) for name, entry in largest_first)


def tile_manifest(remote: Remote, tile: Tile) -> tuple[Manifest, bytes]:
    """Read the manifest of a tile.

    Args:
        remote: the store of the map.
        tile: of the map's manifest.

    Returns:
        The manifest, and its bytes.

    Raises:
        BundleError: the manifest is missing, cannot be read, or is another one.
    """
    name = f"{tile.folder}/{FILE}"
    found = remote.read(name)
    data = b"" if found is None else found[0]
    return parsed_tile_manifest(data, tile, f"{remote.url}/{name}"), data


def parsed_tile_manifest(data: bytes, tile: Tile, where: str) -> Manifest:
    """Check that bytes are the manifest of a tile. Its version is the hash of its content.

    Args:
        data: the bytes.
        tile: of the map's manifest.
        where: path or URL, for messages.

    Raises:
        BundleError: they are not.
    """
    manifest = parsed_manifest(data, where)
    if manifest.version != tile.version or manifest.tiles:
        raise BundleError(
            f"{where}: not the bundle of tile {tile.column} {tile.row}, which the map lists; copy or push the map again",
            field=FILE,
        )
    return manifest


def is_manifest_of(tile: Tile, data: bytes | None, where: str) -> bool:
    """Return whether bytes are the manifest of a tile.

    Args:
        tile: of the map's manifest.
        data: the bytes; None if there are none.
        where: path or URL, for messages.
    """
    try:
        return data is not None and parsed_tile_manifest(data, tile, where).version == tile.version
    except BundleError:  # a damaged one is written again
        return False


def shared_files(manifest: Manifest, where: str, *, leave_out: Collection[str] = ()) -> dict[str, FileEntry]:
    """Return the files of a map that are in no tile.

    Args:
        manifest: of the map.
        where: path or URL of the manifest, for messages.
        leave_out: files that are not wanted.

    Raises:
        BundleError: a file is in the folder of the tiles.
    """
    for name in manifest.files:
        if name.partition("/")[0] == TILES_FOLDER:
            raise BundleError(
                f"{where}: the file {name!r} is in the folder of the tiles; build the map again", field=FILE
            )
    return {name: entry for name, entry in manifest.files.items() if name not in leave_out}


def manifest_of_version(remote: Remote, version: str) -> tuple[Manifest, bytes]:
    """Read the manifest of one version of a map.

    ``map push`` keeps the manifests of all versions. A folder that another tool copied has only the current one.

    Args:
        remote: the store of the map.
        version: of the map.

    Returns:
        The manifest, and its bytes.

    Raises:
        BundleError: the store does not have this version, the manifest is damaged, or the store cannot be read.
    """
    name = f"{VERSIONS_FOLDER}/{version}/{FILE}"
    data = remote.read_if_there(name)
    if data is None:
        name, found = FILE, remote.read(FILE)
        data = b"" if found is None else found[0]
    manifest = parsed_manifest(data, f"{remote.url}/{name}")
    if manifest.version != version:
        raise BundleError(
            f"{remote.url}: version {version} is not in the store ({name} has version {manifest.version}); push this version "
            "(streetfix map push), or name another one",
            field="maps",
        )
    return manifest, data


def shared_prefix(remote: Remote, manifest: Manifest) -> str:
    """Return where the shared files of a map are, as ``fetch_files`` needs it.

    ``map push`` stores them in a folder of this version. A folder that another tool copied has them at the top.

    Args:
        remote: the store of the map.
        manifest: of the map.

    Raises:
        BundleError: the store cannot be read.
    """
    folder = f"{VERSIONS_FOLDER}/{manifest.version}/"
    return "" if remote.read_if_there(folder + FILE) is None else folder
