"""``streetfix map verify``: list all defects of a bundle, not only the first."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import shapely

from model_training.mapping.stored_map import read_statistics, streets_of_bundle
from service.errors import BundleError
from service.maps import content as parts
from service.maps import index
from service.maps.manifest import FileEntry, Manifest, read_manifest
from service.maps.reader import MapBundle
from service.maps.tiles import TiledMap
from service.maps.writer import sha256_of

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]
#: Largest distance of a place from its street, metres. Joining maps may move the rim of a street.
_OUTSIDE_M = 1.0
#: Number of descriptors that are read at once.
_CHUNK = 16_384


def damage_of(path: Path, *, report: Report = lambda *_: None) -> list[str]:
    """Return one line per defect, with its file; no line for an undamaged bundle.

    Args:
        path: folder of the bundle.
        report: called after every file.
    """
    try:
        manifest = read_manifest(path)
    except BundleError as error:
        return [error.message]
    found = []
    for number, (name, entry) in enumerate(sorted(manifest.files.items()), 1):
        if wrong := _damage_of_file(path, name, entry):
            found.append(f"{path / name}: {wrong}")
        report("files", number, len(manifest.files))
    if found:
        return found  # the content of damaged files would only give follow-up errors
    if manifest.tiles:
        return _damage_of_tiles(path, manifest, report)
    try:
        bundle = MapBundle.open(path)
        if parts.STATISTICS_FILE in manifest.files:
            read_statistics(bundle)
    except BundleError as error:
        return [error.message]
    return list(_contradictions(bundle))


def _damage_of_tiles(path: Path, manifest: Manifest, report: Report) -> list[str]:
    """Return the defects of the tiles of a map, and what does not fit to the map."""
    try:
        opened = TiledMap.open(path, verify=False, open_bytes=0)
    except BundleError as error:
        return [error.message]
    found = []
    for number, tile in enumerate(manifest.tiles):
        damaged = damage_of(path / tile.folder)
        if not damaged:
            try:
                opened.tiles.get(number)
            except BundleError as error:
                damaged = [error.message]
        found += damaged
        report("tiles", number + 1, len(manifest.tiles))
    return found


def _damage_of_file(folder: Path, name: str, entry: FileEntry) -> str:
    file = folder / name
    if not file.is_file() or not file.resolve().is_relative_to(folder.resolve()):
        return "missing, or outside the bundle"
    size = file.stat().st_size
    if size != entry.size:
        return f"{size} bytes instead of {entry.size}"
    return "" if sha256_of(file) == entry.sha256 else "the hash does not match the manifest"


def _contradictions(bundle: MapBundle) -> Iterator[str]:
    """Yield the defects of a bundle that opens: values that cannot be right."""
    off = 0
    for first in range(0, len(bundle.views), _CHUNK):
        vectors = bundle.view_index.vectors(np.arange(first, min(first + _CHUNK, len(bundle.views))))
        off += int((np.abs(np.linalg.norm(vectors, axis=1) - 1) > index.LENGTH_OFF).sum())
    if off:
        yield f"{bundle.path / index.FILE}: {off} descriptors are not unit vectors"
    R = bundle.T_map_place[:, :3, :3]
    skew = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) > 1e-6
    if skew.any():
        yield f"{bundle.path / parts.PLACES_FILE}: {int(skew.sum())} poses are not rigid transforms"
    streets = streets_of_bundle(bundle)
    if streets is not None and (outside := _outside(bundle, streets["features"])):
        yield f"{bundle.path / parts.PLACES_FILE}: {outside} places are outside the streets that they name"


def _outside(bundle: MapBundle, features: list[dict[str, object]]) -> int:
    count = 0
    for number in np.unique(bundle.place_street[bundle.place_street >= 0]):
        points = shapely.points(bundle.T_map_place[bundle.place_street == number][:, :2, 3])
        count += int(
            (shapely.distance(shapely.geometry.shape(features[number]["geometry"]), points) > _OUTSIDE_M).sum()
        )
    return count
