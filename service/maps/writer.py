"""Write a map bundle atomically."""

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from service.errors import BundleError
from service.geometry.lengths import lengths
from service.maps import content as parts
from service.maps import index, inverted_file, manifest, streets
from service.maps.byte_planes import write_records
from service.maps.content import BundleContent
from service.maps.manifest import FORMAT, Counts, FileEntry, GridParameters, Manifest


def write_bundle(out: Path, content: BundleContent, *, overwrite: bool = False) -> Manifest:
    """Write a bundle atomically and return its manifest.

    The function writes to a temporary folder beside ``out``, flushes it to the disk and renames it. A failure leaves nothing
    under the final name. A killed process leaves a folder ``.NAME.*.partial``, which is safe to delete. With ``overwrite``,
    the old bundle is moved aside before the last rename. It is restored if the rename fails.

    Args:
        out: the bundle's folder.
        content: the map.
        overwrite: replace an existing bundle.

    Raises:
        BundleError: the path exists, the content is inconsistent, or the file system reports an error.
    """
    if out.exists() and not overwrite:
        raise BundleError(f"{out}: already exists; choose another --out or pass --overwrite")
    _require_valid(content)
    with in_place(out, f"{out}: the bundle cannot be written", "free disk space or choose another folder") as partial:
        made = _write_files(partial, content)
        partial.chmod(0o755)
    return made


@contextmanager
def in_place(out: Path, what: str, remedy: str) -> Iterator[Path]:
    """Yield a folder beside ``out``, and rename it to ``out`` at the end. A failure removes it and leaves ``out`` as it is.

    Args:
        out: the bundle's folder.
        what: start of the message of a failure.
        remedy: what to do about it.

    Raises:
        BundleError: the file system reports an error.
    """
    partial: Path | None = None
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".partial", dir=out.parent))
        yield partial
        sync(partial)
        _put_in_place(partial, out)
    except OSError as error:
        raise BundleError(f"{what} ({error.strerror}); {remedy}") from error
    finally:
        if partial is not None and partial.exists():
            shutil.rmtree(partial, ignore_errors=True)


def replace_calibration(bundle: Path, calibration: Mapping[str, Any]) -> Manifest:
    """Replace the calibration of a bundle or of a tiled map atomically and return the new manifest.

    The map gets a new version, so a running service mounts it as one. The function writes a second bundle beside the first and renames it
    into place, as ``write_bundle`` does. All other files are hard links, or copies where the file system has no links. A process that has
    the old bundle open keeps it.

    Args:
        bundle: the bundle's folder.
        calibration: content of ``calibration.json``.

    Raises:
        BundleError: the bundle has no valid manifest, or the file system reports an error.
    """
    old, place = manifest.read_manifest(bundle), bundle.resolve()
    remedy = f"free disk space, or get write access to {place.parent}"
    with in_place(place, f"{bundle}: the calibration cannot be replaced", remedy) as partial:
        for name in sorted(old.files):
            (partial / name).parent.mkdir(exist_ok=True, parents=True)
            if name != parts.CALIBRATION_FILE:
                link_or_copy(place / name, partial / name)
        written = partial / parts.CALIBRATION_FILE
        written.write_bytes(json_bytes(calibration))
        sync(written)
        entry = FileEntry(sha256=sha256_of(written), size=written.stat().st_size)
        files = {**old.files, parts.CALIBRATION_FILE: entry}
        made = old.model_copy(update={"files": files, "made_at": datetime.now(UTC)}).stamped()
        (partial / manifest.FILE).write_bytes(made.to_bytes())
        sync(partial / manifest.FILE)
        of_tiles = [file for tile in old.tiles for file in (place / tile.folder).rglob("*") if file.is_file()]
        for file in of_tiles:
            target = partial / file.relative_to(place)
            target.parent.mkdir(exist_ok=True, parents=True)
            link_or_copy(file, target)
        folders = {(partial / name).parent for name in old.files}
        for folder in folders | {(partial / file.relative_to(place)).parent for file in of_tiles}:
            sync(folder)
        shutil.copymode(place, partial)
    return made


def link_or_copy(source: Path, target: Path) -> None:
    """Create a hard link to a file, or a copy where the file system has no links.

    Args:
        source: the file.
        target: the new file.
    """
    try:
        os.link(source.resolve(), target)
    except OSError:  # a file system without hard links; a copy fails with its own error if the disk is the reason
        shutil.copyfile(source, target)
        sync(target)


def _write_files(folder: Path, content: BundleContent) -> Manifest:
    (folder / parts.CLOUD_FOLDER).mkdir()
    places = np.empty(len(content.T_map_place), parts.PLACE)
    places["T_map_place"], places["street"] = content.T_map_place, content.place_street
    views = np.empty(len(content.view_place), parts.VIEW)
    views["place"], views["heading_rad"] = content.view_place, content.view_heading_rad
    writers: dict[str, Callable[[Path], object]] = {
        parts.ENCODER_FILE: lambda path: path.write_bytes(content.encoder),
        index.FILE: lambda path: index.write_descriptors(path, content.descriptors),
        parts.PLACES_FILE: lambda path: np.save(path, places, allow_pickle=False),
        parts.VIEWS_FILE: lambda path: np.save(path, views, allow_pickle=False),
        parts.CALIBRATION_FILE: lambda path: path.write_bytes(json_bytes(content.calibration)),
    }
    if content.preview_webp:
        writers[parts.PREVIEW_FILE] = lambda path: path.write_bytes(content.preview_webp)
    if content.streets is not None:
        writers[streets.FILE] = lambda path: path.write_bytes(json_bytes(content.streets))
    if content.statistics is not None:
        writers[parts.STATISTICS_FILE] = partial(write_records, records=content.statistics)
    for name, array in ({} if content.cloud is None else content.cloud.arrays()).items():
        writers[f"{parts.CLOUD_FOLDER}/{name}.npy"] = _array_writer(array)
    measured: dict[str, float] = {}
    if len(content.descriptors) >= inverted_file.SMALLEST:

        def write_index(path: Path) -> None:  # after the descriptors, from which it is made
            numbers = index.read_descriptors(folder / index.FILE)
            measured[inverted_file.RECALL] = inverted_file.write_inverted_file(path, numbers, headings=content.headings)

        writers[inverted_file.FILE] = write_index
    elif len(content.descriptors) >= index.FEWEST:
        writers[index.COARSE_FILE] = lambda path: index.write_coarse_copy(
            path, index.read_descriptors(folder / index.FILE)
        )
    for name, write in writers.items():
        write(folder / name)
        sync(folder / name)
    sync(folder / parts.CLOUD_FOLDER)
    made = _manifest_of(folder, content, sorted(writers), measured)
    (folder / manifest.FILE).write_bytes(made.to_bytes())
    sync(folder / manifest.FILE)
    return made


def _array_writer(array: NDArray[Any]) -> Callable[[Path], None]:
    return lambda path: np.save(path, array, allow_pickle=False)


def json_bytes(document: object) -> bytes:
    """Return a JSON document as a bundle stores it.

    Args:
        document: the document; all numbers finite.
    """
    return (json.dumps(document, sort_keys=True, allow_nan=False) + "\n").encode()


def _manifest_of(folder: Path, content: BundleContent, names: list[str], measured: Mapping[str, float]) -> Manifest:
    files = {name: FileEntry(sha256=sha256_of(folder / name), size=(folder / name).stat().st_size) for name in names}
    try:
        return Manifest(
            format=FORMAT,
            name=content.name,
            version="0" * 16,
            made_at=datetime.now(UTC),
            grid=GridParameters(**asdict(content.grid)),
            headings=content.headings,
            spacing_m=content.spacing_m,
            rows_seen=tuple(bool(seen) for seen in content.rows_seen),
            parameters={k: v for k, v in content.parameters.items() if k != inverted_file.RECALL} | dict(measured),
            encoder_sha256=files[parts.ENCODER_FILE].sha256,
            counts=_counts_of(content),
            georeference=None if content.georeference is None else dict(content.georeference),
            licence=content.licence,
            files=files,
            tool_versions=dict(content.tool_versions),
        ).stamped()
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise BundleError(
            f"the manifest is invalid: {where}: {first['msg']}; correct this value of the map", field=where
        ) from error


def _counts_of(content: BundleContent) -> Counts:
    return Counts(
        places=len(content.T_map_place),
        views=len(content.view_place),
        descriptor_size=content.descriptors.shape[1],
        cloud_points=0 if content.cloud is None else len(content.cloud.surfels),
        streets=0 if content.streets is None else len(content.streets.get("features", ())),
    )


def _require_valid(content: BundleContent) -> None:
    """Check the content before anything is written, because ``MapBundle.open`` would refuse the same errors.

    Raises:
        BundleError: the content is inconsistent.
    """
    named = 0 if content.streets is None else len(streets.Streets.from_geojson(content.streets))
    if content.rows_seen.shape != (content.grid.rows,):
        what = f"rows_seen has {len(content.rows_seen)} entries for {content.grid.rows} rows"
    elif len(content.T_map_place) == 0 or len(content.view_place) == 0:
        what = "there are no places or no views"
    elif content.view_place.min() < 0 or content.view_place.max() >= len(content.T_map_place):
        what = "a view refers to a missing place"
    elif content.place_street.min() < -1 or content.place_street.max() >= named:
        what = f"a place refers to a street that is not among the {named} of streets.geojson"
    elif not np.isfinite(content.descriptors).all():
        what = "a descriptor is not finite"
    elif (np.abs(lengths(content.descriptors) - 1) > index.LENGTH_OFF).any():
        what = "a descriptor is not a unit vector"
    elif not parts.are_poses(content.T_map_place):
        what = parts.NO_POSE
    elif wrong := manifest.not_on_earth(content.georeference):
        what = f"georeference: {wrong}"
    elif "lidar_height_m" not in content.parameters:
        what = "parameters.lidar_height_m is missing"
    else:
        if content.cloud is not None:
            content.cloud.require_consistent()
        return
    raise BundleError(f"the map {content.name!r} is inconsistent: {what}; fix the program that builds it")


def sha256_of(path: Path) -> str:
    """Return the hexadecimal SHA-256 of a file, without loading the whole file.

    Args:
        path: the file.
    """
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def sync(path: Path) -> None:
    """Flush a file or folder to the disk, so that the content is there before a later rename.

    Args:
        path: the file or folder.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _put_in_place(partial: Path, out: Path) -> None:
    if not out.exists():
        partial.rename(out)
    else:
        aside = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".replaced", dir=out.parent))
        try:
            out.rename(aside / out.name)
            partial.rename(out)
        except BaseException:  # also Ctrl-C: the old bundle must not be lost
            if not out.exists():
                (aside / out.name).rename(out)
            raise
        finally:
            shutil.rmtree(aside, ignore_errors=True)
    sync(out.parent)
