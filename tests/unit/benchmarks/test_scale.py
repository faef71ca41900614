"""Drawn maps keep what matters of real ones, and the measures of search are right."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.report import Report
from benchmarks.scale import growth, search, tiled, town
from benchmarks.scale.built import APART_M, copied
from benchmarks.scale.drawn import Asked, DrawnViews, _step
from benchmarks.scale.sources import HEADINGS, RealDescriptors
from model_training.datasets.dataset import Dataset, scan_path
from service.maps.index import vectors_of

PLACES, SIZE = 60, 32


@pytest.fixture(scope="module")
def real() -> RealDescriptors:
    """Views that change smoothly along a street of 60 places, and queries near some of them."""
    rng = np.random.default_rng(0)
    steps = rng.normal(size=(PLACES, HEADINGS, SIZE)).cumsum(axis=0) + rng.normal(size=SIZE)
    views = steps.reshape(-1, SIZE).astype(np.float32)
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    true_view = np.arange(5, len(views), 97)
    queries = views[true_view][:, None] + 0.1 * rng.normal(size=(len(true_view), 3, SIZE)).astype(np.float32)
    return RealDescriptors(
        views, (queries / np.linalg.norm(queries, axis=2, keepdims=True)).astype(np.float32), true_view
    )


def test_a_drawn_view_is_the_mean_of_its_two_real_views_about_the_mean(real: RealDescriptors) -> None:
    """View 0 mixes place 0 with a place some multiple of 8 further, at a heading some multiple of 60 degrees away."""
    drawn = DrawnViews(real, len(real.views))
    one, other = drawn._parts_of(np.array([0, HEADINGS + 1]))
    assert one.tolist() == [0, HEADINGS + 1]
    assert other[0] // HEADINGS % 8 == 0
    assert other[0] % HEADINGS % 4 == 0
    assert other[1] == other[0] + HEADINGS + 1
    mean = real.views.mean(axis=0)
    mixed = mean + np.sqrt(0.5) * (real.views[0] - mean + real.views[other[0]] - mean)
    np.testing.assert_allclose(vectors_of(drawn[:1])[0], mixed / np.linalg.norm(mixed), atol=0.02)


def test_all_copies_are_different(real: RealDescriptors) -> None:
    """Places 8, 16 and 24 further, at 6 headings: 18 copies."""
    drawn = DrawnViews(real, 18 * len(real.views))
    others = {int(drawn._parts_of(np.array([copy * len(real.views)]))[1][0]) for copy in range(18)}
    assert len(others) == 18
    with pytest.raises(ValueError, match=f"1440 real descriptors give at most {18 * 1440}"):
        DrawnViews(real, 18 * 1440 + 1)


def test_a_slice_and_numbers_read_the_same_views(real: RealDescriptors) -> None:
    drawn = DrawnViews(real, 5000)
    assert drawn.shape == (5000, SIZE)
    assert len(drawn[4900:9000]) == 100
    np.testing.assert_array_equal(drawn[1400:1500], drawn[np.arange(1400, 1500)])
    np.testing.assert_array_equal(DrawnViews(real, 2000)[1400:1500], drawn[1400:1500])


def test_mean_and_covariance_of_views_stay(real: RealDescriptors) -> None:
    drawn = vectors_of(DrawnViews(real, 10 * len(real.views))[:])
    assert np.abs(drawn.mean(axis=0) - real.views.mean(axis=0)).max() < 0.03
    kept = np.trace(np.cov(drawn.T)) / np.trace(np.cov(real.views.T))
    assert kept == pytest.approx(1, abs=0.1)


def test_a_query_finds_its_view(real: RealDescriptors) -> None:
    drawn = DrawnViews(real, 4000)
    asked = drawn.queries(40)
    assert asked.descriptors.shape == (40, 3, SIZE)
    np.testing.assert_allclose(np.linalg.norm(asked.descriptors, axis=2), 1, atol=1e-5)
    assert asked.true_view.max() < 4000
    own = np.einsum("qtd,qd->qt", asked.descriptors, vectors_of(drawn[asked.true_view])).max(axis=1)
    real_own = np.einsum("qtd,qd->qt", real.queries, real.views[real.true_view]).max(axis=1)
    assert np.median(own) == pytest.approx(np.median(real_own), abs=0.05)


@pytest.mark.parametrize("copies", [1, 2, 6, 18, 894])
def test_the_step_visits_every_copy(copies: int) -> None:
    assert len({number * _step(copies) % copies for number in range(copies)}) == copies


def test_the_tenth_best_view_is_found_over_chunks_and_turns(
    real: RealDescriptors, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(search, "_CHUNK", 100)
    drawn = DrawnViews(real, 1500)
    asked = drawn.queries(5)
    expected = np.sort((vectors_of(drawn[:]) @ asked.descriptors.transpose(0, 2, 1)).max(axis=2), axis=1)[:, -10]
    np.testing.assert_allclose(search.tenth_best(drawn, asked), expected, atol=1e-6)


def test_recall_is_the_share_of_the_ten_best_in_the_shortlist(real: RealDescriptors) -> None:
    """The first query's list misses three of its ten best views: (7 + 10) / 20."""
    drawn = DrawnViews(real, 1500)
    asked = drawn.queries(2)
    order = np.argsort(-(vectors_of(drawn[:]) @ asked.descriptors.transpose(0, 2, 1)).max(axis=2), axis=1)
    lists = iter([order[0, 3:500], order[1, :500]])
    fake = SimpleNamespace(shortlist=lambda _query, _k: next(lists))
    tenth = search.tenth_best(drawn, asked)
    assert search.recall_at_10(fake, asked, tenth, drawn.__getitem__, 500) == pytest.approx(0.85)


def test_the_time_of_a_search_is_that_of_one_query(real: RealDescriptors) -> None:
    drawn = DrawnViews(real, 1500)
    calls: list[int] = []

    def shortlist(_query: np.ndarray, k: int) -> np.ndarray:
        calls.append(k)
        return np.arange(1400, 1500)

    asked: Asked = drawn.queries(4)
    assert search.search_ms(SimpleNamespace(shortlist=shortlist), asked, drawn[:1000], 100) > 0
    assert calls == [100] * 3 * 4


def test_the_tile_size_is_that_of_the_town() -> None:
    """489,000 views in a square kilometre, so in 4 tiles of 500 m: 20,375 places in tiles of 5,094 places (rounded up), 24 views each."""
    assert search.TOWN_TILES == 4
    assert search.TILE_VIEWS == 5094 * 24
    assert -(-search.TOWN // search.TILE_VIEWS) == 4
    assert -(-search.TOWNS // search.TILE_VIEWS) == 400


def test_a_drawn_tile_has_the_views_of_its_range(real: RealDescriptors) -> None:
    """1,500 views in tiles of 480: 480 = 20 places, 480, 480 and 60, whose third place has only 12 views."""
    drawn = DrawnViews(real, 1500)
    tiles = tiled.DrawnTiles(drawn, 480)
    assert len(tiles) == 4
    assert tiles.first_view.tolist() == [0, 480, 960, 1440, 1500]
    assert tiles.first_place.tolist() == [0, 20, 40, 60, 63]
    last = tiles.get(3)
    assert (len(last.places), len(last.views)) == (3, 60)
    assert last.views["place"].tolist() == [0] * 24 + [1] * 24 + [2] * 12
    np.testing.assert_array_equal(last.view_index.rows[:], drawn[1440:])


def test_few_drawn_tiles_stay_in_memory(real: RealDescriptors, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiled, "KEPT_TILES", 2)
    tiles = tiled.DrawnTiles(DrawnViews(real, 1500), 480)
    first = tiles.get(0)
    tiles.get(1)
    assert tiles.get(0) is first
    tiles.get(2)  # forgets tile 1, the least recently used
    assert tiles.get(0) is first
    assert set(tiles._drawn) == {0, 2}


def test_a_tiled_search_without_an_index_finds_all_best_views(real: RealDescriptors) -> None:
    """Four tiles are all searched, and their shortlists have all 480 views each."""
    drawn = DrawnViews(real, 1500)
    asked = drawn.queries(4)
    found = tiled.tiled_search(drawn, None, asked, search.tenth_best(drawn, asked), 480)
    assert found.recall == 1.0
    assert found.ms > 0


def test_a_tiled_search_loses_the_best_views_of_other_tiles(real: RealDescriptors) -> None:
    """Tiles of 48 views. The index names the six tiles of the first six best views, so at most the views in them are found."""
    drawn = DrawnViews(real, 1440)
    asked = drawn.queries(3)
    similar = (vectors_of(drawn[:]) @ asked.descriptors.transpose(0, 2, 1)).max(axis=2)
    best = np.argsort(-similar, axis=1)[:, :10]
    named = [list(dict.fromkeys((views // 48).tolist()))[:6] for views in best]
    # The first query gets tiles that have none of its best views, the others get those of their best views.
    named[0] = [tile for tile in range(30) if tile not in set((best[0] // 48).tolist())][:6]
    lists = {asked.descriptors[q].mean(axis=0).tobytes(): 48 * np.array(named[q]) for q in range(3)}

    def most_similar(descriptor: np.ndarray, _k: int) -> np.ndarray:
        return lists[descriptor.tobytes()]

    fake: Any = SimpleNamespace(shortlist=lambda *_: None, most_similar=most_similar)
    found = tiled.tiled_search(drawn, fake, asked, search.tenth_best(drawn, asked), 48)
    expected = [np.isin(best[q] // 48, named[q]).sum() for q in range(3)]
    assert expected[0] == 0
    assert found.recall == pytest.approx(sum(expected) / 30)


def test_all_sizes_are_built_and_then_timed(
    real: RealDescriptors, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A town of 2,880 views is scanned and has an index. Four towns have only an index. Tiles have 1,440 views."""
    monkeypatch.setattr(search, "TOWN", 2880)
    monkeypatch.setattr(search, "TOWNS", 11_520)
    monkeypatch.setattr(search, "MOST_SCANNED", 2880)
    monkeypatch.setattr(search, "KEPT", 5000)
    monkeypatch.setattr(search, "TILE_VIEWS", 1440)
    report = Report("scale", "make bench-scale")
    monkeypatch.setattr(report, "write", lambda: None)
    search.search_rows(report, real, tmp_path, (2880, 11_520))
    found = {row["id"]: row["value"] for row in report.rows}
    assert not list(tmp_path.iterdir())
    assert found["search.views_2880.scan_recall_at_10"] > 0.9
    assert found["search.views_11520.index_recall_at_10"] == found["search.recall_at_10_at_100_times_the_town"] > 0.9
    assert found["search.views_2880.index_finds_tile"] == 1.0  # there are two tiles, so all are searched
    assert 0.9 < found["search.views_11520.index_finds_tile"] <= 1.0
    assert found["search.views_2880.tiled_recall_at_10"] > 0.9
    assert found["search.views_11520.tiled_recall_at_10"] > 0.9
    why = {row["id"]: row.get("why", "") for row in report.rows}
    assert "all 2 tiles are searched" in why["search.views_2880.tiled_ms"]
    assert "6 of 8 tiles" in why["search.views_11520.tiled_ms"]
    assert "a tile of 500 m has 1,440 views" in why["search.views_11520.index_finds_tile"]
    assert "search.views_11520.scan_ms" not in found
    towns = found["search.views_11520.index_ms"]
    assert found["search.ms_at_100_times_the_town"] == towns / found["search.views_2880.scan_ms"]
    served = found["search.views_11520.tiled_ms"] / found["search.views_2880.tiled_ms"]
    assert found["search.served_ms_at_100_times_the_town"] == served
    assert found["search.ms_at_100_times_the_indexed_town"] == towns / found["search.views_2880.index_ms"]


def test_equal_files_of_a_tiled_map_count_once(tmp_path: Path) -> None:
    """Two tiles share the encoder (100 bytes) with the map. Previews and sums of voxels do not count: 100 + 7 + 30 + 40 bytes."""
    of_map = {"encoder.onnx": ("a", 100), "places.npy": ("b", 7)}
    of_tiles = [
        {"encoder.onnx": ("a", 100), "views.npy": ("c", 30), "preview.webp": ("d", 1000)},
        {"encoder.onnx": ("a", 100), "views.npy": ("e", 40), "voxels.zst": ("f", 1000)},
    ]
    entries = [
        {name: SimpleNamespace(sha256=sha256, size=size) for name, (sha256, size) in files.items()}
        for files in (of_map, *of_tiles)
    ]
    read: Any = SimpleNamespace(files=entries[0], tiles=[SimpleNamespace(folder="0"), SimpleNamespace(folder="1")])
    by_folder = {tmp_path / str(number): SimpleNamespace(files=entries[number + 1]) for number in range(2)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(town, "read_manifest", by_folder.__getitem__)
        assert town.served_bytes(tmp_path, read) == 177


def test_without_the_town_its_ratios_are_absent(
    real: RealDescriptors, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A map of one tile has no search of a tiled map."""
    report = Report("scale", "make bench-scale")
    monkeypatch.setattr(report, "write", lambda: None)
    search.search_rows(report, real, tmp_path, (1440,))
    found = {row["id"]: row for row in report.rows}
    assert found[search.SERVED]["value"] is None
    assert found[search.SERVED]["why"] == "needs --sizes 489000 48900000"
    assert not [row for row in found if ".tiled" in row]


def test_copies_of_a_town_lie_apart_and_share_the_scans(small_dataset: Dataset, tmp_path: Path) -> None:
    one, poses = small_dataset, small_dataset.survey_poses()
    both = copied(one, tmp_path / "both", 2)
    copied_stamps, copied_poses = both.survey_trajectory()
    assert len(copied_poses) == 2 * len(poses)
    np.testing.assert_allclose(copied_poses[: len(poses)], poses, atol=1e-6)
    np.testing.assert_allclose(copied_poses[len(poses) :, :3, 3], poses[:, :3, 3] + [APART_M, 0, 0], atol=1e-6)
    assert (np.diff(copied_stamps) > 0).all()
    np.testing.assert_array_equal(both.scan(len(poses)), one.scan(0))
    assert scan_path(both.folder, 0).stat().st_ino == scan_path(one.folder, 0).stat().st_ino


def test_a_place_is_as_similar_as_its_best_view_at_the_best_turn():
    vectors = np.array([[1, 0], [0, 1], [-1, 0], [0.6, 0.8]], np.float32)  # two views of each place
    turns = np.array([[0, -1], [1, 0]], np.float32)
    np.testing.assert_allclose(growth.place_similarity(vectors, turns, 2), [1.0, 0.6])


def test_the_rank_of_the_right_place_counts_the_places_before_it():
    similarity = np.array([0.9, 0.5, 0.7, 0.5], np.float32)
    assert growth.rank_of_right(similarity, np.array([True, False, False, False])) == 0
    assert growth.rank_of_right(similarity, np.array([False, True, False, True])) == 2
    assert growth.rank_of_right(similarity, np.zeros(4, np.bool_)) == 4
