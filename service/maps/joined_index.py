"""The descriptors of several tiles as one array, and one shortlist from their shortlists."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float32, Int64
from numpy.typing import NDArray

from service.maps.index import Rows


class JoinedRows:
    """The rows of several arrays of descriptors, one array after the other. Only the rows that are read are copied.

    Args:
        sizes: number of rows of each array.
        dimension: number of components.
        rows_of: returns an array by its number.
    """

    def __init__(self, sizes: Sequence[int], dimension: int, rows_of: Callable[[int], Rows]) -> None:
        self._first = np.cumsum([0, *sizes])
        self._dimension, self._rows_of = dimension, rows_of

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of rows, and number of components."""
        return len(self), self._dimension

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self._first[-1])

    def __getitem__(self, views: Any, /) -> NDArray[np.int8]:
        """Return some rows.

        Args:
            views: a slice, or the numbers of the rows.
        """
        wanted = np.arange(len(self))[views] if isinstance(views, slice) else np.asarray(views, np.int64)
        rows = np.empty((len(wanted), self._dimension), np.int8)
        owner = np.searchsorted(self._first, wanted, side="right") - 1
        for number in np.unique(owner):
            own = np.flatnonzero(owner == number)
            rows[own] = self._rows_of(int(number))[wanted[own] - self._first[number]]
        return rows


class Listing(Protocol):
    """Something with views that returns a shortlist, such as ``ViewIndex``."""

    def __len__(self) -> int:
        """Return the number of views."""

    def shortlist(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " n"]:
        """Return the indices of about the k most similar views.

        Args:
            descriptor: descriptor of the query view.
            k: length of the list.
        """


class JoinedShortlists:
    """Makes a shortlist of each tile. Together they are as many times longer, so none of the best views is lost.

    Args:
        sizes: number of views of each tile.
        index_of: returns the index of a tile by its number.
    """

    def __init__(self, sizes: Sequence[int], index_of: Callable[[int], Listing]) -> None:
        self._first, self._index_of = np.cumsum([0, *sizes]), index_of

    def shortlist(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " n"]:
        """Return the indices of about the k most similar views of each tile.

        Args:
            descriptor: descriptor of the query view.
            k: length of the list of a tile.
        """
        tiles = range(len(self._first) - 1)
        return np.concatenate([self._first[tile] + self._index_of(tile).shortlist(descriptor, k) for tile in tiles])
