"""``streetfix map merge``: merge two bundles of one frame and one encoder."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from model_training.mapping.build import tool_versions
from model_training.mapping.cloud import with_cloud
from model_training.mapping.join import joined, require_same
from model_training.mapping.stored_map import content_of, empty_voxels_of, voxels_of
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
    content = with_cloud(content, cloud, area)
    report("merge", 3, 4)
    made = write_bundle(out, content, overwrite=overwrite)
    report("merge", 4, 4)
    return made
