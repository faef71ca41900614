import numpy as np
import pytest

from service.geometry.rigid import rotation_y, rotation_z
from service.localization import similar
from service.localization.similar import similarity_at

FAN_DEG = [0.0, 90.0, 180.0, 270.0]


@pytest.fixture(autouse=True)
def counted(monkeypatch):
    """What these tests count on."""
    monkeypatch.setattr(similar, "PLACES", 5)
    monkeypatch.setattr(similar, "VIEWS", 2)


def views_of(similarity):
    """Unit vectors that are so similar to (1, 0, 0), row by row."""
    s = np.array(similarity, np.float64).reshape(-1)
    return np.stack([s, np.sqrt(1 - s * s), np.zeros(len(s))], axis=1)


@pytest.fixture
def street(bundle_at):
    """Eight places 10 m apart along x. Place k is 0.1 k similar at 0 degrees and less at 90; 180 is alike everywhere, 270 unlike."""
    fan = np.array([[0.1 * k, 0.05 * k, 0.95, -0.5] for k in range(8)])
    return bundle_at([(10.0 * k, 0.0, 2.0 + 30 * (k % 2)) for k in range(8)], FAN_DEG, views_of(fan))


def asked(bundle, x_m, heading_deg, descriptors=((1.0, 0.0, 0.0),), *, y_m=0.0, R=None):
    return similarity_at(
        bundle, np.array(descriptors, np.float32), R_map_level=rotation_z(np.deg2rad(heading_deg)) if R is None else R,
        camera_m=np.array([x_m, y_m, 500.0]),
    )  # fmt: skip


@pytest.mark.parametrize(("x_m", "expected"), [(31, 0.3), (40, 0.4), (-100, 0.2), (70, 0.5), (34, 0.3), (36, 0.4)])
def test_the_five_nearest_places_count_whatever_their_height(street, x_m, expected):
    """Places 1 to 5 around x = 31, whose mean is that of the middle one; the first or the last five beyond the ends."""
    assert asked(street, x_m, 40) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("heading_deg", "expected"),
    [
        (0, 0.3),
        (44, 0.3),
        (-44, 0.3),
        (46, 0.3),
        (316, 0.3),
        (-50, 0.3),
        (100, 0.95),
        (134, 0.95),
        (80, 0.3),
        (-91, 0.95),
    ],
)
def test_of_each_place_the_better_of_the_two_views_that_look_most_like_the_pose_counts(street, heading_deg, expected):
    """40 degrees lie between the views of 0 and 90; 100 between those of 90 and 180; -50 between 270 and 0; -91 between 180 and 270."""
    assert asked(street, 31, heading_deg) == pytest.approx(expected, abs=1e-6)


def test_the_heading_is_that_of_the_level_frames_forward_axis_however_it_leans(street):
    leaning = rotation_z(np.deg2rad(100)) @ rotation_y(np.deg2rad(20))
    assert asked(street, 31, None, R=leaning) == pytest.approx(0.95, abs=1e-6)


def test_the_most_similar_turn_counts_for_each_view(bundle_at):
    """(1, 0, 0) and (0, 1, 0) are 0.6 and 0.8 similar to the one place, 0.8 and 0.6 to the other."""
    bundle = bundle_at([(0, 0, 2), (1, 0, 2)], [0.0], [(0.6, 0.8, 0), (0.8, 0.6, 0)])
    assert asked(bundle, 0, 0, [(1, 0, 0)]) == pytest.approx(0.7)
    assert asked(bundle, 0, 0, [(1, 0, 0), (0, 1, 0), (0, 0, 1)]) == pytest.approx(0.8)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_map_of_few_places_is_asked_as_a_whole(bundle_at, count):
    similarity = [0.2 * (k + 1) for k in range(count)]
    bundle = bundle_at([(100.0 * k, 0, 2) for k in range(count)], [0.0], views_of(similarity))
    assert asked(bundle, 0, 123) == pytest.approx(np.mean(similarity), abs=1e-6)


def test_places_count_by_their_distance_in_both_directions(bundle_at):
    """Two rows of five, 30 m apart across."""
    xyz = [(10.0 * k, y, 2) for y in (0, 30) for k in range(5)]
    bundle = bundle_at(xyz, [0.0], views_of([0.1] * 5 + [0.7] * 5))
    assert asked(bundle, 20, 0, y_m=-10) == pytest.approx(0.1, abs=1e-6)
    assert asked(bundle, 20, 0, y_m=40) == pytest.approx(0.7, abs=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_it_agrees_with_a_slow_loop(bundle_at, seed):
    rng = np.random.default_rng(seed)
    xyz, start = rng.uniform(0, 50, (20, 3)), rng.uniform(0, 60)
    fan = start + 60 * np.arange(6)
    views = rng.normal(size=(120, 8))
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    query = rng.normal(size=(3, 8))
    query /= np.linalg.norm(query, axis=1, keepdims=True)
    x, y, heading = rng.uniform(0, 50), rng.uniform(0, 50), rng.uniform(-180, 180)
    best = []
    for place in sorted(range(20), key=lambda k: np.hypot(xyz[k, 0] - x, xyz[k, 1] - y))[:5]:
        turns = [abs((degrees - heading + 180) % 360 - 180) for degrees in fan]
        nearest = sorted(range(6), key=lambda k, turns=turns: turns[k])[:2]
        best.append(max(float(views[6 * place + k] @ turned) for k in nearest for turned in query))
    found = asked(bundle_at(xyz, fan, views), x, heading, query, y_m=y)
    assert found == pytest.approx(np.mean(best), abs=1e-5)
