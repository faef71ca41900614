"""The memory-mapped descriptors of the views, and the search for similar ones.

A descriptor is stored as 8-bit numbers (decision 0155). A search makes a shortlist and compares it exactly. A coarse copy of all
descriptors makes the shortlist. FAISS makes this copy: principal axes and 8-bit numbers. Decision 0144 compares it with code of our own.
A large map has an index file instead of the copy (``inverted_file``).
"""

from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import faiss
import numpy as np
from jaxtyping import Float32, Int8, Int64
from numpy.typing import NDArray

from service.errors import BundleError
from service.imaging.npy_header import NPY_HEADER_ERRORS

FILE = "descriptors.npy"
#: Coarse copy of the descriptors.
COARSE_FILE = "coarse.faiss"
#: Largest error of the length of a unit vector.
LENGTH_OFF = 1e-3
#: Largest 8-bit number.
_MOST = 127
#: Number of principal axes of the coarse copy. With fewer, the list loses similar views (decision 0144).
_AXES = 64
#: Smallest number of views for a coarse copy. A scan of fewer exact descriptors takes no longer.
FEWEST = 1000
#: Largest number of views that determine the principal axes.
_SAMPLE = 16_384
#: Views that are copied at once.
_CHUNK = 16_384

#: FAISS without its type stubs, which lack many of the classes and fields that this file uses.
_faiss: Any = faiss

Descriptors = Float32[NDArray[np.float32], "n D"]


def search_with_one_thread() -> None:
    """Make FAISS search with one thread, because the service runs whole requests in parallel.

    OpenMP stores the number of threads per calling thread. So every worker thread calls this function once.
    """
    faiss.omp_set_num_threads(1)


def write_descriptors(path: Path, descriptors: Descriptors) -> None:
    """Write descriptors as 8-bit numbers.

    The largest component of a vector becomes 127 or -127, and its length is forgotten. A vector that was read and is written again
    keeps its numbers, so a merged or updated map has the same descriptors.

    Args:
        path: the new file.
        descriptors: unit vectors, a row per view.
    """
    numbers = np.empty(descriptors.shape, np.int8)
    for first in range(0, len(descriptors), _CHUNK):
        some = descriptors[first : first + _CHUNK]
        largest = np.abs(some).max(axis=1, keepdims=True, initial=1e-30)
        numbers[first : first + _CHUNK] = np.rint(some * (_MOST / largest))
    np.save(path, numbers, allow_pickle=False)


def read_descriptors(path: Path) -> Int8[NDArray[np.int8], "n D"]:
    """Map a file of descriptors into memory.

    Args:
        path: file that ``write_descriptors`` wrote.

    Raises:
        BundleError: the file is not an array of 8-bit numbers with a row per view.
    """
    try:
        numbers: NDArray[np.int8] = np.load(path, allow_pickle=False, mmap_mode="r")
    except (OSError, *NPY_HEADER_ERRORS) as error:
        raise BundleError(
            f"{path}: not a valid NPY array ({error}); copy or build the bundle again", field=FILE
        ) from error
    if numbers.dtype != np.int8 or numbers.ndim != 2 or not numbers.shape[1] or not numbers.flags["C_CONTIGUOUS"]:
        raise BundleError(
            f"{path}: {numbers.dtype} of shape {numbers.shape} instead of int8 with a row per view; copy or build the "
            "bundle again",
            field=FILE,
        )
    return numbers


def vectors_of(numbers: Int8[NDArray[np.int8], "n D"]) -> Descriptors:
    """Return the unit vectors of some 8-bit descriptors; a descriptor of zeros stays zero.

    Args:
        numbers: 8-bit descriptors, a row per view.
    """
    vectors = numbers.astype(np.float32)
    vectors /= np.maximum(np.sqrt(np.einsum("nd,nd->n", vectors, vectors)), 1)[:, None]
    return vectors


@runtime_checkable
class Rows(Protocol):
    """The 8-bit descriptors of all views, a row per view: an array, or something that computes the rows that are read."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of views, and number of components."""

    def __len__(self) -> int:
        """Return the number of views."""

    def __getitem__(self, views: Any, /) -> NDArray[np.int8]:
        """Return the rows of some views.

        Args:
            views: a slice, or the numbers of the views.
        """


@runtime_checkable
class Shortlister(Protocol):
    """Finds views that may be similar to a query, much faster than an exact comparison with all of them."""

    def shortlist(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " k"]:
        """Return the indices of about the k most similar views, in no particular order, perhaps with neighbours.

        Args:
            descriptor: descriptor of the query view.
            k: length of the list, at most the number of views.
        """


class ScannedCopy:
    """Coarse copy of all descriptors: 8-bit components along the principal axes. A search scans all of it.

    The copy is small, so a scan of it hardly waits for memory. The copy of fewer than ``FEWEST`` views is exact. A bundle of more views has
    the copy as a file, so a map opens at once, and the workers of a service share its memory.

    Args:
        copy: the coarse or exact copy.
        mean: mean that the copy subtracts from the views.
    """

    def __init__(self, copy: faiss.Index, mean: Float32[NDArray[np.float32], " D"]) -> None:
        self._copy, self._mean = copy, mean

    @classmethod
    def of(cls, numbers: Rows) -> "ScannedCopy":
        """Make the copy in memory.

        Args:
            numbers: 8-bit descriptors, a row per view.
        """
        size = numbers.shape[1]
        if len(numbers) < FEWEST:
            exact: faiss.Index = faiss.IndexFlatIP(size)
            exact.add(vectors_of(numbers[:]))
            return cls(exact, np.zeros(size, np.float32))
        axes = faiss.PCAMatrix(size, min(_AXES, size))
        codes = faiss.IndexScalarQuantizer(
            axes.d_out, faiss.ScalarQuantizer.QT_8bit_uniform, faiss.METRIC_INNER_PRODUCT
        )
        copy = faiss.IndexPreTransform(axes, codes)
        copy.train(vectors_of(numbers[:: -(-len(numbers) // _SAMPLE)]))
        for first in range(0, len(numbers), _CHUNK):
            copy.add(vectors_of(numbers[first : first + _CHUNK]))
        axes.PCAMat.resize(0)  # all axes, which only training needs
        return cls(copy, _mean_of(axes))

    def write(self, path: Path) -> None:
        """Write a coarse copy.

        Args:
            path: the new file.
        """
        _faiss.write_index(self._copy, str(path))

    @classmethod
    def open(cls, path: Path, *, views: int, dimension: int) -> "ScannedCopy":
        """Map a coarse copy into memory.

        Args:
            path: file that ``write`` wrote.
            views: number of views of the map.
            dimension: number of components of a descriptor.

        Raises:
            BundleError: the file is damaged, or belongs to another map.
        """
        search_with_one_thread()
        try:
            copy = _faiss.read_index(str(path), _faiss.IO_FLAG_MMAP_IFC | _faiss.IO_FLAG_READ_ONLY)
        except RuntimeError as error:
            reason = str(error).splitlines()[0].rpartition("Error: ")[2]
            raise _defect(path, f"not a valid FAISS index ({reason})") from error
        if not isinstance(copy, _faiss.IndexPreTransform) or copy.chain.size() != 1:
            raise _defect(path, f"{type(copy).__name__} instead of principal axes with codes")
        axes, codes = _faiss.downcast_VectorTransform(copy.chain.at(0)), _faiss.downcast_index(copy.index)
        if not isinstance(axes, _faiss.PCAMatrix) or not isinstance(codes, _faiss.IndexScalarQuantizer):
            raise _defect(
                path, f"{type(axes).__name__} and {type(codes).__name__} instead of PCAMatrix and IndexScalarQuantizer"
            )
        if copy.ntotal != views or copy.d != dimension or codes.ntotal != views or codes.d != axes.d_out:
            raise _defect(path, f"{copy.ntotal} views of {copy.d} numbers instead of {views} of {dimension}")
        if codes.codes.size() != views * codes.code_size:
            raise _defect(path, "the number of codes differs from the number of views")
        return cls(copy, _mean_of(axes))

    def shortlist(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " k"]:
        """Return the indices of approximately the k most similar views, in no particular order.

        Args:
            descriptor: descriptor of the query view.
            k: length of the list, at most the number of views.
        """
        # The copy subtracts the mean from views and queries. Only views may lose it: then a similarity differs from the exact
        # one by the same constant for all views.
        found: NDArray[np.int64] = self._copy.search((descriptor + self._mean)[None], k)[1][0]
        return found


def write_coarse_copy(path: Path, numbers: Rows) -> None:
    """Make the coarse copy of a map and write it. The same descriptors give the same bytes on processors of one kind.

    Args:
        path: the new file.
        numbers: 8-bit descriptors, a row per view, ``FEWEST`` or more.
    """
    before = faiss.omp_get_max_threads()
    faiss.omp_set_num_threads(1)
    try:
        ScannedCopy.of(numbers).write(path)
    finally:
        faiss.omp_set_num_threads(before)


def _mean_of(axes: faiss.PCAMatrix) -> Float32[NDArray[np.float32], " D"]:
    return np.array(faiss.vector_to_array(axes.mean), np.float32)


class ViewIndex:
    """Open descriptors of views. Several threads may search them at the same time.

    Args:
        numbers: 8-bit descriptors, a row per view.
        shortlister: makes the shortlists; None makes a coarse copy for them.
    """

    def __init__(self, numbers: Rows, shortlister: Shortlister | None = None) -> None:
        self._numbers = numbers
        self._shortlister = shortlister or ScannedCopy.of(numbers)

    @classmethod
    def open(cls, path: Path, *, shortlister: Shortlister | None = None) -> "ViewIndex":
        """Map the descriptors into memory and make the coarse copy, unless something else makes the shortlists.

        FAISS is set to one search thread for the calling thread.

        Args:
            path: file that ``write_descriptors`` wrote.
            shortlister: makes the shortlists; None makes a coarse copy for them.

        Raises:
            BundleError: the file is not an array of 8-bit numbers with a row per view.
        """
        search_with_one_thread()
        return cls(read_descriptors(path), shortlister)

    def __len__(self) -> int:
        return len(self._numbers)

    @property
    def rows(self) -> Rows:
        """The 8-bit descriptors, a row per view."""
        return self._numbers

    @property
    def dimension(self) -> int:
        """Number of components of a descriptor."""
        return int(self._numbers.shape[1])

    def shortlist(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " k"]:
        """Return the indices of about the k most similar views, in no particular order, perhaps with neighbours.

        The caller then compares the listed views exactly with ``vectors``. The list must be several times longer than the number of
        wanted views (decision 0046).

        Args:
            descriptor: descriptor of the query view.
            k: length of the list. All views are returned if the index has no more than k.
        """
        return np.arange(len(self)) if k >= len(self) else self._shortlister.shortlist(descriptor, k)

    def vectors(self, views: Int64[NDArray[np.int64], " n"]) -> Descriptors:
        """Return the descriptors of some views, unit vectors.

        Args:
            views: indices of the views.
        """
        return vectors_of(self._numbers[views])


def _defect(path: Path, what: str) -> BundleError:
    return BundleError(f"{path}: {what}; copy or build the bundle again", field=path.name)
