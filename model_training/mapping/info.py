"""``streetfix map info``: describe the content of a bundle."""

from pathlib import Path
from typing import Any

import numpy as np

from model_training.mapping.stored_map import streets_of_bundle
from service.maps import content as parts
from service.maps.manifest import FILE, Manifest, read_manifest
from service.maps.tiles import open_map
from service.retrieval.encoder import Encoder


def info_of(path: Path) -> dict[str, Any]:
    """Return the content of a bundle as JSON values; lengths in metres, map frame, sizes in bytes.

    It does not check the hashes of the files. ``damage_of`` does.

    Args:
        path: folder of the bundle.

    Raises:
        BundleError: the folder is not a bundle, or the bundle does not open.
    """
    bundle = open_map(path, verify=False)
    manifest = bundle.manifest
    xyz = bundle.T_map_place[:, :3, 3]
    streets = streets_of_bundle(bundle) or {"features": []}
    names = {feature["properties"]["street"]: feature["properties"]["name"] for feature in streets["features"]}
    calibration = bundle.calibration
    site, rig, rigs = (None, None, ()) if calibration is None else (calibration.site, calibration.rig, calibration.rigs)
    return {
        "name": manifest.name,
        "version": manifest.version,
        "format": manifest.format,
        "made_at": manifest.made_at.isoformat(),
        "size_bytes": _size(path, manifest),
        "tile_m": manifest.tile_m,
        "tiles": [tile.model_dump(include={"column", "row", "version", "size"}) for tile in manifest.tiles],
        "counts": manifest.counts.model_dump(),
        "headings": manifest.headings,
        "spacing_m": manifest.spacing_m,
        "rows_seen": int(np.count_nonzero(bundle.rows_seen)),
        "rows": manifest.grid.rows,
        "extent_m": {"min": xyz.min(axis=0).round(2).tolist(), "max": xyz.max(axis=0).round(2).tolist()},
        "places_in_no_street": int((bundle.place_street < 0).sum()),
        "streets": sorted(names),
        "parameters": manifest.parameters,
        "georeference": manifest.georeference,
        "encoder": {
            "sha256": manifest.encoder_sha256,
            "trained_on": list(Encoder.open(bundle.encoder_bytes()).trained_on),
        },
        "calibrated": calibration is not None,
        "site": None if site is None else site.model_dump(),
        "rig": None if rig is None else rig.model_dump(),
        "rigs": [each.model_dump() for each in rigs],
        "keeps_sums": all(parts.STATISTICS_FILE in each.files for each in _bundles(path, manifest)),
        "licence": manifest.licence,
        "tool_versions": manifest.tool_versions,
        "files": {name: entry.size for name, entry in sorted(manifest.files.items())},
    }


def _bundles(path: Path, manifest: Manifest) -> list[Manifest]:
    """Return the manifest of each bundle of a map: its own, or those of its tiles."""
    return [read_manifest(path / tile.folder) for tile in manifest.tiles] or [manifest]


def _size(path: Path, manifest: Manifest) -> int:
    """Return the size of all files of a map, bytes."""
    shared = sum(entry.size for entry in manifest.files.values()) + (path / FILE).stat().st_size
    tiles = sum(tile.size + (path / tile.folder / FILE).stat().st_size for tile in manifest.tiles)
    return shared + tiles
