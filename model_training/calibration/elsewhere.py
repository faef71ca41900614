"""Out-of-map queries from queries in the map: the map without the places around the camera.

The images stay as they are. Only retrieval loses the places, so every start of registration is far from the true pose. The cloud stays
whole. It has no influence, because a candidate is registered on the cloud around itself.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.localization.localizer import Localizer
from service.maps.index import Descriptors, ViewIndex

#: A position further than this from every place is outside the map, metres. Registration moves a start by a few metres at most.
OUTSIDE_M = 20.0
#: Smallest number of places that must remain. In a smaller rest even a random answer would look certain.
FEWEST_LEFT = 10


class RemainingViews(ViewIndex):
    """The index of a map without some of its views. Views keep their indices.

    Args:
        whole: index of the whole map.
        remaining: True for the views that remain (V,).
    """

    def __init__(self, whole: ViewIndex, remaining: NDArray[np.bool_]) -> None:
        self._whole, self._remaining = whole, remaining
        self._views = np.flatnonzero(remaining)

    def __len__(self) -> int:
        return len(self._views)

    @property
    def dimension(self) -> int:
        """Number of components of a descriptor."""
        return self._whole.dimension

    def shortlist(self, descriptor: NDArray[np.float32], k: int) -> NDArray[np.int64]:
        """Return the indices of at least approximately the k most similar remaining views, in no particular order.

        Args:
            descriptor: descriptor of the query view (D,).
            k: number of views.
        """
        if k >= len(self):
            return self._views
        found = self._whole.shortlist(descriptor, k + len(self._remaining) - len(self._views))
        return found[self._remaining[found]]

    def vectors(self, views: NDArray[np.int64]) -> Descriptors:
        """Return the descriptors of some views.

        Args:
            views: indices of the views (n,).
        """
        return self._whole.vectors(views)


def is_outside(
    places_xy: NDArray[np.float64], xy: NDArray[np.float64], margin_m: float | NDArray[np.float64] = 0.0
) -> NDArray[np.bool_]:
    """Return whether each position is outside the map: further than ``OUTSIDE_M`` from every place (n,).

    Args:
        places_xy: positions of the places (P, 2), map frame, metres.
        xy: positions (n, 2), map frame, metres. NaN is not outside.
        margin_m: how far a position may be off, metres: one number, or (n,).
    """
    nearest = np.array([np.hypot(*(places_xy - each).T).min() for each in xy]).reshape(len(xy))
    return np.asarray(nearest - margin_m > OUTSIDE_M)


def without_surroundings(localizer: Localizer, xy: NDArray[np.float64]) -> Localizer | None:
    """Return a localizer whose map lacks the places within ``OUTSIDE_M`` of a position; None if too few places remain.

    Args:
        localizer: localizer of the map.
        xy: position of the camera (2,), map frame, metres.
    """
    bundle = localizer.bundle
    far = np.hypot(*(bundle.T_map_place[:, :2, 3] - xy).T) > OUTSIDE_M
    if int(far.sum()) < FEWEST_LEFT:
        return None
    views = RemainingViews(bundle.view_index, far[bundle.view_place])
    return Localizer(
        replace(bundle, view_index=views), localizer.encoder, clusters=localizer.clusters, refining=localizer.refining
    )
