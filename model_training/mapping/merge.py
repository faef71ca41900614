"""``streetfix map merge``: merge two bundles of one frame and one encoder."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from model_training.mapping.build import tool_versions
from model_training.mapping.cloud import with_cloud
from model_training.mapping.join import joined, require_same
from model_training.mapping.stored_map import content_of, empty_voxels_of, voxels_in, voxels_of
from model_training.mapping.tile_area import TileArea
from service.errors import BundleError
from service.maps.manifest import Manifest
from service.maps.reader import MapBundle
from service.maps.writer import write_bundle

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]


def merge_maps(
    first: Path,
    second: Path,
    out: Path,
    *,
    name: str | None = None,
    area: TileArea | None = None,
    overwrite: bool = False,
    report: Report = lambda *_: None,
) -> Manifest:
    """Merge two bundles into a new one; return its manifest.

    All places of the first bundle stay. A place of the second stays if it keeps the spacing to them. The sums of the voxels add up, so
    the cloud equals that of a map built from both surveys at once. ``stored_map.voxels_of`` approximates the cloud of a bundle that
    stores no sums. The caller must ensure that both lie in the same frame. Only their georeferences are compared.

    Args:
        first: folder of a bundle.
        second: folder of another bundle.
        out: folder of the new bundle. It appears complete or not at all.
        name: name of the new map; None takes the name of the first.
        area: the ground that the new bundle covers, if it is a tile. None for a map of one bundle.
        overwrite: replace an existing bundle at ``out``.
        report: called after every step.

    Raises:
        DatasetError: the maps lie too far from each other for one cloud.
        BundleError: a bundle is damaged, the bundles do not fit together (the message names the field), or ``out`` exists and
            ``overwrite`` is False.
    """
    if out.exists() and not overwrite:
        raise BundleError(f"{out}: already exists; choose another --out, or pass --overwrite", field="out")
    a, b = MapBundle.open(first), MapBundle.open(second)
    report("merge", 1, 4)
    one, other = content_of(a), content_of(b)
    require_same(one, other, names=(str(first), str(second)))
    empty_voxels_of(a).require_within(other.T_map_place[:, :3, 3], lambda place: f"{second}: place {place}")
    content = replace(joined(one, other), name=name or one.name, tool_versions=tool_versions())
    report("merge", 2, 4)
    cloud = voxels_of(a)
    cloud.add_statistics(voxels_of(b).statistics())
    if area is not None:
        cloud.keep(area.is_in_cloud(cloud.means()))  # tiles beside it have the rest
    content = with_cloud(content, cloud, area)
    report("merge", 3, 4)
    made = write_bundle(out, content, overwrite=overwrite)
    report("merge", 4, 4)
    return made


def with_ground_of(tile: Path, others: Sequence[Path], out: Path, area: TileArea) -> bool:
    """Add to a tile what tiles of another map have on its ground. Write the new tile, or nothing if they have nothing there.

    Args:
        tile: folder of the tile.
        others: folders of tiles of the other map, around its square.
        out: folder of the new tile.
        area: the ground that the new tile covers.

    Returns:
        Whether there is a new tile.

    Raises:
        BundleError: a tile is damaged, or the new one cannot be written.
    """
    bundle = MapBundle.open(tile)
    added = voxels_in(others, area, empty_voxels_of(bundle))
    if not len(added.sums()[0]):
        return False
    cloud = voxels_of(bundle)
    cloud.add_statistics(added.statistics())
    cloud.keep(area.is_in_cloud(cloud.means()))
    write_bundle(out, with_cloud(replace(content_of(bundle), tool_versions=tool_versions()), cloud, area))
    return True
