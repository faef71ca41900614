import numpy as np
import pytest

from model_training.calibration import elsewhere
from model_training.calibration.elsewhere import OUTSIDE_M, RemainingViews, is_outside, without_surroundings
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle


@pytest.fixture(scope="module")
def localizer(bundle_path):
    """Two streets 100 m apart, six places each, 10 m apart, with four views each."""
    return Localizer.open(MapBundle.open(bundle_path))


def test_a_position_is_outside_beyond_20_m_from_every_place_even_if_it_is_off():
    places = np.array([[0.0, 0.0], [100.0, 0.0]])
    xy = np.array([[19.9, 0.0], [20.1, 0.0], [50.0, 0.0], [100.0, -25.0], [np.nan, np.nan]])
    assert OUTSIDE_M == 20.0
    assert is_outside(places, xy).tolist() == [False, True, True, True, False]
    assert is_outside(places, xy, np.array([0.0, 0.5, 1.0, 6.0, 0.0])).tolist() == [False, False, True, False, False]


def test_the_places_around_are_gone_and_the_others_stay(localizer, monkeypatch):
    monkeypatch.setattr(elsewhere, "FEWEST_LEFT", 2)
    rest = without_surroundings(localizer, np.array([20.0, 0.0]))
    assert rest is not None
    bundle = rest.bundle
    found = bundle.view_index.shortlist(bundle.view_index.vectors(np.arange(1))[0], 10_000)
    # Of the first street, 0 to 50 m, only the places at 50 m are further than 20 m away.
    assert sorted({int(place) for place in bundle.view_place[found]}) == [5, 6, 7, 8, 9, 10, 11]
    assert len(bundle.view_index) == 28
    assert len(localizer.bundle.view_index) == 48


def test_a_query_is_answered_at_another_place(localizer, pictures, monkeypatch):
    from service.retrieval.query import Query

    rgb, depth_m, camera = pictures
    query = Query(rgb=rgb, depth_m=depth_m, camera=camera)
    true_xy = localizer.localize(query).T_map_camera_guess[:2, 3]
    assert np.linalg.norm(true_xy - [20, 100]) < 1
    monkeypatch.setattr(elsewhere, "FEWEST_LEFT", 2)
    rest = without_surroundings(localizer, true_xy)
    assert rest is not None
    answer = rest.localize(query)
    assert all(np.linalg.norm(each.position_m[:2] - true_xy) > OUTSIDE_M for each in answer.neighbours)
    assert np.linalg.norm(answer.T_map_camera_guess[:2, 3] - true_xy) > 10


def test_too_few_remaining_places_are_refused(localizer):
    assert without_surroundings(localizer, np.array([20.0, 0.0])) is None  # 7 of 12 remain, 10 are needed
    assert without_surroundings(localizer, np.array([500.0, 0.0])) is not None


def test_a_shortlist_of_a_large_index_is_as_long_as_wanted():
    rng = np.random.default_rng(0)

    class Whole:
        dimension = 4
        vectors_of = rng.normal(size=(500, 4)).astype(np.float32)

        def __len__(self):
            return 500

        def shortlist(self, descriptor, k):
            return np.argsort(-(self.vectors_of @ descriptor))[:k]

        def vectors(self, views):
            return self.vectors_of[views]

    remaining = rng.random(500) < 0.7
    index = RemainingViews(Whole(), remaining)  # type: ignore[arg-type]
    descriptor = np.array([1, 0, 0, 0], np.float32)
    found = index.shortlist(descriptor, 20)
    assert remaining[found].all()
    best = np.flatnonzero(remaining)[np.argsort(-(Whole.vectors_of[remaining] @ descriptor))[:20]]
    assert set(best.tolist()) <= set(found.tolist())
    assert index.dimension == 4
    np.testing.assert_array_equal(index.vectors(np.arange(3)), Whole.vectors_of[:3])
