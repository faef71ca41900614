"""The FAISS index of view descriptors, memory-mapped, and a coarse copy of it that picks what is compared exactly."""

from pathlib import Path

import faiss
import numpy as np
from jaxtyping import Float32, Int64
from numpy.typing import NDArray

from service.errors import BundleError

FILE = "views.faiss"
_LEVELS = 127.0
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


def _eight_bits(index: faiss.Index) -> tuple[float, faiss.Index]:
    """The same vectors with whole numbers of eight bits for components: a scan of them waits a quarter as long for memory.

    And the largest component's size; where it is not finite, nothing else is.
    """
    coarse = faiss.IndexScalarQuantizer(
        index.d, faiss.ScalarQuantizer.QT_8bit_direct_signed, faiss.METRIC_INNER_PRODUCT
    )
    chunks = [range(first, min(first + _CHUNK, index.ntotal)) for first in range(0, index.ntotal, _CHUNK)]
    sizes = [float(np.abs(index.reconstruct_n(chunk.start, len(chunk))).max()) for chunk in chunks]
    largest = float(np.max(sizes, initial=0.0))
    for chunk in chunks if np.isfinite(largest) else ():
        vectors = index.reconstruct_n(chunk.start, len(chunk))
        coarse.add(np.rint(vectors * np.float32(_LEVELS / max(largest, 1e-9))))
    return largest, coarse


class ViewIndex:
    """An open index; searching it is safe from several threads."""

    def __init__(self, index: faiss.Index) -> None:
        self._index = index
        self.largest, self._coarse = _eight_bits(index)

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
        if not np.isfinite(found.largest):
            raise BundleError(f"{path}: a descriptor is not finite; copy or build the bundle again", field=FILE)
        return found

    def __len__(self) -> int:
        return int(self._index.ntotal)

    @property
    def dimension(self) -> int:
        """Length of a descriptor."""
        return int(self._index.d)

    def shortlist(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " k"]:
        """Numbers of about the k most similar views, in no order: found with descriptors of eight bits, a quarter of the memory.

        What is compared in the end is compared exactly (``vectors``); a list much longer than what is wanted loses nothing.
        """
        if k >= len(self):
            return np.arange(len(self))
        scale = np.float32(_LEVELS / max(float(np.abs(descriptor).max()), 1e-9))  # the search is among whole numbers
        found: NDArray[np.int64] = self._coarse.search(np.rint(descriptor[None] * scale), k)[1][0]
        return found

    def vectors(self, views: Int64[NDArray[np.int64], " n"]) -> Descriptors:
        """Descriptors of some views."""
        found: Descriptors = self._index.reconstruct_batch(np.ascontiguousarray(views))
        return found
