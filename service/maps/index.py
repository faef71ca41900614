"""The memory-mapped FAISS index of view descriptors, and a coarse copy in memory that makes a shortlist for it."""

from pathlib import Path

import faiss
import numpy as np
from jaxtyping import Float32, Float64, Int64
from numpy.typing import NDArray

from service.errors import BundleError

FILE = "views.faiss"
#: Largest absolute value of an 8-bit component.
_LEVELS = 127.0
#: Least share of the descriptors' second moment that the kept principal axes hold.
_HELD = 0.999
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


class _Coarse:
    """A coarse copy of the descriptors: components along the principal axes, as signed 8-bit integers.

    The copy is small, so a scan of it hardly waits for memory. Fewer axes than components suffice. For the stock encoder,
    64 axes hold 99.99 % of the 256 components (decision 0065).

    Args:
        index: the exact index of the descriptors.
    """

    def __init__(self, index: faiss.Index) -> None:
        chunks = [range(first, min(first + _CHUNK, index.ntotal)) for first in range(0, index.ntotal, _CHUNK)]
        moment = np.zeros((index.d, index.d))
        for chunk in chunks:
            vectors = index.reconstruct_n(chunk.start, len(chunk))
            moment += vectors.T @ vectors
        self.is_finite = bool(np.isfinite(moment).all())
        self._axes = np.zeros((index.d, 0), np.float32)
        self._numbers: faiss.Index | None = None
        if not (self.is_finite and chunks):
            return
        self._axes = _principal_axes(moment)
        self._numbers = faiss.IndexScalarQuantizer(
            self._axes.shape[1], faiss.ScalarQuantizer.QT_8bit_direct_signed, faiss.METRIC_INNER_PRODUCT
        )
        largest = max(float(np.abs(self._along(index, chunk)).max()) for chunk in chunks)
        for chunk in chunks:
            self._numbers.add(np.rint(self._along(index, chunk) * np.float32(_LEVELS / max(largest, 1e-9))))

    def _along(self, index: faiss.Index, chunk: range) -> Float32[NDArray[np.float32], "n d"]:
        along: NDArray[np.float32] = index.reconstruct_n(chunk.start, len(chunk)) @ self._axes
        return along

    @property
    def count(self) -> int:
        """Number of components of a vector in this copy."""
        return int(self._axes.shape[1])

    def search(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " k"]:
        """Return the indices of approximately the k most similar views."""
        along = descriptor @ self._axes
        # The components are rounded to integers below. So they are scaled to the full 8-bit range first.
        levels = np.float32(_LEVELS / max(float(np.abs(along).max()), 1e-9))
        if self._numbers is None:
            return np.zeros(0, np.int64)
        found: NDArray[np.int64] = self._numbers.search(np.rint(along * levels)[None], k)[1][0]
        return found


def _principal_axes(moment: Float64[NDArray[np.float64], "D D"]) -> Float32[NDArray[np.float32], "D d"]:
    """Return the principal axes that hold the share ``_HELD`` of the second moment.

    Their number is a multiple of 16 where the descriptor is long enough, because a scan reads 16 components at once.
    """
    values, axes = np.linalg.eigh(moment)
    held = np.cumsum(values[::-1]) / max(float(values.sum()), 1e-9)
    count = min(len(values), 16 * (int(np.searchsorted(held, _HELD)) // 16 + 1))
    return np.ascontiguousarray(axes[:, ::-1][:, :count], np.float32)


class ViewIndex:
    """An open index of view descriptors. Several threads may search it at the same time.

    Attributes:
        is_finite: False if a descriptor is not finite.

    Args:
        index: flat FAISS index of inner products.
    """

    def __init__(self, index: faiss.Index) -> None:
        self._index = index
        self._coarse = _Coarse(index)
        self.is_finite = self._coarse.is_finite

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
            raise BundleError(f"{path}: this is no FAISS index; copy or build the bundle again", field=FILE) from error
        # A downcast index refers to the original index and must not outlive it. So only its type is kept.
        kind = type(faiss.downcast_index(index))
        if not issubclass(kind, faiss.IndexFlat) or index.metric_type != faiss.METRIC_INNER_PRODUCT:
            raise BundleError(
                f"{path}: the index is a {kind.__name__}, not a flat index of inner products; build the bundle again",
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

    @property
    def coarse_numbers(self) -> int:
        """Number of components of a vector in the coarse copy."""
        return self._coarse.count

    def shortlist(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " k"]:
        """Return the indices of approximately the k most similar views, in no particular order.

        The search uses the coarse 8-bit copy. The caller then compares the listed views exactly with ``vectors``. The list
        must be several times longer than the number of wanted views (decision 0046).

        Args:
            descriptor: descriptor of the query view.
            k: length of the list. All views are returned if the index has no more than k.
        """
        return np.arange(len(self)) if k >= len(self) else self._coarse.search(descriptor, k)

    def vectors(self, views: Int64[NDArray[np.int64], " n"]) -> Descriptors:
        """Return the exact descriptors of some views.

        Args:
            views: indices of the views.
        """
        found: Descriptors = self._index.reconstruct_batch(np.ascontiguousarray(views))
        return found
