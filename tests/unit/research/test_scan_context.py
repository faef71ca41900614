import numpy as np
import pytest

from research.baselines.scan_context import (
    ContextSettings,
    context_of,
    context_of_depth,
    context_of_panorama,
    locate,
    similarities,
)

SMALL = ContextSettings(rings=4, sectors=4, reach_m=40.0, floor_m=0.0)
#: Two points in the first ring ahead to the left, one behind in the third, one too far, one below the ground.
POINTS = np.array([[3.0, 4, 1.0], [4, 3, 2.0], [-20, -15, 5.0], [40, 1, 9.0], [3, -3, -1.0]])


def slow_similarity(query, place):
    """Compute sector by sector and shift by shift."""
    filled = [j for j in range(query.shape[1]) if query[:, j].any()]
    best = -np.inf
    for shift in range(query.shape[1]):
        cosines = []
        for j in filled:
            q, p = query[:, j].astype(float), place[:, (j - shift) % query.shape[1]].astype(float)
            lengths = np.linalg.norm(q) * np.linalg.norm(p)
            cosines.append(q @ p / lengths if lengths else 0.0)
        best = max(best, np.mean(cosines))
    return best


@pytest.mark.parametrize(("value", "first"), [("highest", 2.0), ("mean", 1.5)])
def test_bins_hold_the_height_of_what_stands_in_them(value, first):
    settings = ContextSettings(rings=4, sectors=4, reach_m=40.0, floor_m=0.0, value=value)
    expected = np.zeros((4, 4), np.float32)
    expected[0, 0], expected[2, 2] = first, 5.0
    np.testing.assert_allclose(context_of(POINTS, settings), expected)


def test_a_turned_sensor_shifts_the_sectors():
    turned = np.column_stack([-POINTS[:, 1], POINTS[:, 0], POINTS[:, 2]])  # by 90 degrees
    np.testing.assert_allclose(context_of(turned, SMALL), np.roll(context_of(POINTS, SMALL), 1, axis=1))


def test_similarities_are_those_of_a_slow_loop():
    rng = np.random.default_rng(0)
    queries, places = (rng.uniform(0, 5, (n, 5, 6)).astype(np.float32) for n in (3, 4))
    queries[:, :, 2:], places[1, :, 4] = 0, 0
    expected = [[slow_similarity(q, p) for p in places] for q in queries]
    np.testing.assert_allclose(similarities(queries, places), expected, atol=1e-5)


def test_a_part_of_a_place_is_as_like_it_as_the_whole_at_any_heading():
    place = np.random.default_rng(1).uniform(0, 5, (1, 8, 12)).astype(np.float32)
    part = np.roll(place, 5, axis=2)
    part[:, :, 3:] = 0
    np.testing.assert_allclose(similarities(part, place), [[1.0]], atol=1e-5)


def test_a_query_that_saw_nothing_is_like_nothing():
    empty, place = np.zeros((1, 4, 4), np.float32), np.ones((1, 4, 4), np.float32)
    assert similarities(empty, place)[0, 0] == -np.inf


def test_a_panorama_shows_the_wall_where_it_stands(street_frames):
    ranges = np.zeros_like(street_frames(1).panoramas[0])
    ranges[15, 644:764] = 25.0  # from 45 to 90 degrees to the left and not up to the sector's edge, nearly level
    settings = ContextSettings(rings=4, sectors=8)
    found = context_of_panorama(ranges, 1.8, settings)
    assert np.argwhere(found).tolist() == [[2, 1]]
    assert found.max() == pytest.approx(1.8 + 25 * np.sin(np.deg2rad(15 - 30 * 15 / 31)), abs=1e-3)


def test_a_depth_picture_fills_the_sectors_that_it_sees(street_pairs):
    pair = street_pairs([2], [0.0])
    settings = ContextSettings(rings=20, sectors=8)
    found = context_of_depth(pair.depth_mm[0].astype(np.float32) / 1000, pair.camera, settings)
    assert found.any(axis=0).tolist() == [True] + 6 * [False] + [True]


def test_a_camera_finds_its_place_at_any_heading(street_frames, street_pairs):
    frames, test = street_frames(20), street_pairs([3, 11, 17], [0.0, 100.0, 215.0])
    reports = []
    found = locate(frames, test, report=lambda *each: reports.append(each))
    np.testing.assert_allclose(found.xy, test.views[:, :2])
    assert reports[-1] == ("Scan Context", 23, 23)


def test_a_camera_that_measures_nothing_gets_no_answer(street_frames, street_pairs):
    test = street_pairs([3], [0.0])
    test.depth_mm[:] = 0
    found = locate(street_frames(6), test)
    assert np.isnan(found.xy).all()
    assert found.street.tolist() == [-1]
