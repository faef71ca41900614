from pathlib import Path

import faiss
import numpy as np
import pytest

from service.errors import BundleError
from service.maps.index import ScannedCopy, ViewIndex, read_descriptors, write_coarse_copy, write_descriptors


def unit_vectors(count: int, size: int) -> np.ndarray:
    vectors = np.random.default_rng(0).normal(size=(count, size)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_the_shortlist_holds_the_most_similar_views(tmp_path: Path) -> None:
    descriptors, queries = (
        unit_vectors(2000, 32),
        unit_vectors(5, 32) * np.array([[1], [0.1], [10], [1], [1]], np.float32),
    )
    write_descriptors(tmp_path / "i.npy", descriptors)
    index = ViewIndex.open(tmp_path / "i.npy")
    for query in queries:
        listed = index.shortlist(query, 100)
        assert len(np.unique(listed)) == 100
        assert set(np.argsort(-(descriptors @ query))[:40].tolist()) <= set(listed.tolist())


def test_vectors_are_unit_vectors_close_to_those_that_were_written(tmp_path: Path) -> None:
    descriptors = unit_vectors(200, 256)
    write_descriptors(tmp_path / "i.npy", descriptors)
    found = ViewIndex.open(tmp_path / "i.npy").vectors(np.array([7, 0, 199]))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)
    assert np.abs(found @ descriptors.T - descriptors[[7, 0, 199]] @ descriptors.T).max() < 3e-3
    assert found.dtype == np.float32


@pytest.mark.parametrize("size", [1, 2, 8, 256])
def test_vectors_that_were_read_are_written_as_they_were(tmp_path: Path, size: int) -> None:
    write_descriptors(tmp_path / "i.npy", unit_vectors(5000, size))
    write_descriptors(tmp_path / "j.npy", ViewIndex.open(tmp_path / "i.npy").vectors(np.arange(5000)))
    assert (tmp_path / "i.npy").read_bytes() == (tmp_path / "j.npy").read_bytes()


def test_a_descriptor_takes_a_byte_per_component(tmp_path: Path) -> None:
    write_descriptors(tmp_path / "i.npy", unit_vectors(1000, 256))
    assert (tmp_path / "i.npy").stat().st_size < 256_200


def test_a_list_longer_than_the_map_is_all_of_it(tmp_path: Path) -> None:
    write_descriptors(tmp_path / "i.npy", unit_vectors(3, 8))
    assert ViewIndex.open(tmp_path / "i.npy").shortlist(unit_vectors(1, 8)[0], 50).tolist() == [0, 1, 2]


@pytest.mark.parametrize("count", [0, 3, 1500])
def test_descriptors_of_nothing_do_no_harm(tmp_path: Path, count: int) -> None:
    write_descriptors(tmp_path / "i.npy", np.zeros((count, 8), np.float32))
    assert len(ViewIndex.open(tmp_path / "i.npy").shortlist(np.zeros(8, np.float32), 2)) == min(2, count)


def test_the_coarse_copy_is_made_piece_by_piece(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    descriptors = unit_vectors(1200, 32)
    write_descriptors(tmp_path / "i.npy", descriptors)
    whole = ViewIndex.open(tmp_path / "i.npy").shortlist(descriptors[3], 20)
    monkeypatch.setattr("service.maps.index._CHUNK", 64)
    np.testing.assert_array_equal(ViewIndex.open(tmp_path / "i.npy").shortlist(descriptors[3], 20), whole)


def test_a_few_views_are_compared_exactly(tmp_path: Path) -> None:
    descriptors = unit_vectors(999, 32)
    write_descriptors(tmp_path / "i.npy", descriptors)
    index = ViewIndex.open(tmp_path / "i.npy")
    stored = index.vectors(np.arange(999))
    listed = index.shortlist(descriptors[3], 20)
    np.testing.assert_array_equal(listed, np.argsort(-(stored @ descriptors[3]))[:20])


def test_a_part_of_the_views_determines_the_axes_of_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Descriptors of trained encoders have a common component. Most of the rest lies along a few axes."""
    rng = np.random.default_rng(3)
    descriptors = rng.normal(size=(3000, 256)) * np.geomspace(1, 1e-6, 256) + rng.normal(size=256)
    descriptors = (descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)).astype(np.float32)
    write_descriptors(tmp_path / "i.npy", descriptors)
    monkeypatch.setattr("service.maps.index._SAMPLE", 500)
    index = ViewIndex.open(tmp_path / "i.npy")
    for query in descriptors[:5]:
        best = np.argsort(-(descriptors @ query))[:20]
        assert set(best.tolist()) <= set(index.shortlist(query, 120).tolist())


def test_opening_limits_faiss_to_one_thread(tmp_path: Path) -> None:
    write_descriptors(tmp_path / "i.npy", unit_vectors(3, 8))
    faiss.omp_set_num_threads(2)
    ViewIndex.open(tmp_path / "i.npy")
    assert faiss.omp_get_max_threads() == 1


def test_a_file_that_is_no_array_is_refused(tmp_path: Path) -> None:
    (tmp_path / "i.npy").write_bytes(b"not an array at all")
    with pytest.raises(BundleError, match="not a valid NPY array"):
        ViewIndex.open(tmp_path / "i.npy")


@pytest.mark.parametrize(
    "numbers",
    [
        np.zeros((4, 8), np.float32),
        np.zeros((4, 8), np.uint8),
        np.zeros(8, np.int8),
        np.zeros((4, 8, 1), np.int8),
        np.zeros((4, 0), np.int8),
        np.asfortranarray(np.zeros((4, 8), np.int8)),
    ],
)
def test_another_kind_of_array_is_refused(tmp_path: Path, numbers: np.ndarray) -> None:
    np.save(tmp_path / "i.npy", numbers)
    with pytest.raises(BundleError, match=r"instead of int8 with a row per view; copy or build the bundle again"):
        ViewIndex.open(tmp_path / "i.npy")


@pytest.fixture
def coarse(tmp_path: Path) -> Path:
    write_descriptors(tmp_path / "i.npy", unit_vectors(1500, 32))
    write_coarse_copy(tmp_path / "coarse.faiss", read_descriptors(tmp_path / "i.npy"))
    return tmp_path / "coarse.faiss"


def test_a_coarse_copy_from_a_file_lists_the_same_views_as_one_in_memory(coarse: Path) -> None:
    made, read = (
        ScannedCopy.of(read_descriptors(coarse.parent / "i.npy")),
        ScannedCopy.open(coarse, views=1500, dimension=32),
    )
    for query in unit_vectors(5, 32):
        np.testing.assert_array_equal(read.shortlist(query, 50), made.shortlist(query, 50))


def test_the_same_descriptors_give_the_same_coarse_copy(coarse: Path, tmp_path: Path) -> None:
    write_coarse_copy(tmp_path / "again.faiss", read_descriptors(tmp_path / "i.npy"))
    assert (tmp_path / "again.faiss").read_bytes() == coarse.read_bytes()


@pytest.mark.parametrize(("views", "dimension"), [(1499, 32), (1500, 31)])
def test_a_coarse_copy_of_another_map_is_refused(coarse: Path, views: int, dimension: int) -> None:
    with pytest.raises(BundleError, match=f"1500 views of 32 numbers instead of {views} of {dimension}"):
        ScannedCopy.open(coarse, views=views, dimension=dimension)


def test_another_faiss_index_is_no_coarse_copy(tmp_path: Path) -> None:
    flat = faiss.IndexFlatIP(8)
    faiss.write_index(flat, str(tmp_path / "flat.faiss"))
    with pytest.raises(BundleError, match="IndexFlatIP instead of principal axes with codes"):
        ScannedCopy.open(tmp_path / "flat.faiss", views=0, dimension=8)
    other = faiss.IndexPreTransform(faiss.PCAMatrix(8, 4), faiss.IndexFlatIP(4))
    faiss.write_index(other, str(tmp_path / "other.faiss"))
    with pytest.raises(BundleError, match=r"PCAMatrix and IndexFlat(IP)? instead of"):
        ScannedCopy.open(tmp_path / "other.faiss", views=0, dimension=8)


@pytest.mark.parametrize("kept", [0, 4, 100, -1])
def test_a_coarse_copy_that_was_cut_off_is_refused(coarse: Path, kept: int) -> None:
    coarse.write_bytes(coarse.read_bytes()[:kept])
    with pytest.raises(BundleError, match=r"coarse.faiss: .*copy or build the bundle again"):
        ScannedCopy.open(coarse, views=1500, dimension=32)


def test_a_coarse_copy_takes_little_more_than_its_codes(tmp_path: Path) -> None:
    """64 bytes for each view, and 64 axes of 256 numbers. FAISS would also write all 256 axes, with 256 kB."""
    write_descriptors(tmp_path / "i.npy", unit_vectors(1500, 256))
    write_coarse_copy(tmp_path / "coarse.faiss", read_descriptors(tmp_path / "i.npy"))
    assert (tmp_path / "coarse.faiss").stat().st_size < 1500 * 64 + 4 * 64 * 256 + 4000
