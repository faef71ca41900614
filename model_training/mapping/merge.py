"""``streetfix map merge``: two bundles of one frame and one encoder become one."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from model_training.mapping.build import tool_versions
from model_training.mapping.cloud import with_cloud
from model_training.mapping.join import joined, require_same
from model_training.mapping.stored_map import content_of, empty_voxels_of, voxels_of
from service.errors import BundleError
from service.maps.manifest import Manifest
from service.maps.reader import MapBundle
from service.maps.writer import write_bundle

Report = Callable[[str, int, int], None]


def merge_maps(
    first: Path, second: Path, out: Path, *, name: str | None = None, overwrite: bool = False,
    report: Report = lambda *_: None,
) -> Manifest:  # fmt: skip
    """Merge two bundles.

    All places of the first stay; of the second, those no closer to them than the spacing. Sums of voxels add up, so the cloud is that
    of a map built of both surveys at once (of bundles that keep no sums ``stored_map.voxels_of`` says what is
    approximated). That both lie in the same frame is the caller's word; only their georeferences can be compared.

    Args:
        first: a bundle.
        second: another.
        out: folder of the new bundle; it appears whole or not at all.
        name: of the new map; by default that of the first.
        overwrite: replace a bundle that is there.
        report: told after every step.

    Raises:
        DatasetError: the maps lie too far from each other for one cloud.
        BundleError: a bundle is damaged, they do not fit together (it says in what), or ``out`` exists.
    """
    if out.exists() and not overwrite:
        raise BundleError(
            f"{out}: there is something of that name already; choose another, or overwrite it", field="out"
        )
    a, b = MapBundle.open(first), MapBundle.open(second)
    report("merge", 1, 4)
    one, other = content_of(a), content_of(b)
    require_same(one, other, names=(str(first), str(second)))
    empty_voxels_of(a).require_within(other.T_map_place[:, :3, 3], lambda place: f"{second}: place {place}")
    content = replace(joined(one, other), name=name or one.name, tool_versions=tool_versions())
    report("merge", 2, 4)
    cloud = voxels_of(a)
    cloud.add_statistics(voxels_of(b).statistics())
    content = with_cloud(content, cloud)
    report("merge", 3, 4)
    made = write_bundle(out, content, overwrite=overwrite)
    report("merge", 4, 4)
    return made
