"""Lookup grids as those of tiles."""

from dataclasses import replace

import numpy as np

from service.maps.content import BundleContent
from service.registration.surfel_map import SurfelMap


def on_lattice(cloud: SurfelMap | None) -> SurfelMap:
    """Return a cloud with the lookup grid of a tile: its corner is whole regions away from the origin of the map frame."""
    assert cloud is not None
    rows = np.arange(len(cloud.surfels))
    packed = SurfelMap.packed(cloud.unpacked(rows), cloud.brightness_of(rows), -cloud.origin_m)
    return SurfelMap.of_packed(cloud.origin_m, *packed)


def as_tile(content: BundleContent) -> BundleContent:
    """Return the content of a bundle. Its cloud, if it has one, fits to those of other tiles."""
    return content if content.cloud is None else replace(content, cloud=on_lattice(content.cloud))
