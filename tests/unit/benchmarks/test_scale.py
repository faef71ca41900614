"""Drawn maps keep what matters of real ones, and the measures of search are right."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.report import Report
from benchmarks.scale import search, town
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


def test_a_tile_is_found_if_it_is_among_the_first_six_of_the_list(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiles of ten views. The first query has tile 7 as the sixth tile of its list, the second as the seventh."""
    monkeypatch.setattr(search, "TILE_VIEWS", 10)
    lists = iter([np.array([0, 1, 10, 20, 30, 31, 40, 75]), np.array([0, 10, 20, 30, 40, 50, 75])])
    fake: Any = SimpleNamespace(most_similar=lambda _descriptor, _k: next(lists))
    asked = Asked(np.ones((2, 3, SIZE), np.float32), np.array([71, 71]))
    assert search.finds_tile(fake, asked, 100).tolist() == [True, False]


def test_all_sizes_are_built_and_then_timed(
    real: RealDescriptors, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A town of 2,880 views is scanned and has an index. Four towns have only an index."""
    monkeypatch.setattr(search, "TOWN", 2880)
    monkeypatch.setattr(search, "TOWNS", 11_520)
    monkeypatch.setattr(search, "MOST_SCANNED", 2880)
    monkeypatch.setattr(search, "KEPT", 5000)
    report = Report("scale", "make bench-scale")
    monkeypatch.setattr(report, "write", lambda: None)
    search.search_rows(report, real, tmp_path, (2880, 11_520))
    found = {row["id"]: row["value"] for row in report.rows}
    assert not list(tmp_path.iterdir())
    assert found["search.views_2880.scan_recall_at_10"] > 0.9
    assert found["search.views_11520.index_recall_at_10"] == found["search.recall_at_10_at_100_times_the_town"] > 0.9
    assert found["search.views_11520.index_finds_tile"] == 1.0  # there are fewer than six tiles
    assert "search.views_11520.scan_ms" not in found
    towns = found["search.views_11520.index_ms"]
    assert found["search.ms_at_100_times_the_town"] == towns / found["search.views_2880.scan_ms"]
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
