"""The FAISS index of view descriptors, memory-mapped, and a coarse, short copy of it that picks what is compared exactly."""

from pathlib import Path

import faiss
import numpy as np
from jaxtyping import Float32, Float64, Int64
from numpy.typing import NDArray

from service.errors import BundleError

FILE = "views.faiss"
_LEVELS = 127.0
_HELD = 0.999  # of the second moment
_CHUNK = 16_384  # views copied at once

Descriptors = Float32[NDArray[np.float32], "n D"]


def search_with_one_thread() -> None:
    """Size FAISS for a service: whole requests run side by side, each search on one thread.

    OpenMP keeps the number for each calling thread, so every worker calls this once.
    """
    faiss.omp_set_num_threads(1)


def write_index(path: Path, descriptors: Descriptors) -> None:
    """Write unit descriptors as a flat index of inner products."""
    index = faiss.IndexFlatIP(descriptors.shape[1])
    index.add(np.ascontiguousarray(descriptors))
    faiss.write_index(index, str(path))


class _Coarse:
    """The same vectors along their principal axes, in whole numbers of eight bits: a scan of them hardly waits for memory.

    Descriptors need fewer axes than they have numbers: the stock encoder's 256 lie within 64 but for a ten-thousandth.

    Args:
        index: of the vectors.
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
        """Numbers of a vector here."""
        return int(self._axes.shape[1])

    def search(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " k"]:
        """Numbers of about the k most similar."""
        along = descriptor @ self._axes
        levels = np.float32(_LEVELS / max(float(np.abs(along).max()), 1e-9))  # the search is among whole numbers
        if self._numbers is None:
            return np.zeros(0, np.int64)
        found: NDArray[np.int64] = self._numbers.search(np.rint(along * levels)[None], k)[1][0]
        return found


def _principal_axes(moment: Float64[NDArray[np.float64], "D D"]) -> Float32[NDArray[np.float32], "D d"]:
    """As many as hold nearly all of the second moment, in sixteens, since a scan takes as many numbers at a time."""
    values, axes = np.linalg.eigh(moment)
    held = np.cumsum(values[::-1]) / max(float(values.sum()), 1e-9)
    count = min(len(values), 16 * (int(np.searchsorted(held, _HELD)) // 16 + 1))
    return np.ascontiguousarray(axes[:, ::-1][:, :count], np.float32)


class ViewIndex:
    """An open index; searching it is safe from several threads."""

    def __init__(self, index: faiss.Index) -> None:
        self._index = index
        self._coarse = _Coarse(index)
        self.is_finite = self._coarse.is_finite

    @classmethod
    def open(cls, path: Path) -> "ViewIndex":
        """Map an index file into memory.

        Raises:
            BundleError: the file is not a flat index of inner products.
        """
        search_with_one_thread()
        try:
            index = faiss.read_index(str(path), faiss.IO_FLAG_MMAP_IFC)
        except RuntimeError as error:
            raise BundleError(f"{path}: this is no FAISS index; copy or build the bundle again", field=FILE) from error
        # A downcast index borrows from the one that was read and must not outlive it.
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
        """Length of a descriptor."""
        return int(self._index.d)

    @property
    def coarse_numbers(self) -> int:
        """Of each view, in the copy that lists are taken from."""
        return self._coarse.count

    def shortlist(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " k"]:
        """Numbers of about the k most similar views, in no order: found with few numbers of eight bits.

        What is compared in the end is compared exactly (``vectors``); a list much longer than what is wanted loses nothing.
        """
        return np.arange(len(self)) if k >= len(self) else self._coarse.search(descriptor, k)

    def vectors(self, views: Int64[NDArray[np.int64], " n"]) -> Descriptors:
        """Descriptors of some views."""
        found: Descriptors = self._index.reconstruct_batch(np.ascontiguousarray(views))
        return found
