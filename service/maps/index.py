"""The memory-mapped FAISS index of view descriptors, and a coarse copy in memory that makes a shortlist for it.

FAISS makes the coarse copy: principal axes and 8-bit numbers. Decision 0144 compares it with code of our own.
"""

from pathlib import Path

import faiss
import numpy as np
from jaxtyping import Float32, Int64
from numpy.typing import NDArray

from service.errors import BundleError

FILE = "views.faiss"
#: Number of principal axes of the coarse copy. With fewer, the list loses similar views (decision 0144).
_AXES = 64
#: Smallest number of views for a coarse copy. A scan of fewer exact descriptors takes no longer.
_FEWEST = 1000
#: Largest number of views that determine the principal axes.
_SAMPLE = 16_384
#: Views that are copied at once.
_CHUNK = 16_384

Descriptors = Float32[NDArray[np.float32], "n D"]


def search_with_one_thread() -> None:
    """Make FAISS search with one thread, because the service runs whole requests in parallel.

    OpenMP stores the number of threads per calling thread. So every worker thread calls this function once.
    """
    faiss.omp_set_num_threads(1)


def write_index(path: Path, descriptors: Descriptors) -> None:
    """Write descriptors as a flat FAISS index of inner products.

    Args:
        path: the new file.
        descriptors: unit vectors, a row per view.
    """
    index = faiss.IndexFlatIP(descriptors.shape[1])
    index.add(np.ascontiguousarray(descriptors))
    faiss.write_index(index, str(path))


def _coarse_copy(index: faiss.Index) -> tuple[faiss.Index, Float32[NDArray[np.float32], " D"]]:
    """Return an index of 8-bit components along the principal axes, and the mean descriptor that it subtracts.

    The copy is small, so a scan of it hardly waits for memory.

    Args:
        index: the exact index, with at least ``_FEWEST`` views.
    """
    axes = faiss.PCAMatrix(index.d, min(_AXES, index.d))
    numbers = faiss.IndexScalarQuantizer(axes.d_out, faiss.ScalarQuantizer.QT_8bit_uniform, faiss.METRIC_INNER_PRODUCT)
    coarse = faiss.IndexPreTransform(axes, numbers)
    coarse.train(index.reconstruct_batch(np.arange(0, index.ntotal, -(-index.ntotal // _SAMPLE))))
    for first in range(0, index.ntotal, _CHUNK):
        coarse.add(index.reconstruct_n(first, min(_CHUNK, index.ntotal - first)))
    return coarse, np.array(faiss.vector_to_array(axes.mean), np.float32)


def _is_finite(index: faiss.Index) -> bool:
    """Return whether all descriptors are finite.

    Args:
        index: the exact index.
    """
    pieces = (index.reconstruct_n(first, min(_CHUNK, index.ntotal - first)) for first in range(0, index.ntotal, _CHUNK))
    return all(bool(np.isfinite(piece).all()) for piece in pieces)


class ViewIndex:
    """An open index of view descriptors. Several threads may search it at the same time.

    Attributes:
        is_finite: False if a descriptor is not finite.

    Args:
        index: flat FAISS index of inner products.
    """

    def __init__(self, index: faiss.Index) -> None:
        self._index = index
        self.is_finite = _is_finite(index)
        self._coarse, self._mean = index, np.zeros(index.d, np.float32)
        if self.is_finite and index.ntotal >= _FEWEST:
            self._coarse, self._mean = _coarse_copy(index)

    @classmethod
    def open(cls, path: Path) -> "ViewIndex":
        """Map an index file into memory and make the coarse copy.

        FAISS is set to one search thread for the calling thread.

        Args:
            path: file that ``write_index`` wrote.

        Raises:
            BundleError: the file is not a flat index of inner products, or a descriptor is not finite.
        """
        search_with_one_thread()
        try:
            index = faiss.read_index(str(path), faiss.IO_FLAG_MMAP_IFC)
        except RuntimeError as error:
            raise BundleError(f"{path}: not a FAISS index; copy or build the bundle again", field=FILE) from error
        # A downcast index refers to the original index and must not outlive it. So only its type is kept.
        kind = type(faiss.downcast_index(index))
        if not issubclass(kind, faiss.IndexFlat) or index.metric_type != faiss.METRIC_INNER_PRODUCT:
            raise BundleError(
                f"{path}: the index is a {kind.__name__}, not a flat inner-product index; build the bundle again",
                field=FILE,
            )
        found = cls(index)
        if not found.is_finite:
            raise BundleError(f"{path}: a descriptor is not finite; copy or build the bundle again", field=FILE)
        return found

    def __len__(self) -> int:
        return int(self._index.ntotal)

    @property
    def dimension(self) -> int:
        """Number of components of a descriptor."""
        return int(self._index.d)

    def shortlist(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " k"]:
        """Return the indices of approximately the k most similar views, in no particular order.

        The search uses the coarse 8-bit copy, if the map has one. The caller then compares the listed views exactly with
        ``vectors``. The list must be several times longer than the number of wanted views (decision 0046).

        Args:
            descriptor: descriptor of the query view.
            k: length of the list. All views are returned if the index has no more than k.
        """
        if k >= len(self):
            return np.arange(len(self))
        # The coarse copy subtracts the mean from views and queries. Only views may lose it: then a similarity differs from
        # the exact one by the same constant for all views.
        found: NDArray[np.int64] = self._coarse.search((descriptor + self._mean)[None], k)[1][0]
        return found

    def vectors(self, views: Int64[NDArray[np.int64], " n"]) -> Descriptors:
        """Return the exact descriptors of some views.

        Args:
            views: indices of the views.
        """
        found: Descriptors = self._index.reconstruct_batch(np.ascontiguousarray(views))
        return found
