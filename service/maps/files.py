"""Read and check the files of a map bundle. Every error names the file and the remedy."""

import json
from collections.abc import Collection, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import BundleError, damaged_file
from service.imaging.npy_header import NPY_HEADER_ERRORS
from service.maps import content as parts
from service.maps.manifest import FileEntry, Manifest
from service.maps.writer import sha256_of

#: Threads that hash the files of a bundle. hashlib releases the interpreter lock.
_HASHING_THREADS = 4


def require_files(
    path: Path,
    manifest: Manifest,
    needed: Iterable[str],
    *,
    unread: Collection[str] = parts.NOT_SERVED,
    verify: bool,
) -> None:
    """Check that the files of a bundle are there, and that they are those of the manifest. Files that the service does not read may lack.

    Args:
        path: the bundle's folder.
        manifest: its manifest.
        needed: files that the manifest must list.
        unread: files that this service does not read. They may be missing, and are not hashed.
        verify: compare the hash of every file that the service reads. Sizes are always compared.

    Raises:
        BundleError: a file is missing, damaged or outside the folder.
    """
    for name in needed:
        if name not in manifest.files:
            raise damaged_file(path / name, "not listed in the manifest")
    compared: list[tuple[Path, FileEntry]] = []
    for name, entry in manifest.files.items():
        file = path / name
        if name in unread and not file.exists():
            continue
        if not file.is_file() or not file.resolve().is_relative_to(path.resolve()):
            raise damaged_file(file, "missing, or outside the bundle")
        try:
            size = file.stat().st_size
        except OSError as error:  # for example, somebody removes the bundle meanwhile
            raise _unreadable(file, error) from error
        if size != entry.size:
            raise damaged_file(file, f"{size} bytes instead of {entry.size}")
        if verify and name not in unread:
            compared.append((file, entry))
    _compare_hashes(compared)
    if manifest.files[parts.ENCODER_FILE].sha256 != manifest.encoder_sha256:
        raise damaged_file(path / parts.ENCODER_FILE, "not the encoder that computed the descriptors")


def _compare_hashes(files: list[tuple[Path, FileEntry]]) -> None:
    """Compare the hashes of files with the manifest. Hashing runs in threads, because a request may wait for a tile to be opened.

    Raises:
        BundleError: a file cannot be read, or its hash is another one.
    """
    if not files:
        return
    with ThreadPoolExecutor(min(len(files), _HASHING_THREADS)) as threads:
        for (file, entry), found in zip(files, threads.map(_hash_of, [file for file, _ in files]), strict=True):
            if found != entry.sha256:
                raise damaged_file(file, "the hash does not match the manifest")


def _hash_of(file: Path) -> str:
    try:
        return sha256_of(file)
    except OSError as error:  # for example, somebody removes the bundle meanwhile
        raise _unreadable(file, error) from error


def _unreadable(file: Path, error: OSError) -> BundleError:
    return damaged_file(file, f"cannot be read ({error.strerror})")


def read_file(path: Path) -> bytes:
    """Return the content of a file.

    Args:
        path: the file.

    Raises:
        BundleError: the file cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:  # for example, somebody removes the bundle meanwhile
        raise _unreadable(path, error) from error


def map_array(path: Path, *, expected: np.dtype[Any] | None) -> NDArray[Any]:
    """Map an array into memory; return it in the shape of the file, (n,) if a type is expected.

    Args:
        path: NPY file.
        expected: type of its elements, in one dimension; None for any array.

    Raises:
        BundleError: the file is not an NPY array, or has another type or number of dimensions.
    """
    try:
        array = np.load(path, allow_pickle=False, mmap_mode="r")
    except (OSError, *NPY_HEADER_ERRORS) as error:
        raise damaged_file(path, f"not a valid NPY array ({error})") from error
    if expected is not None and (array.dtype != expected or array.ndim != 1):
        raise damaged_file(path, f"{array.dtype} in {array.ndim} dimensions instead of {expected} in 1")
    return array  # type: ignore[no-any-return]  # np.load is not typed for one array


def json_object(content: bytes, path: Path) -> dict[str, Any]:
    """Return a JSON object.

    Args:
        content: content of the file.
        path: the file, for the error message.

    Raises:
        BundleError: the content is not a JSON object.
    """
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise damaged_file(path, "not valid JSON") from error
    if not isinstance(document, dict):
        raise damaged_file(path, "not a JSON object")
    return document
