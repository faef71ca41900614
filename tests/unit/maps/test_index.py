from pathlib import Path

import faiss
import numpy as np
import pytest

from service.errors import BundleError
from service.maps.index import ViewIndex, write_index


def unit_vectors(count: int, size: int) -> np.ndarray:
    vectors = np.random.default_rng(0).normal(size=(count, size)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_the_shortlist_holds_the_most_similar_views(tmp_path: Path) -> None:
    descriptors, queries = (
        unit_vectors(2000, 32),
        unit_vectors(5, 32) * np.array([[1], [0.1], [10], [1], [1]], np.float32),
    )
    write_index(tmp_path / "i", descriptors)
    index = ViewIndex.open(tmp_path / "i")
    for query in queries:
        listed = index.shortlist(query, 100)
        assert len(np.unique(listed)) == 100
        assert set(np.argsort(-(descriptors @ query))[:40].tolist()) <= set(listed.tolist())


def test_vectors_are_those_that_were_written(tmp_path: Path) -> None:
    descriptors = unit_vectors(200, 32)
    write_index(tmp_path / "i", descriptors)
    np.testing.assert_array_equal(
        ViewIndex.open(tmp_path / "i").vectors(np.array([7, 0, 199])), descriptors[[7, 0, 199]]
    )


def test_a_list_longer_than_the_map_is_all_of_it(tmp_path: Path) -> None:
    write_index(tmp_path / "i", unit_vectors(3, 8))
    assert ViewIndex.open(tmp_path / "i").shortlist(unit_vectors(1, 8)[0], 50).tolist() == [0, 1, 2]


@pytest.mark.parametrize("descriptors", [np.zeros((3, 8), np.float32), np.zeros((0, 8), np.float32)])
def test_descriptors_of_nothing_do_no_harm(tmp_path: Path, descriptors) -> None:
    write_index(tmp_path / "i", descriptors)
    assert len(ViewIndex.open(tmp_path / "i").shortlist(np.zeros(8, np.float32), 2)) == min(2, len(descriptors))


def test_the_coarse_copy_is_made_piece_by_piece(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    descriptors = unit_vectors(200, 32)
    write_index(tmp_path / "i", descriptors)
    whole = ViewIndex.open(tmp_path / "i").shortlist(descriptors[3], 20)
    monkeypatch.setattr("service.maps.index._CHUNK", 64)
    np.testing.assert_array_equal(ViewIndex.open(tmp_path / "i").shortlist(descriptors[3], 20), whole)


def test_opening_limits_faiss_to_one_thread(tmp_path: Path) -> None:
    write_index(tmp_path / "i", unit_vectors(3, 8))
    faiss.omp_set_num_threads(2)
    ViewIndex.open(tmp_path / "i")
    assert faiss.omp_get_max_threads() == 1


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


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_descriptors_that_are_no_numbers_are_refused(tmp_path: Path, value: float) -> None:
    """Found by fuzzing."""
    descriptors = unit_vectors(20, 8)
    descriptors[17, 3] = value
    write_index(tmp_path / "i", descriptors)
    with pytest.raises(BundleError, match="not finite"):
        ViewIndex.open(tmp_path / "i")


def test_the_coarse_copy_has_no_more_numbers_than_the_descriptors_need(tmp_path: Path) -> None:
    few = (
        np.random.default_rng(3).normal(size=(300, 5))
        @ np.linalg.qr(np.random.default_rng(4).normal(size=(64, 5)))[0].T
    )
    descriptors = (few / np.linalg.norm(few, axis=1, keepdims=True)).astype(np.float32)
    write_index(tmp_path / "few", descriptors)
    write_index(tmp_path / "all", unit_vectors(300, 64))
    index = ViewIndex.open(tmp_path / "few")
    assert index.coarse_numbers == 16
    assert ViewIndex.open(tmp_path / "all").coarse_numbers == 64
    best = np.argsort(-(descriptors @ descriptors[7]))[:10]
    assert set(best) <= set(index.shortlist(descriptors[7], 20).tolist())
