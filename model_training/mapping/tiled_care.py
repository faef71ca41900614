"""``streetfix map diff`` and ``merge`` of tiled maps: operations on lists of tiles. A tile that is the same stays the same files."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from model_training.mapping.diff import diff_of
from model_training.mapping.merge import merge_maps, with_ground_of
from model_training.mapping.stored_map import voxel_edge_m
from model_training.mapping.tile_area import Square, TileArea
from service.errors import BundleError
from service.maps.calibration import Calibration, read_calibration
from service.maps.content import CALIBRATION_FILE
from service.maps.files import read_file
from service.maps.manifest import Manifest, Tile, read_manifest
from service.maps.reader import MapBundle
from service.maps.tiled_writer import write_tiled
from service.maps.tiles import require_shared_cloud

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]
#: Column and row of a tile.
ColumnRow = tuple[int, int]


def tiles_of(read: Manifest) -> dict[ColumnRow, Tile]:
    """Return the tiles of a map by column and row.

    Args:
        read: manifest of a tiled map.
    """
    return {(tile.column, tile.row): tile for tile in read.tiles}


def diff_of_tiles(before: Path, after: Path, *, report: Report = lambda *_: None) -> dict[str, Any]:
    """Return the changes from one tiled map to another as JSON values.

    Only tiles of two versions are opened. ``changed`` has for each of them the result of ``diff_of`` for a bundle.

    Args:
        before: folder of a tiled map.
        after: folder of another one, with the same squares.
        report: called after every tile.

    Raises:
        BundleError: a map is damaged or not tiled, or the edges of the tiles differ.
    """
    first, second = _same_squares(before, after)
    old, new = tiles_of(first), tiles_of(second)
    both = sorted(old.keys() & new.keys())
    moved = [square for square in both if old[square].version != new[square].version]
    changed = []
    for number, square in enumerate(moved, 1):
        a, b = (MapBundle.open(path / of[square].folder) for path, of in ((before, old), (after, new)))
        changed.append({"column": square[0], "row": square[1], **diff_of(a, b)})
        report("tiles", number, len(moved))
    return {
        "versions": [first.version, second.version],
        "added": sorted(new.keys() - old.keys()),
        "removed": sorted(old.keys() - new.keys()),
        "kept": len(both) - len(moved),
        "changed": changed,
        "encoder_changed": first.encoder_sha256 != second.encoder_sha256,
    }


def merge_tiled(
    first: Path,
    second: Path,
    out: Path,
    *,
    name: str | None = None,
    overwrite: bool = False,
    report: Report = lambda *_: None,
) -> Manifest:
    """Merge two tiled maps into a new one; return its manifest.

    Where both have a tile, ``merge_maps`` merges the two, unless they are the same. A square that only one map has keeps its tile, unless
    tiles of the other map have surfaces there. Then it gets these (``with_ground_of``). A
    correction for a rig stays if both maps have the same.

    Args:
        first: folder of a tiled map.
        second: folder of another one, with the same squares.
        out: folder of the new map. It appears complete or not at all.
        name: name of the new map; None takes the name of the first.
        overwrite: replace an existing map at ``out``.
        report: called after every square.

    Raises:
        DatasetError: two tiles lie too far from each other for one cloud.
        BundleError: a map is damaged or not tiled, the maps do not fit together, or ``out`` exists and ``overwrite`` is False.
    """
    if out.exists() and not overwrite:
        raise BundleError(f"{out}: already exists; choose another --out, or pass --overwrite", field="out")
    read, other = _same_squares(first, second)
    one, two = tiles_of(read), tiles_of(other)
    squares = sorted(one.keys() | two.keys())
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}.", suffix=".merging", dir=out.parent) as merging:
        folders: dict[ColumnRow, Path] = {}
        for number, square in enumerate(squares, 1):
            of = [
                path / tiles[square].folder if square in tiles else None
                for path, tiles in ((first, one), (second, two))
            ]
            new = Path(merging) / f"{square[0]}_{square[1]}"
            folders[square] = of[0] or of[1] or new
            if of[0] is not None and of[1] is not None:
                if one[square].version != two[square].version:
                    area = _area(square, squares, read.tile_m or 0.0, of[0])
                    merge_maps(of[0], of[1], new, name=name or read.name, area=area)
                    folders[square] = new
            else:
                # Tiles that only the other map has may have surfaces in this square.
                path, tiles, known = (second, two, one) if of[1] is None else (first, one, two)
                area = _area(square, squares, read.tile_m or 0.0, folders[square])
                versions = {tile.version for tile in known.values()}
                others = [
                    path / tile.folder
                    for each, tile in tiles.items()
                    if tile.version not in versions and area.may_share(each)
                ]
                if others and with_ground_of(folders[square], others, new, area):
                    folders[square] = new
            report("merge", number, len(squares))
        corrected = _with_common(_calibration_of(first), _calibration_of(second))
        return write_tiled(
            out, folders, read.tile_m or 0.0, name=name or read.name, overwrite=overwrite, corrected=corrected
        )


def _area(square: ColumnRow, squares: Sequence[ColumnRow], tile_m: float, tile: Path) -> TileArea:
    """Return the ground that a tile of the merged map covers. ``tile`` is a tile of its square."""
    return TileArea(Square(*square, tile_m), set(squares), voxel_edge_m(MapBundle.open(tile, verify=False)))


def _with_common(one: Calibration | None, other: Calibration | None) -> Calibration | None:
    """Return a calibration with the corrections for rigs that it has in common with another one."""
    if one is None or other is None:
        return None
    both = tuple(each for each in one.rigs if each in other.rigs)
    return one.model_copy(update={"rig": one.rig if one.rig == other.rig else None, "rigs": both})


def _calibration_of(path: Path) -> Calibration | None:
    file = path / CALIBRATION_FILE
    return read_calibration(read_file(file), path=str(file))


def _same_squares(first: Path, second: Path) -> tuple[Manifest, Manifest]:
    """Return the manifests of two tiled maps with the same squares."""
    read, other = read_manifest(first), read_manifest(second)
    for path, each in ((first, read), (second, other)):
        if not each.tiles:
            raise BundleError(
                f"{path}: a map of one bundle, but the other map is tiled; build it with --tile-m, or take two maps of one bundle",
                field="tiles",
            )
        require_shared_cloud(path, each)
    if read.tile_m != other.tile_m:
        raise BundleError(
            f"tile_m: {first} has {read.tile_m:g} m, {second} has {other.tile_m:g} m; build one of them again with the other's --tile-m",
            field="tile_m",
        )
    if read.georeference != other.georeference:
        raise BundleError(
            f"georeference: {first} has {read.georeference}, {second} has {other.georeference}; the squares differ on the ground. Build "
            "both maps in one frame",
            field="georeference",
        )
    return read, other
