"""Open a map bundle: check its files, then map them into memory."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.errors import BundleError, damaged_file
from service.maps import content as parts
from service.maps import index, inverted_file, streets
from service.maps.calibration import read_calibration
from service.maps.files import json_object, map_array, read_file, require_files
from service.maps.index import ScannedCopy, Shortlister, ViewIndex
from service.maps.inverted_file import InvertedFile
from service.maps.manifest import FILE, TILES_FOLDER, Manifest, read_manifest
from service.maps.map import Map
from service.maps.streets import Streets, StreetsFile
from service.registration.surfel_map import SurfelMap

#: Files that every bundle has, apart from the arrays of its cloud.
NEEDED = (parts.ENCODER_FILE, index.FILE, parts.PLACES_FILE, parts.VIEWS_FILE, parts.CALIBRATION_FILE)


@dataclass(frozen=True, slots=True, eq=False)
class MapBundle(Map):
    """An open map of one bundle.

    Attributes:
        cloud: surfels of the map. None if the map has nothing to register against.
    """

    cloud: SurfelMap | None

    @classmethod
    def open(
        cls, path: Path, *, verify: bool = True, compare_hashes: bool = True, known_streets: StreetsFile | None = None
    ) -> "MapBundle":
        """Open a bundle that ``write_bundle`` wrote. It may lack the files that the service does not read.

        Args:
            path: the bundle's folder.
            verify: compare the hash of every file that the service reads with the manifest, and check every index of the cloud and of
                the inverted file. Sizes and shapes are always checked.
            compare_hashes: False leaves out the hashes, because the caller has compared them.
            known_streets: streets of a map that has this tile. They are not read again if the tile has the same file.

        Raises:
            BundleError: the bundle is missing, damaged, of another format, or inconsistent. The message names the file and
                the remedy.
        """
        manifest = read_manifest(path)
        if manifest.tiles:
            raise BundleError(
                f"{path}: a tiled map, and this command needs a map of one bundle; give one of the folders in {path / TILES_FOLDER}, "
                "or build the map without --tile-m",
                field=FILE,
            )
        require_files(path, manifest, NEEDED, verify=verify and compare_hashes)
        named = read_streets(path, manifest, known_streets)
        bundle = cls(
            path=path,
            manifest=manifest,
            grid=manifest.view_grid,
            rows_seen=np.array(manifest.rows_seen, np.bool_),
            places=map_array(path / parts.PLACES_FILE, expected=parts.PLACE),
            views=map_array(path / parts.VIEWS_FILE, expected=parts.VIEW),
            view_index=_view_index(path, manifest, verify=verify),
            streets=None if named is None else named.streets,
            streets_document=None if named is None else named.document,
            calibration=read_calibration(
                read_file(path / parts.CALIBRATION_FILE), path=str(path / parts.CALIBRATION_FILE)
            ),
            cloud=_cloud(path, manifest, verify=verify),
        )
        _require_consistent(bundle)
        return bundle


def read_streets(path: Path, manifest: Manifest, known: StreetsFile | None = None) -> StreetsFile | None:
    """Read the streets of a bundle or of a tiled map.

    Args:
        path: its folder.
        manifest: its manifest.
        known: streets that were read before; they are returned if the file is the same.

    Returns:
        The streets; None if there are none.

    Raises:
        BundleError: the file cannot be read, or has no valid streets.
    """
    entry = manifest.files.get(streets.FILE)
    if entry is None:
        return None
    if known is not None and known.sha256 == entry.sha256:
        return known
    document = read_file(path / streets.FILE)
    return StreetsFile(entry.sha256, document, Streets.from_geojson(json_object(document, path / streets.FILE)))


def _view_index(path: Path, manifest: Manifest, *, verify: bool) -> ViewIndex:
    shortlister: Shortlister | None = None
    if inverted_file.FILE in manifest.files:
        shortlister = InvertedFile.open(
            path / inverted_file.FILE,
            views=manifest.counts.views,
            dimension=manifest.counts.descriptor_size,
            headings=manifest.headings,
            verify=verify,
        )
    elif index.COARSE_FILE in manifest.files:
        shortlister = ScannedCopy.open(
            path / index.COARSE_FILE, views=manifest.counts.views, dimension=manifest.counts.descriptor_size
        )
    return ViewIndex.open(path / index.FILE, shortlister=shortlister)


def _cloud(path: Path, manifest: Manifest, *, verify: bool) -> SurfelMap | None:
    prefix, suffix = f"{parts.CLOUD_FOLDER}/", ".npy"
    names = [name for name in manifest.files if name.startswith(prefix) and name.endswith(suffix)]
    if not names:
        return None
    arrays = {name.removeprefix(prefix).removesuffix(suffix): map_array(path / name, expected=None) for name in names}
    try:
        return SurfelMap.from_arrays(arrays, verify=verify)
    except BundleError as error:
        raise BundleError(f"{path}/{error}", field=error.field) from error


def _require_consistent(bundle: MapBundle) -> None:
    counts, path = bundle.manifest.counts, bundle.path
    streets_found = 0 if bundle.streets is None else len(bundle.streets)
    found = {
        parts.PLACES_FILE: (len(bundle.places), counts.places, "places"),
        parts.VIEWS_FILE: (len(bundle.views), counts.views, "views"),
        index.FILE: (len(bundle.view_index), counts.views, "descriptors"),
        streets.FILE: (streets_found, counts.streets, "streets"),
        parts.CLOUD_FOLDER: (0 if bundle.cloud is None else len(bundle.cloud.surfels), counts.cloud_points, "points"),
    }
    for name, (has, expected, what) in found.items():
        if has != expected:
            raise damaged_file(path / name, f"{has} {what} instead of {expected}")
    if bundle.view_index.dimension != counts.descriptor_size:
        raise damaged_file(
            path / index.FILE,
            f"descriptors of {bundle.view_index.dimension} numbers instead of {counts.descriptor_size}",
        )
    if bundle.view_place.min() < 0 or bundle.view_place.max() >= counts.places:
        raise damaged_file(path / parts.VIEWS_FILE, "a view refers to a missing place")
    if bundle.place_street.min() < -1 or bundle.place_street.max() >= streets_found:
        raise damaged_file(path / parts.PLACES_FILE, "a place refers to a missing street")
    if not np.array_equal(bundle.view_place, np.repeat(np.arange(counts.places), bundle.manifest.headings)):
        raise damaged_file(
            path / parts.VIEWS_FILE, "the views are not sorted by place, with all headings of each place"
        )
    if not np.isfinite(bundle.view_heading_rad).all():
        raise damaged_file(path / parts.VIEWS_FILE, "a heading is not finite")
    if not parts.are_poses(bundle.T_map_place):
        raise damaged_file(path / parts.PLACES_FILE, parts.NO_POSE)
