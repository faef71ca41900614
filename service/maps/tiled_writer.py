"""Write a tiled map from finished tiles, atomically."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import BundleError
from service.maps import content as parts
from service.maps import index, inverted_file, manifest, streets
from service.maps.calibration import Calibration, Site, read_calibration
from service.maps.files import json_object, read_file, require_files
from service.maps.inverted_file import InvertedFile
from service.maps.joined_index import JoinedRows
from service.maps.manifest import TILES_FOLDER, Counts, FileEntry, Manifest, Tile, read_manifest
from service.maps.reader import NEEDED, MapBundle
from service.maps.streets import Streets
from service.maps.tiles import MOST_SEARCHED, differences, finds_tile, places_in_map, street_numbers
from service.maps.writer import in_place, json_bytes, link_or_copy, sha256_of, sync
from service.registration.surfel_map import SurfelMap
from service.registration.surfel_tiles import lies_on_lattice

#: Parameters of which the map states the largest of all tiles.
LARGEST = ("survey_position_std_m", "survey_angle_std_deg", "surveyed_height_m")
_REMEDY = "build all tiles with the same encoder and settings"


def write_tiled(
    out: Path,
    tiles: Mapping[tuple[int, int], Path],
    tile_m: float,
    *,
    name: str,
    overwrite: bool = False,
    corrected: Calibration | None = None,
) -> Manifest:
    """Write a tiled map and return its manifest.

    The files of the tiles become hard links, or copies where the file system has no links. Equal files, such as the encoder of each tile,
    become one file with several links. The map appears under ``out`` complete or not at all, as with ``write_bundle``.

    Args:
        out: folder of the map.
        tiles: folder of each tile's bundle, by column and row of its square.
        tile_m: edge of the squares, m.
        name: name of the map in requests.
        overwrite: replace an existing map.
        corrected: calibration whose corrections for rigs the map gets, because they belong to the whole map; None for none.

    Raises:
        BundleError: ``out`` exists and ``overwrite`` is False, there is no tile, a tile is damaged or does not fit to the others, or the
            file system reports an error.
    """
    if out.exists() and not overwrite:
        raise BundleError(f"{out}: already exists; choose another --out or pass --overwrite", field="out")
    if not tiles:
        raise BundleError(f"{out}: the map would have no tile; give at least one", field="tiles")
    squares, folders = sorted(tiles), [tiles[square] for square in sorted(tiles)]
    manifests = [_opened(folder) for folder in folders]
    for folder, each in zip(folders[1:], manifests[1:], strict=True):
        if different := differences(each, manifests[0]):
            raise BundleError(f"{folder}: {different[0]} differs from {folders[0]}; {_REMEDY}", field="tiles")
    if len(folders) > 1:
        require_lattice(folders)
    remedy = "free disk space or choose another folder"
    with in_place(out, f"{out}: the map cannot be written", remedy) as partial:
        links = _Links()
        entries = [
            _link_tile(partial, folder, each, square, links)
            for square, folder, each in zip(squares, folders, manifests, strict=True)
        ]
        made = _write_shared(partial, entries, manifests, tile_m, name, corrected, links)
        partial.chmod(0o755)
    return made


def _opened(folder: Path) -> Manifest:
    read = read_manifest(folder)
    if read.tiles:
        raise BundleError(f"{folder}: a tiled map cannot be a tile; give its tiles", field="tiles")
    require_files(folder, read, NEEDED, verify=False)
    return read


def require_lattice(folders: Sequence[Path]) -> None:
    """Refuse tiles whose clouds do not fit to those of other tiles.

    Args:
        folders: folders of the tiles.

    Raises:
        BundleError: a tile is damaged, or its lookup grid does not lie on the common lattice.
    """
    for folder in folders:
        cloud = MapBundle.open(folder, verify=False).cloud
        if isinstance(cloud, SurfelMap) and not lies_on_lattice(cloud):
            raise BundleError(
                f"{folder}: its cloud does not fit to those of other tiles, as in a map of one bundle; build the map with --tile-m",
                field="tiles",
            )


class _Links:
    """Links files into a map. Files with one hash become one file: each tile brings its own copy of the encoder and of the streets."""

    def __init__(self) -> None:
        self._first: dict[str, Path] = {}  # the first file in the map with a hash
        self._intact: set[Path] = set()

    def add(self, source: Path, target: Path, sha256: str) -> None:
        """Link a file into the map.

        Args:
            source: the file.
            target: the new file in the map.
            sha256: hash of the file by its manifest.
        """
        link_or_copy(self._known(sha256) or source, target)
        self._first.setdefault(sha256, target)

    def join(self, file: Path, sha256: str) -> None:
        """Replace a file of the map by a link to an equal one, if there is one.

        Args:
            file: the file.
            sha256: its hash.
        """
        known = self._known(sha256)
        if known is not None and not known.samefile(file):
            file.unlink()
            link_or_copy(known, file)

    def _known(self, sha256: str) -> Path | None:
        """Return a file of the map with a hash. A damaged file is no replacement for an intact one, so its content is compared once."""
        known = self._first.get(sha256)
        if known is None or known in self._intact:
            return known
        if sha256_of(known) != sha256:
            del self._first[sha256]
            return None
        self._intact.add(known)
        return known


def _link_tile(map_folder: Path, folder: Path, read: Manifest, square: tuple[int, int], links: _Links) -> Tile:
    """Link the files of a tile into the map; return its entry in the manifest."""
    target = map_folder / TILES_FOLDER / read.version
    if target.exists():
        raise BundleError(
            f"{folder}: another tile has the same content ({read.version}); give each square its own tile",
            field="tiles",
        )
    for name, entry in sorted(read.files.items()):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        links.add(folder / name, target / name, entry.sha256)
    link_or_copy(folder / manifest.FILE, target / manifest.FILE)
    for each in {(target / name).parent for name in read.files} | {target, target.parent}:
        sync(each)
    return Tile(
        column=square[0],
        row=square[1],
        version=read.version,
        size=sum(entry.size for entry in read.files.values()),
        counts=read.counts,
    )


def _write_shared(
    folder: Path,
    tiles: Sequence[Tile],
    manifests: Sequence[Manifest],
    tile_m: float,
    name: str,
    corrected: Calibration | None,
    links: _Links,
) -> Manifest:
    """Write the shared files and the manifest; return the manifest."""
    first, bundles = manifests[0], [folder / tile.folder for tile in tiles]
    names = [parts.ENCODER_FILE, parts.PLACES_FILE, parts.CALIBRATION_FILE]
    link_or_copy(bundles[0] / parts.ENCODER_FILE, folder / parts.ENCODER_FILE)
    document = joined_streets(
        [bundle / streets.FILE for bundle, each in zip(bundles, manifests, strict=True) if streets.FILE in each.files]
    )
    named = None if document is None else Streets.from_geojson(document)
    if document is not None:
        names.append(streets.FILE)
        (folder / streets.FILE).write_bytes(json_bytes(document))
    weights = [tile.counts.places for tile in tiles]
    lidar_height_m = float(np.average([each.lidar_height_m for each in manifests], weights=weights))
    if len({each.lidar_height_m for each in manifests}) == 1:
        lidar_height_m = first.lidar_height_m
    opened, numbers = (MapBundle.open(bundle, verify=False) for bundle in bundles), street_numbers(named)
    places = [places_in_map(each, numbers, lidar_height_m) for each in opened]
    np.save(folder / parts.PLACES_FILE, np.concatenate(places), allow_pickle=False)
    (folder / parts.CALIBRATION_FILE).write_bytes(json_bytes(_calibration(bundles, corrected)))
    parameters = {key: value for key, value in first.parameters.items() if key in _common(manifests)}
    parameters["lidar_height_m"] = lidar_height_m
    for key in LARGEST:
        stated = [each.parameters[key] for each in manifests if key in each.parameters]
        parameters |= {key: max(stated)} if stated else {}
    if len(tiles) > MOST_SEARCHED:
        names.append(inverted_file.FILE)
        arrays = [index.read_descriptors(bundle / index.FILE) for bundle in bundles]
        rows = JoinedRows([len(each) for each in arrays], arrays[0].shape[1], arrays.__getitem__)
        parameters |= _write_index(folder / inverted_file.FILE, rows, weights, first.headings)
    files = {
        each: FileEntry(sha256=sha256_of(folder / each), size=(folder / each).stat().st_size) for each in sorted(names)
    }
    for each, entry in files.items():
        links.join(folder / each, entry.sha256)
        sync(folder / each)
    made = first.model_copy(
        update={
            "name": name,
            "made_at": datetime.now(UTC),
            "parameters": parameters,
            "counts": Counts(
                places=sum(tile.counts.places for tile in tiles),
                views=sum(tile.counts.views for tile in tiles),
                descriptor_size=first.counts.descriptor_size,
                cloud_points=sum(tile.counts.cloud_points for tile in tiles),
                streets=0 if named is None else len(named),
            ),
            "files": files,
            "tile_m": tile_m,
            "tiles": tuple(tiles),
        }
    )
    made = Manifest.model_validate(made.model_dump()).stamped()
    (folder / manifest.FILE).write_bytes(made.to_bytes())
    sync(folder / manifest.FILE)
    return made


def _write_index(path: Path, rows: JoinedRows, places: Sequence[int], headings: int) -> dict[str, float]:
    """Write the search index of the map; return its recall, and the share of queries whose tile it chooses, as parameters.

    Args:
        path: the new file.
        rows: descriptors of all tiles.
        places: number of places of each tile.
        headings: number of views per place.
    """
    recall = inverted_file.write_inverted_file(path, rows, headings=headings)
    opened = InvertedFile.open(path, views=len(rows), dimension=rows.shape[1], headings=headings, verify=False)
    queries, own_views = inverted_file.noisy_queries(rows)
    finds = finds_tile(opened, queries, own_views, np.cumsum([0, *places]) * headings)
    return {inverted_file.RECALL: recall, inverted_file.FINDS_TILE: float(finds.mean())}


def _common(manifests: Sequence[Manifest]) -> set[str]:
    """Return the names of the parameters that are the same in all tiles."""
    first = manifests[0].parameters
    return {key for key, value in first.items() if all(each.parameters.get(key) == value for each in manifests)}


def joined_streets(paths: Sequence[Path]) -> dict[str, Any] | None:
    """Return the streets of all tiles, each once; None if there is none.

    Args:
        paths: GeoJSON file of each tile that has streets.

    Raises:
        BundleError: a file is damaged, or two tiles have different streets of one id.
    """
    if not paths:
        return None
    joined: dict[str, Any] = {}
    documents = [json_object(read_file(path), path) for path in paths]
    for path, document in zip(paths, documents, strict=True):
        Streets.from_geojson(document)  # checks it
        for feature in document["features"]:
            known = joined.setdefault(feature["properties"]["id"], feature)
            if known != feature:
                raise BundleError(
                    f"{path}: the street {feature['properties']['id']!r} differs from another tile; {_REMEDY}",
                    field=streets.FILE,
                )
    return {**documents[0], "features": list(joined.values())}


def _calibration(bundles: Sequence[Path], corrected: Calibration | None) -> dict[str, Any]:
    """Return the calibration of the map: that of the tiles, with the checks of all their sites together and the corrections of the map."""
    read = [_read(bundle) for bundle in bundles]
    first = read[0]
    plain = [None if each is None else each.model_copy(update={"site": None, "rig": None, "rigs": ()}) for each in read]
    for bundle, each in zip(bundles, plain, strict=True):
        if each != plain[0]:
            raise BundleError(
                f"{bundle}: {parts.CALIBRATION_FILE} differs from the other tiles; {_REMEDY}", field="tiles"
            )
    if first is None:
        return dict(parts.UNCALIBRATED)
    sites = [each.site for each in read if each is not None and each.site is not None]
    own = {"rig": None, "rigs": ()} if corrected is None else {"rig": corrected.rig, "rigs": corrected.rigs}
    return first.model_copy(update={"site": joined_site(sites), **own}).model_dump(mode="json")


def _read(bundle: Path) -> Calibration | None:
    path = bundle / parts.CALIBRATION_FILE
    return read_calibration(read_file(path), path=str(path))


def joined_site(sites: Sequence[Site]) -> Site | None:
    """Return the check of a map from the checks of its tiles; None if there is none.

    The offset and the calibration error are means over the queries of all tiles.

    Args:
        sites: check of each tile that has one.
    """
    queries: NDArray[np.float64] = np.array([site.queries for site in sites], np.float64)
    if not queries.sum():
        return None
    weights = queries / queries.sum()
    return Site(
        offset=float(weights @ [site.offset for site in sites]),
        queries=int(queries.sum()),
        right=sum(site.right for site in sites),
        expected_calibration_error=float(weights @ [site.expected_calibration_error for site in sites]),
    )
