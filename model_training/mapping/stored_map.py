"""Read a stored bundle back into the content that it was written from, to build another map from it."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model_training.mapping.tile_area import TileArea
from model_training.mapping.voxel_map import MOMENTS, VOXEL, VoxelMap, lattice_origin
from service.errors import BundleError
from service.maps import content as parts
from service.maps import streets
from service.maps.byte_planes import read_records
from service.maps.content import BundleContent
from service.maps.map import Map
from service.maps.reader import MapBundle
from service.maps.writer import sha256_of


def content_of(bundle: MapBundle) -> BundleContent:
    """Return the content of a bundle without its cloud and its preview image; ``voxels_of`` returns the cloud.

    Args:
        bundle: the bundle.
    """
    manifest = bundle.manifest
    return BundleContent(
        name=manifest.name,
        grid=bundle.grid,
        headings=manifest.headings,
        spacing_m=manifest.spacing_m,
        rows_seen=bundle.rows_seen,
        T_map_place=np.array(bundle.T_map_place),
        place_street=np.array(bundle.place_street),
        view_place=np.array(bundle.view_place),
        view_heading_rad=np.array(bundle.view_heading_rad),
        descriptors=bundle.view_index.vectors(np.arange(len(bundle.views))),
        encoder=bundle.encoder_bytes(),
        parameters=dict(manifest.parameters),
        streets=streets_of_bundle(bundle),
        calibration=json.loads((bundle.path / parts.CALIBRATION_FILE).read_bytes()),
        georeference=manifest.georeference,
        licence=manifest.licence,
        tool_versions=manifest.tool_versions,
    )


def streets_of_bundle(bundle: Map) -> dict[str, Any] | None:
    """Return the GeoJSON of the streets; None for a map without streets.

    Args:
        bundle: the bundle.
    """
    if bundle.streets is None:
        return None
    document: dict[str, Any] = json.loads((bundle.path / streets.FILE).read_bytes())
    return document


def voxel_edge_m(bundle: MapBundle) -> float:
    """Return the edge of the cloud's voxels, metres.

    Args:
        bundle: the bundle.

    Raises:
        BundleError: the manifest has no ``voxel_m`` above 0.
    """
    edge = bundle.manifest.parameters.get("voxel_m", 0.0)
    if not edge > 0:
        raise BundleError(f"{bundle.path}: its parameters have no voxel_m; build the map again", field="voxel_m")
    return edge


def empty_voxels_of(bundle: MapBundle) -> VoxelMap:
    """Return an empty voxel map with the voxel edge of a bundle and its origin in the middle of the places.

    Args:
        bundle: the bundle.

    Raises:
        BundleError: the manifest has no ``voxel_m`` above 0.
    """
    edge = voxel_edge_m(bundle)
    return VoxelMap(edge, lattice_origin(edge, bundle.T_map_place[:, :3, 3].mean(axis=0)))


def voxels_of(bundle: MapBundle) -> VoxelMap:
    """Return the voxels of a bundle, ready for more points.

    A bundle that stores the sums of its voxels returns them unchanged. The voxels of another bundle are approximated from its surfels.
    The points of a surfel then spread evenly around its mean, as wide as the voxel and as thick as the surfel. Voxels with too few
    points for a surfel are lost.

    Args:
        bundle: the bundle.

    Raises:
        BundleError: the file of the sums is damaged or has another format, or the manifest has no ``voxel_m``.
    """
    voxels = empty_voxels_of(bundle)
    edge = voxels.voxel_m
    if parts.STATISTICS_FILE in bundle.manifest.files:
        voxels.add_statistics(read_statistics(bundle))
    elif bundle.cloud is not None:
        surfels = bundle.cloud.unpacked(np.s_[:])
        across = surfels["normal"].astype(np.float64)
        outer = across[:, :, None] * across[:, None, :]
        flat, thick = edge**2 / 12, surfels["thickness_m"].astype(np.float64)[:, None, None] ** 2
        voxels.add_moments(
            surfels["xyz"] + bundle.cloud.origin_m,
            np.maximum(surfels["points"], 1),
            flat * (np.eye(3) - outer) + thick * outer,
        )
    return voxels


def voxels_in(tiles: Iterable[Path], area: TileArea, empty: VoxelMap) -> VoxelMap:
    """Return the voxels that some tiles have on the ground of another one.

    Tiles store the points near their edges each on its own. So of a voxel that several have, the one with the most points is taken.

    Args:
        tiles: folders of the tiles.
        area: the ground of the other tile.
        empty: an empty voxel map, which gets the voxels.

    Raises:
        BundleError: as ``voxels_of``.
    """
    keys, moments = [np.zeros(0, np.int64)], [np.zeros((0, MOMENTS), np.float32)]
    for path in tiles:
        other = VoxelMap(empty.voxel_m, empty.origin)
        other.add_statistics(voxels_of(MapBundle.open(path)).statistics())
        inside = area.is_in_cloud(other.means())
        keys.append(other.sums()[0][inside])
        moments.append(other.sums()[1][inside])
    of_all, sums = np.concatenate(keys), np.concatenate(moments)
    order = np.lexsort((-sums[:, 0], of_all))
    first = order[np.unique(of_all[order], return_index=True)[1]]
    empty.add_sums(of_all[first], sums[first])
    return empty


def read_statistics(bundle: MapBundle) -> NDArray[Any]:
    """Read the sums of the voxels' points: (n,) of ``VOXEL``.

    Args:
        bundle: a bundle that stores sums.

    Raises:
        BundleError: the file is damaged or cannot be read, has another type, or holds an empty voxel or a sum that is not finite.
    """
    file = bundle.path / parts.STATISTICS_FILE
    try:
        if sha256_of(file) != bundle.manifest.files[parts.STATISTICS_FILE].sha256:
            raise _defect(bundle, "the hash does not match the manifest")
        found = read_records(file, VOXEL)
    except (OSError, ValueError) as error:
        raise _defect(bundle, f"not a valid file of voxels ({error})") from error
    if not all(np.isfinite(found[name]).all() for name in ("sums", "brightness")) or not (found["points"] > 0).all():
        raise _defect(bundle, "a voxel has no points, or a sum that is not finite")
    return found


def _defect(bundle: MapBundle, what: str) -> BundleError:
    return BundleError(
        f"{bundle.path / parts.STATISTICS_FILE}: {what}; copy or build the bundle again", field=parts.STATISTICS_FILE
    )
