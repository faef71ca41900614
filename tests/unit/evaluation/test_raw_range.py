from dataclasses import replace

import numpy as np
import pytest

from model_training.evaluation import raw_range
from model_training.evaluation.raw_range import COMPARED, GAP_PENALTY, SETTINGS, raw_best_views, similarities
from model_training.mapping.settings import BuildSettings
from model_training.mapping.survey import view_ranges
from service.maps.reader import MapBundle


def views(seed, count=5, shape=(4, 6)):
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(1, 35, (count, *shape)).astype(np.float32)
    return ranges * (rng.random(ranges.shape) > 0.3)


def slow_similarity(setting, query, view):
    """Compute one pair, cell by cell."""
    a, b = query.reshape(-1).astype(float), view.reshape(-1).astype(float)
    both, cells = [(x, y) for x, y in zip(a, b, strict=True) if x > 0 and y > 0], len(a)
    if setting.startswith("masked"):
        squares = [np.log(x / y) ** 2 for x, y in both]
        distance = 1e3 if len(both) < 0.1 * cells else sum(squares) / len(both)
        gaps = sum((x > 0) != (y > 0) for x, y in zip(a, b, strict=True)) / cells
        return -(distance + (GAP_PENALTY * gaps if setting.endswith("gaps") else 0.0))
    logs = []
    for values in (a, b):
        log = np.array([np.log(x / 10) if x > 0 else 0.0 for x in values])
        if setting.endswith("centred"):
            log = np.where(values > 0, log - log.sum() / max(1, (values > 0).sum()), 0.0)
        logs.append(log)
    return logs[0] @ logs[1] / (np.linalg.norm(logs[0]) * np.linalg.norm(logs[1]))


@pytest.mark.parametrize("setting", COMPARED)
def test_similarities_are_those_of_a_slow_loop(setting):
    queries, stored = views(0), views(1, 7)
    found = similarities(queries, stored)[setting]
    expected = [[slow_similarity(setting, q, v) for v in stored] for q in queries]
    np.testing.assert_allclose(found, expected, atol=1e-3)


@pytest.mark.parametrize("setting", COMPARED)
def test_a_view_is_most_similar_to_itself(setting):
    stored = views(2, 20)
    assert similarities(stored, stored)[setting].argmax(axis=1).tolist() == list(range(20))


def test_views_that_share_too_few_cells_are_not_compared():
    one, other = np.zeros((1, 4, 6), np.float32), np.zeros((1, 4, 6), np.float32)
    one[0, :2], other[0, 2:] = 5.0, 5.0
    assert similarities(one, other)["masked_l2"][0, 0] == -1e3


def test_every_nth_query_is_sent_on_request(best, small_map, small_dataset):
    found = raw_best_views(MapBundle.open(small_map), small_dataset, ["drive1_precise"], every=2)
    for setting, numbers in found.items():
        np.testing.assert_array_equal(numbers, best[setting][::2])


@pytest.fixture(scope="module")
def best(small_map, small_dataset):
    return raw_best_views(MapBundle.open(small_map), small_dataset, ["drive1_precise"])


def test_every_query_gets_a_place_of_the_map_by_every_setting(best, small_map):
    places = MapBundle.open(small_map).manifest.counts.places
    assert set(best) == set(SETTINGS)
    for numbers in best.values():
        assert len(numbers) == 5
        assert ((numbers >= 0) & (numbers < places)).all()


def test_the_best_place_is_that_of_the_most_similar_view_of_all(best, small_map, small_dataset, monkeypatch):
    """Compare with all views in one part, and with the smallest parts."""
    bundle = MapBundle.open(small_map)
    settings = BuildSettings(
        name="small", spacing_m=5.0, headings=6, expected_lidar_height_m=bundle.manifest.lidar_height_m
    )
    stored = np.concatenate(list(view_ranges(small_dataset, settings, bundle.grid, bundle.rows_seen)))
    queries, _ = raw_range._query_ranges(bundle, small_dataset, ["drive1_precise"], 1)
    monkeypatch.setattr(raw_range, "CHUNK", 1)
    piece_by_piece = raw_best_views(bundle, small_dataset, ["drive1_precise"])
    turns = queries.shape[1]
    for setting, each_turn in similarities(queries.reshape(-1, *queries.shape[2:]), stored).items():
        similarity = each_turn.reshape(len(queries), turns, -1)
        for name, compared in ((setting, similarity.max(axis=1)), (f"{setting}_straight", similarity[:, turns // 2])):
            expected = compared.argmax(axis=1) // 6
            np.testing.assert_array_equal(best[name], expected)
            np.testing.assert_array_equal(piece_by_piece[name], expected)


def test_a_map_with_places_between_scans_has_the_same_answers(best, small_map, small_dataset):
    """The views of a map are compared to the end, although further places follow those at scans."""
    bundle = MapBundle.open(small_map)
    counts = bundle.manifest.counts.model_copy(update={"places": bundle.manifest.counts.places + 10})
    longer = replace(bundle, manifest=bundle.manifest.model_copy(update={"counts": counts}))
    for setting, numbers in raw_best_views(longer, small_dataset, ["drive1_precise"]).items():
        np.testing.assert_array_equal(numbers, best[setting])
