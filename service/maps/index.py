"""The FAISS index of view descriptors: exact inner products, memory-mapped."""

from pathlib import Path

import faiss
import numpy as np
from jaxtyping import Float32, Int64
from numpy.typing import NDArray

from service.errors import BundleError

FILE = "views.faiss"
#: Batches over about this many queries x dimensions go through BLAS. FAISS 1.15's own 128,000 makes 24 queries four
#: to five times slower; 20, the default of old, slows single queries down (measured, November 2026).
_BLAS_THRESHOLD = 2000

Descriptors = Float32[NDArray[np.float32], "n D"]


def search_with_one_thread() -> None:
    """Size FAISS for a service: whole requests run side by side, each search on one thread.

    OpenMP keeps the number for each calling thread, so every worker calls this once.
    """
    faiss.omp_set_num_threads(1)
    faiss.cvar.distance_compute_blas_threshold = _BLAS_THRESHOLD


def write_index(path: Path, descriptors: Descriptors) -> None:
    """Write unit descriptors as a flat index of inner products."""
    index = faiss.IndexFlatIP(descriptors.shape[1])
    index.add(np.ascontiguousarray(descriptors))
    faiss.write_index(index, str(path))


class ViewIndex:
    """An open index; searching it is safe from several threads."""

    def __init__(self, index: faiss.Index) -> None:
        self._index = index

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
        return cls(index)

    def __len__(self) -> int:
        return int(self._index.ntotal)

    @property
    def dimension(self) -> int:
        """Length of a descriptor."""
        return int(self._index.d)

    def search(
        self, descriptors: Descriptors, k: int
    ) -> tuple[Float32[NDArray[np.float32], "n k"], Int64[NDArray[np.int64], "n k"]]:
        """Similarities (cosines) and numbers of the k most similar views of each query, the best first."""
        similarities, views = self._index.search(np.ascontiguousarray(descriptors), min(k, len(self)))
        return similarities, views

    def vectors(self, views: Int64[NDArray[np.int64], " n"]) -> Descriptors:
        """Descriptors of some views."""
        found: Descriptors = self._index.reconstruct_batch(np.ascontiguousarray(views))
        return found
