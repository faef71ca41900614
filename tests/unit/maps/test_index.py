from pathlib import Path

import faiss
import numpy as np
import pytest

from service.errors import BundleError
from service.maps.index import ViewIndex, write_index


def unit_vectors(count: int, size: int) -> np.ndarray:
    vectors = np.random.default_rng(0).normal(size=(count, size)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_search_agrees_with_a_full_sort(tmp_path: Path) -> None:
    descriptors, queries = unit_vectors(200, 32), unit_vectors(5, 32)
    write_index(tmp_path / "i", descriptors)
    similarities, views = ViewIndex.open(tmp_path / "i").search(queries, 7)
    products = queries @ descriptors.T
    expected = np.argsort(-products, axis=1)[:, :7]
    np.testing.assert_array_equal(views, expected)
    np.testing.assert_allclose(similarities, np.take_along_axis(products, expected, axis=1), atol=1e-6)


def test_more_neighbours_than_views_gives_all_views(tmp_path: Path) -> None:
    write_index(tmp_path / "i", unit_vectors(3, 8))
    _, views = ViewIndex.open(tmp_path / "i").search(unit_vectors(1, 8), 50)
    assert sorted(views[0].tolist()) == [0, 1, 2]


def test_opening_limits_faiss_to_one_thread(tmp_path: Path) -> None:
    write_index(tmp_path / "i", unit_vectors(3, 8))
    faiss.omp_set_num_threads(2)
    ViewIndex.open(tmp_path / "i")
    assert (faiss.omp_get_max_threads(), faiss.cvar.distance_compute_blas_threshold) == (1, 2000)


def test_a_file_that_is_no_index_is_refused(tmp_path: Path) -> None:
    (tmp_path / "i").write_bytes(b"not an index at all")
    with pytest.raises(BundleError, match="no FAISS index"):
        ViewIndex.open(tmp_path / "i")


def test_another_kind_of_index_is_refused(tmp_path: Path) -> None:
    faiss.write_index(faiss.IndexHNSWFlat(8, 4), str(tmp_path / "i"))
    with pytest.raises(BundleError, match="IndexHNSWFlat"):
        ViewIndex.open(tmp_path / "i")


def test_another_metric_is_refused(tmp_path: Path) -> None:
    faiss.write_index(faiss.IndexFlatL2(8), str(tmp_path / "i"))
    with pytest.raises(BundleError, match="inner products"):
        ViewIndex.open(tmp_path / "i")
