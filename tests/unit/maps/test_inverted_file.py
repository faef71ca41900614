import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import faiss
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from model_training.mapping.build import describe
from model_training.mapping.merge import merge_maps
from model_training.mapping.stored_map import content_of as stored_content
from service.errors import BundleError
from service.maps import inverted_file
from service.maps.content import BundleContent
from service.maps.index import ScannedCopy, read_descriptors, vectors_of, write_descriptors
from service.maps.inverted_file import FILE, RECALL, InvertedFile, lists_for, views_to_hold, write_inverted_file
from service.maps.manifest import Manifest
from service.maps.reader import MapBundle
from service.maps.writer import sha256_of, write_bundle
from service.retrieval.knn import search_views

VIEWS, SIZE, PLACES, HEADINGS = 3000, 16, 100, 4


def unit_vectors(count: int, size: int, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, size)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def street_vectors(places: int, headings: int, size: int, *, alike: float = 0.9) -> np.ndarray:
    """Unit vectors of views along a street, place by place. Those of neighbouring places have this similarity on average."""
    noise = np.random.default_rng(0).normal(size=(places, headings, size)) / np.sqrt(size)
    views = noise.copy()
    for place in range(1, places):
        views[place] = alike * views[place - 1] + np.sqrt(1 - alike**2) * noise[place]
    vectors = views.reshape(-1, size).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """The descriptors of a map, its index file and the recall measured at its build."""
    folder = tmp_path_factory.mktemp("inverted")
    write_descriptors(folder / "d.npy", street_vectors(VIEWS // HEADINGS, HEADINGS, SIZE))
    numbers = read_descriptors(folder / "d.npy")
    recall = write_inverted_file(folder / FILE, numbers, headings=HEADINGS)
    return SimpleNamespace(path=folder / FILE, numbers=numbers, recall=recall)


@pytest.fixture(scope="module")
def opened(written: SimpleNamespace) -> InvertedFile:
    return InvertedFile.open(written.path, views=VIEWS, dimension=SIZE, headings=HEADINGS)


@pytest.fixture(scope="module")
def large(content_of: Callable[..., BundleContent]) -> BundleContent:
    """A map of 400 views: 100 places with 4 headings."""
    T_map_place = np.tile(np.eye(4), (PLACES, 1, 1))
    T_map_place[:, 0, 3] = 10.0 * np.arange(PLACES)
    return content_of(
        T_map_place=T_map_place,
        place_street=np.full(PLACES, -1, np.int32),
        view_place=np.repeat(np.arange(PLACES, dtype=np.int32), 4),
        view_heading_rad=np.tile(np.arange(4) * (np.pi / 2), PLACES),
        descriptors=unit_vectors(4 * PLACES, SIZE),
        streets=None,
    )


# 8 sqrt(100) = 80 lies nearer to 64 than to 128 on a logarithmic scale; 8 sqrt(489,000) = 5594; 8 sqrt(48.9 million) = 55,943.
@pytest.mark.parametrize(
    ("views", "lists"), [(1, 8), (16, 32), (100, 64), (489_000, 4096), (1_000_000, 8192), (48_900_000, 65_536)]
)
def test_the_number_of_lists_follows_the_root_of_the_number_of_views(views: int, lists: int) -> None:
    assert lists_for(views) == lists


@pytest.mark.parametrize(
    ("recalls", "probes", "recall"),
    [
        # 512 lists for 3,000 views, so 20 listed views are in about 3.41 lists: probes 3, 5, 7, 10, 14, 19, 27, ...
        ([0.1, 0.5, 0.7, 0.9, 0.993], 14, 0.993),
        ([0.1, 0.5, 0.9, 0.9005, 0.9015], 7, 0.9),  # 14 lists gain 0.0015 over 7
        ([0.1, 0.5, 0.9, 0.9005, 0.903, 0.9925], 19, 0.9925),  # 0.003
    ],
)
def test_the_build_stops_where_more_lists_find_no_more(
    written: SimpleNamespace,
    monkeypatch: pytest.MonkeyPatch,
    recalls: list[float],
    probes: int,
    recall: float,
) -> None:
    whole: Any = faiss.read_index(str(written.path))
    lists: Any = faiss.downcast_index(whole.index)
    given_recalls = iter(recalls)
    monkeypatch.setattr(inverted_file, "_LISTED", 20)
    monkeypatch.setattr(inverted_file, "recall_of", lambda *_: next(given_recalls))
    assert inverted_file._choose_probes(whole, written.numbers, HEADINGS) == recall
    assert lists.nprobe == probes


def test_a_shortlist_holds_the_most_similar_views(written: SimpleNamespace, opened: InvertedFile) -> None:
    assert written.recall >= 0.992
    stored, found = vectors_of(written.numbers), 0
    for query in unit_vectors(50, SIZE, seed=1):
        listed = opened.shortlist(query, 1440)
        assert 720 <= len(listed) == len(np.unique(listed))
        found += len(set(np.argsort(-(stored @ query))[:10].tolist()) & set(listed.tolist()))
    assert found >= 0.98 * 500


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(k=st.integers(1, VIEWS), seed=st.integers(0, 1000))
def test_a_shortlist_has_different_views_of_the_map(opened: InvertedFile, k: int, seed: int) -> None:
    """A list longer than the lists read first makes the search read more of them."""
    listed = opened.shortlist(unit_vectors(1, SIZE, seed=seed)[0], k)
    held = -(-k // 2)
    assert held <= len(listed) <= 3 * held + 18 * -(-k // 12)
    assert (np.diff(listed) > 0).all()
    assert 0 <= listed.min() <= listed.max() < VIEWS


def test_a_longer_list_has_all_views_of_a_shorter_one(opened: InvertedFile) -> None:
    query = unit_vectors(1, SIZE, seed=5)[0]
    assert set(opened.shortlist(query, 50).tolist()) <= set(opened.shortlist(query, 400).tolist())


def descriptors_of(tmp_path: Path, vectors: np.ndarray) -> np.ndarray:
    write_descriptors(tmp_path / "d.npy", vectors.astype(np.float32))
    return read_descriptors(tmp_path / "d.npy")


@pytest.mark.parametrize("chunk", [4, 8, 12, 16_384])
def test_odd_places_are_omitted_if_a_place_beside_them_looks_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int
) -> None:
    """Places 0 to 6 with 2 headings and a last one with one view. Place 1 looks like place 0, place 3 like none, place 5 like place 6."""
    monkeypatch.setattr(inverted_file, "_CHUNK", chunk)
    x, y, z = np.eye(3)
    looks = [x, x, y, z, x, y, y]
    numbers = descriptors_of(tmp_path, np.repeat(looks, 2, axis=0)[:13])
    assert views_to_hold(numbers, 2).tolist() == [0, 1, 4, 5, 6, 7, 8, 9, 10, 11, 12]
    # With both views, place 6 looks like place 5.
    numbers = descriptors_of(tmp_path, np.repeat(looks, 2, axis=0))
    assert views_to_hold(numbers, 2).tolist() == [0, 1, 4, 5, 6, 7, 8, 9, 12, 13]


def test_a_place_looks_alike_if_half_of_its_headings_do(tmp_path: Path) -> None:
    """Of three headings, two of place 1 are like those of place 0, and one of place 3 is like that of place 2."""
    x, y = np.eye(2)
    numbers = descriptors_of(tmp_path, np.array([x, x, x, x, x, y, x, x, x, x, y, y]))
    assert views_to_hold(numbers, 3).tolist() == [0, 1, 2, 6, 7, 8, 9, 10, 11]


@pytest.mark.parametrize("views", [1, 3, 4, 5, 8, 9])
def test_a_map_of_one_or_two_places_has_held_views(tmp_path: Path, views: int) -> None:
    """All views are equal, so place 1 is omitted once it has all its views."""
    held = views_to_hold(descriptors_of(tmp_path, np.ones((views, 2)) / np.sqrt(2)), 4)
    assert held.tolist() == [view for view in range(views) if view // 4 != 1 or views < 8]


def test_the_views_around_a_view_are_those_of_the_next_places_at_the_next_headings(opened: InvertedFile) -> None:
    """View 21 has place 5 and heading 1 of 4. View 0 has place 0, so no place before it, and the heading before 0 is 3."""
    assert opened._around(np.array([21]), places=1, turns=0).tolist() == [17, 21, 25]
    assert opened._around(np.array([21]), places=1, turns=1).tolist() == [16, 17, 18, 20, 21, 22, 24, 25, 26]
    assert sorted(opened._around(np.array([0]), places=1, turns=1).tolist()) == [0, 1, 3, 4, 5, 7]
    assert sorted(opened._around(np.array([VIEWS - 1]), places=1, turns=0).tolist()) == [VIEWS - 5, VIEWS - 1]


def test_a_place_that_was_appended_to_a_map_is_found(tmp_path: Path) -> None:
    """The last place has an odd number and looks like no other. An exact query finds its view."""
    vectors = np.concatenate([street_vectors(199, 4, SIZE), unit_vectors(4, SIZE, seed=9)])
    numbers = descriptors_of(tmp_path, vectors)
    write_inverted_file(tmp_path / FILE, numbers, headings=4)
    opened = InvertedFile.open(tmp_path / FILE, views=800, dimension=SIZE, headings=4)
    for view in (796, 797, 798, 799):
        assert opened.most_similar(vectors_of(numbers[view : view + 1])[0], 5)[0] == view


def test_an_index_that_lacks_a_place_is_refused(tmp_path: Path) -> None:
    """The forged number makes a view of place 1, which may be missing, out of one of place 2, which may not."""
    numbers = descriptors_of(tmp_path, street_vectors(200, 4, SIZE, alike=0.97))
    write_inverted_file(tmp_path / FILE, numbers, headings=4)
    held = views_to_hold(numbers, 4)
    omitted = next(view for view in range(800) if view not in held)
    data, wanted = (tmp_path / FILE).read_bytes(), np.int64(8).tobytes()
    whole: Any = faiss.read_index(str(tmp_path / FILE), faiss.IO_FLAG_MMAP)  # keeps its parts alive
    inverted: Any = faiss.downcast_index(whole.index)
    mapped: Any = faiss.downcast_InvertedLists(inverted.invlists)
    for number in range(inverted.nlist):
        entry = mapped.lists.at(number)
        first = entry.offset + entry.size * inverted.code_size
        ids = np.frombuffer(data, np.int64, entry.size, first)
        if 8 in ids:
            at = first + 8 * int(np.flatnonzero(ids == 8)[0])
            assert data[at : at + 8] == wanted
            data = data[:at] + np.int64(omitted).tobytes() + data[at + 8 :]
    (tmp_path / FILE).write_bytes(data)
    with pytest.raises(BundleError, match="1 views of every second place are in no list"):
        InvertedFile.open(tmp_path / FILE, views=800, dimension=SIZE, headings=4)


def test_a_map_with_fewer_views_than_axes_has_an_index(tmp_path: Path) -> None:
    """As the map of a few tiles with a few places each: 5 places with 4 headings and 256 numbers hold 12 views."""
    numbers = descriptors_of(tmp_path, street_vectors(5, 4, 256))
    write_inverted_file(tmp_path / FILE, numbers, headings=4)
    opened = InvertedFile.open(tmp_path / FILE, views=20, dimension=256, headings=4)
    assert len(opened.shortlist(vectors_of(numbers[:1])[0], 20)) == 20


def test_a_shortlist_has_the_places_between_and_more_views_around_its_best(opened: InvertedFile) -> None:
    """For 30 views the index lists as many as its share of all views. The first 3 bring three places to each side."""
    query = unit_vectors(1, SIZE, seed=4)[0]
    listed = -(-30 * opened._lists.ntotal // VIEWS)
    best = opened.most_similar(query, listed)
    assert 15 < listed < 30
    around, more = opened._around(best, places=1, turns=0), opened._around(best[:3], places=3, turns=1)
    expected = {*around.tolist(), *more.tolist()}
    assert set(opened.shortlist(query, 30).tolist()) == expected


@pytest.mark.parametrize(("alike", "held"), [(0.95, 400), (0.6, 800)])
def test_a_survey_whose_places_differ_has_every_place_in_its_index(tmp_path: Path, alike: float, held: int) -> None:
    write_descriptors(tmp_path / "d.npy", street_vectors(200, 4, SIZE, alike=alike))
    write_inverted_file(tmp_path / FILE, read_descriptors(tmp_path / "d.npy"), headings=4)
    opened = InvertedFile.open(tmp_path / FILE, views=800, dimension=SIZE, headings=4)
    assert len(opened.most_similar(unit_vectors(1, SIZE)[0], 800)) == held


def test_a_noisy_query_resembles_its_own_view(written: SimpleNamespace) -> None:
    """The noise is 0.6 times the difference of two views, so the cosine is about 1 / sqrt(1 + 2 x 0.6^2) = 0.76."""
    queries, own = inverted_file.noisy_queries(written.numbers)
    assert len(queries) == len(own) == 128
    np.testing.assert_allclose(np.linalg.norm(queries, axis=1), 1, atol=1e-5)
    similar = np.einsum("qd,qd->q", queries, vectors_of(written.numbers[own]))
    assert np.median(similar) == pytest.approx(0.76, abs=0.05)


def test_recall_counts_the_ten_best_views_that_are_listed(opened: InvertedFile, written: SimpleNamespace) -> None:
    """One query lists 7 of its 10 best views, the other all: 17 of 20."""
    stored = vectors_of(written.numbers)
    asked = unit_vectors(2, SIZE, seed=2)
    order = np.argsort(-(asked @ stored.T), axis=1)
    lists = {0: np.concatenate([order[0, :7], order[0, 500:600]]), 1: order[1, :100]}
    given_lists = iter(lists.values())
    fake = SimpleNamespace(shortlist=lambda _query, _k: next(given_lists))
    tenth = np.sort(-(asked @ stored.T), axis=1)[:, 9] * -1
    assert inverted_file.recall_of(fake, written.numbers, asked, tenth) == pytest.approx(0.85)


def test_the_tenth_best_view_is_found_over_all_chunks(
    written: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inverted_file, "_CHUNK", 64)
    asked = unit_vectors(4, SIZE, seed=3)
    expected = np.sort(asked @ vectors_of(written.numbers).T, axis=1)[:, -10]
    np.testing.assert_allclose(inverted_file._tenth_best(written.numbers, asked), expected, atol=1e-6)


@pytest.mark.parametrize("cores", [1, 2])
def test_the_same_descriptors_give_the_same_bytes_for_any_number_of_cores(
    written: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cores: int
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    faiss.omp_set_num_threads(cores)
    write_inverted_file(tmp_path / FILE, written.numbers, headings=HEADINGS)
    assert faiss.omp_get_max_threads() == cores, "the caller's number of threads stays"
    assert (tmp_path / FILE).read_bytes() == written.path.read_bytes()


def test_a_view_takes_four_bits_per_axis_and_its_number(written: SimpleNamespace) -> None:
    """16 components have 16 axes, so a code has 8 bytes. The number of the view takes 8 more."""
    whole: Any = faiss.read_index(str(written.path))  # keeps its parts alive
    inverted: Any = faiss.downcast_index(whole.index)
    assert inverted.code_size == 8
    held = inverted.invlists.compute_ntotal()
    assert held == len(views_to_hold(written.numbers, HEADINGS))
    assert VIEWS / 2 < held < VIEWS
    assert written.path.stat().st_size > 16 * held


def test_an_odd_number_of_components_has_an_index_too(tmp_path: Path) -> None:
    write_descriptors(tmp_path / "d.npy", unit_vectors(600, 7))
    write_inverted_file(tmp_path / FILE, read_descriptors(tmp_path / "d.npy"), headings=1)
    assert (
        len(InvertedFile.open(tmp_path / FILE, views=600, dimension=7, headings=1).shortlist(unit_vectors(1, 7)[0], 20))
        >= 20
    )


@pytest.mark.parametrize("kept", [0, 3, 100, 2000, -1])
def test_a_truncated_file_is_refused(written: SimpleNamespace, tmp_path: Path, kept: int) -> None:
    (tmp_path / FILE).write_bytes(written.path.read_bytes()[:kept])
    with pytest.raises(BundleError, match=rf"{FILE}: .*; copy or build the bundle again"):
        InvertedFile.open(tmp_path / FILE, views=VIEWS, dimension=SIZE, headings=HEADINGS)


@pytest.mark.parametrize(
    ("views", "dimension", "message"),
    [
        (VIEWS // 4, SIZE, r"\d+ views in its head and \d+ in its lists for a map of 750"),
        (VIEWS, 8, "descriptors of 16 numbers instead of 8"),
    ],
)
def test_the_index_of_another_map_is_refused(
    written: SimpleNamespace, views: int, dimension: int, message: str
) -> None:
    with pytest.raises(BundleError, match=message):
        InvertedFile.open(written.path, views=views, dimension=dimension, headings=HEADINGS)


def test_another_kind_of_index_is_refused(tmp_path: Path) -> None:
    flat = faiss.IndexFlatIP(SIZE)
    flat.add(unit_vectors(10, SIZE))
    faiss.write_index(flat, str(tmp_path / FILE))
    with pytest.raises(BundleError, match="IndexFlatIP instead of principal axes with an inverted file; copy or build"):
        InvertedFile.open(tmp_path / FILE, views=10, dimension=SIZE, headings=HEADINGS)
    faiss.write_index(faiss.IndexPreTransform(faiss.PCAMatrix(SIZE, 4), faiss.IndexFlatIP(4)), str(tmp_path / FILE))
    with pytest.raises(BundleError, match="PCAMatrix and IndexFlatIP instead of PCAMatrix and IndexIVFScalarQuantizer"):
        InvertedFile.open(tmp_path / FILE, views=0, dimension=SIZE, headings=HEADINGS)


@pytest.mark.parametrize(
    ("number", "message"),
    [(VIEWS, "refers to a missing view"), (-1, "refers to a missing view"), (None, "1 views are in two lists")],
)
def test_lists_with_wrong_views_are_refused(
    written: SimpleNamespace, tmp_path: Path, number: int | None, message: str
) -> None:
    """The last eight bytes of the lists are the number of a view. ``None`` gives it the number before."""
    data = bytearray(written.path.read_bytes())
    whole: Any = faiss.read_index(str(written.path), faiss.IO_FLAG_MMAP)  # keeps its parts alive
    inverted: Any = faiss.downcast_index(whole.index)
    mapped: Any = faiss.downcast_InvertedLists(inverted.invlists)
    lists = mapped.lists
    last = next(lists.at(n) for n in reversed(range(inverted.nlist)) if lists.at(n).size > 1)
    end = last.offset + last.size * (inverted.code_size + 8)
    forged = data[end - 16 : end - 8] if number is None else np.int64(number).tobytes()
    data[end - 8 : end] = forged
    (tmp_path / FILE).write_bytes(data)
    with pytest.raises(BundleError, match=message):
        InvertedFile.open(tmp_path / FILE, views=VIEWS, dimension=SIZE, headings=HEADINGS)
    InvertedFile.open(tmp_path / FILE, views=VIEWS, dimension=SIZE, headings=HEADINGS, verify=False)


def test_a_map_below_the_size_has_no_index(
    large: BundleContent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inverted_file, "SMALLEST", 4 * PLACES + 1)
    made = write_bundle(tmp_path / "m", large)
    assert FILE not in made.files
    assert RECALL not in made.parameters
    assert isinstance(MapBundle.open(tmp_path / "m").view_index._shortlister, ScannedCopy)
    assert "recall" not in describe(made)


@pytest.fixture
def indexed(large: BundleContent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The bundle of a map that has just enough views for an index."""
    monkeypatch.setattr(inverted_file, "SMALLEST", 4 * PLACES)
    write_bundle(tmp_path / "m", large)
    return tmp_path / "m"


def test_a_map_above_the_size_is_searched_through_its_index(indexed: Path) -> None:
    bundle = MapBundle.open(indexed)
    assert FILE in bundle.manifest.files
    assert isinstance(bundle.view_index._shortlister, InvertedFile)
    assert f"search index with recall@10 of {bundle.manifest.parameters[RECALL]:.3f} against exact search" in describe(
        bundle.manifest
    )
    exact = bundle.view_index.vectors(np.arange(400))
    for view in (0, 77, 399):
        found = search_views(bundle, exact[view : view + 1], turns_rad=(0.0,), places=5, fewest=20)
        assert found.view[0] == view
        np.testing.assert_array_equal(found.view[:5], np.argsort(-(exact @ exact[view]), kind="stable")[:5])


def test_the_same_map_has_the_same_version(indexed: Path, large: BundleContent) -> None:
    again = write_bundle(indexed.parent / "again", large)
    assert again.version == MapBundle.open(indexed).manifest.version
    assert sha256_of(indexed / FILE) == sha256_of(indexed.parent / "again" / FILE)


def test_a_map_without_its_index_still_opens(indexed: Path) -> None:
    """A bundle that was built before there was an index."""
    document = json.loads((indexed / "manifest.json").read_text())
    del document["files"][FILE]
    (indexed / "manifest.json").write_bytes(Manifest.model_validate_json(json.dumps(document)).stamped().to_bytes())
    (indexed / FILE).unlink()
    assert isinstance(MapBundle.open(indexed).view_index._shortlister, ScannedCopy)


def test_a_damaged_index_is_refused_with_its_name(indexed: Path) -> None:
    data = bytearray((indexed / FILE).read_bytes())
    data[len(data) // 2] ^= 1
    (indexed / FILE).write_bytes(data)
    with pytest.raises(
        BundleError, match=rf"{FILE}: the hash does not match the manifest; copy or build the bundle again"
    ):
        MapBundle.open(indexed)


def test_a_smaller_map_forgets_the_recall_of_a_larger_one(indexed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = stored_content(MapBundle.open(indexed))
    assert RECALL in content.parameters
    monkeypatch.setattr(inverted_file, "SMALLEST", 401)
    assert RECALL not in write_bundle(indexed.parent / "small", content).parameters


def test_merging_measures_the_recall_again(indexed: Path, large: BundleContent) -> None:
    moved = large.T_map_place.copy()
    moved[:, 1, 3] += 500
    write_bundle(
        indexed.parent / "other",
        dataclasses.replace(large, T_map_place=moved, descriptors=unit_vectors(400, SIZE, seed=9)),
    )
    made = merge_maps(indexed, indexed.parent / "other", indexed.parent / "both")
    assert made.counts.views == 800
    assert 0.9 <= made.parameters[RECALL] <= 1
    bundle = MapBundle.open(indexed.parent / "both")
    assert isinstance(bundle.view_index._shortlister, InvertedFile)
    assert len(bundle.view_index.shortlist(bundle.view_index.vectors(np.arange(1))[0], 30)) >= 30
