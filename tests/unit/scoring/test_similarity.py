import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.rigid import rotation_y, rotation_z
from service.scoring import similarity as similar
from service.scoring.similarity import similarities_at

#: Largest error of these similarities: a component of a stored descriptor takes a byte.
BYTE = 3e-3
FAN_DEG = [0.0, 90.0, 180.0, 270.0]


@pytest.fixture(autouse=True)
def counted(monkeypatch):
    """Constants that these tests assume: a kernel so wide that all places have equal weight, unless a test changes it."""
    monkeypatch.setattr(similar, "PLACES", 5)
    monkeypatch.setattr(similar, "VIEWS", 2)
    monkeypatch.setattr(similar, "WIDTH_M", 1e9)


@pytest.fixture
def width(monkeypatch):
    """Set the width of the distance kernel."""
    return lambda width_m: monkeypatch.setattr(similar, "WIDTH_M", width_m)


def views_of(similarity):
    """Return unit vectors with given similarities to (1, 0, 0), row by row."""
    s = np.array(similarity, np.float64).reshape(-1)
    return np.stack([s, np.sqrt(1 - s * s), np.zeros(len(s))], axis=1)


@pytest.fixture
def street(bundle_at):
    """Return eight places 10 m apart along x. Place k has similarity 0.1 k at 0 degrees, less at 90, equal ones at 180 and 270."""
    fan = np.array([[0.1 * k, 0.05 * k, 0.95, -0.5] for k in range(8)])
    return bundle_at([(10.0 * k, 0.0, 2.0 + 30 * (k % 2)) for k in range(8)], FAN_DEG, views_of(fan))


def asked(bundle, *given, **named):
    """Return the similarity alone."""
    return found_at(bundle, *given, **named)[0]


def found_at(bundle, x_m, heading_deg, descriptors=((1.0, 0.0, 0.0),), *, y_m=0.0, R=None):
    R = rotation_z(np.deg2rad(heading_deg)) if R is None else R
    similarity, place_m = similarities_at(
        bundle, np.array(descriptors, np.float32), R_map_level=R[None], camera_m=np.array([[x_m, y_m, 500.0]])
    )
    return float(similarity[0]), float(place_m[0])


@pytest.mark.parametrize(("x_m", "expected"), [(31, 0.3), (40, 0.4), (-100, 0.2), (70, 0.5), (34, 0.3), (36, 0.4)])
def test_the_five_nearest_places_count_whatever_their_height(street, x_m, expected):
    """Places 1 to 5 around x = 31 have the mean of the middle one. Beyond the ends the first or last five count."""
    assert asked(street, x_m, 40) == pytest.approx(expected, abs=BYTE)


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
    """40 degrees lie between the views 0 and 90, 100 between 90 and 180, -50 between 270 and 0, -91 between 180 and 270."""
    assert asked(street, 31, heading_deg) == pytest.approx(expected, abs=BYTE)


def test_the_heading_is_that_of_the_level_frames_forward_axis_however_it_leans(street):
    leaning = rotation_z(np.deg2rad(100)) @ rotation_y(np.deg2rad(20))
    assert asked(street, 31, None, R=leaning) == pytest.approx(0.95, abs=BYTE)


def test_the_most_similar_turn_counts_for_each_view(bundle_at):
    """(1, 0, 0) and (0, 1, 0) have similarities 0.6 and 0.8 with one place, 0.8 and 0.6 with the other."""
    bundle = bundle_at([(0, 0, 2), (1, 0, 2)], [0.0], [(0.6, 0.8, 0), (0.8, 0.6, 0)])
    assert asked(bundle, 0, 0, [(1, 0, 0)]) == pytest.approx(0.7, abs=BYTE)
    assert asked(bundle, 0, 0, [(1, 0, 0), (0, 1, 0), (0, 0, 1)]) == pytest.approx(0.8, abs=BYTE)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_small_map_is_searched_completely(bundle_at, count):
    similarity = [0.2 * (k + 1) for k in range(count)]
    bundle = bundle_at([(100.0 * k, 0, 2) for k in range(count)], [0.0], views_of(similarity))
    assert asked(bundle, 0, 123) == pytest.approx(np.mean(similarity), abs=BYTE)


def test_places_count_by_their_distance_in_both_directions(bundle_at):
    """Two rows of five places, 30 m apart across."""
    xyz = [(10.0 * k, y, 2) for y in (0, 30) for k in range(5)]
    bundle = bundle_at(xyz, [0.0], views_of([0.1] * 5 + [0.7] * 5))
    assert asked(bundle, 20, 0, y_m=-10) == pytest.approx(0.1, abs=BYTE)
    assert asked(bundle, 20, 0, y_m=40) == pytest.approx(0.7, abs=BYTE)


@pytest.mark.parametrize("seed", range(5))
def test_it_agrees_with_a_slow_loop(bundle_at, width, seed):
    width(8.0)
    rng = np.random.default_rng(seed)
    xyz, start = rng.uniform(0, 50, (20, 3)), rng.uniform(0, 60)
    fan = start + 60 * np.arange(6)
    views = rng.normal(size=(120, 8))
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    query = rng.normal(size=(3, 8))
    query /= np.linalg.norm(query, axis=1, keepdims=True)
    x, y, heading = rng.uniform(0, 50), rng.uniform(0, 50), rng.uniform(-180, 180)
    best, away = [], []
    for place in sorted(range(20), key=lambda k: np.hypot(xyz[k, 0] - x, xyz[k, 1] - y))[:5]:
        away.append(np.hypot(xyz[place, 0] - x, xyz[place, 1] - y))
        turns = [abs((degrees - heading + 180) % 360 - 180) for degrees in fan]
        nearest = np.argsort(turns, kind="stable")[:2]
        best.append(max(float(views[6 * place + k] @ turned) for k in nearest for turned in query))
    weights = [np.exp(-(d**2) / (2 * 8.0**2)) for d in away]
    similarity, place_m = found_at(bundle_at(xyz, fan, views), x, heading, query, y_m=y)
    assert similarity == pytest.approx(np.average(best, weights=weights), abs=BYTE)
    assert place_m == pytest.approx(np.average(away, weights=weights), abs=BYTE)
    assert max(weights) < 0.9 * sum(weights)  # or the nearest alone would do


def test_a_narrow_curve_leaves_the_nearest_place_alone(street, width):
    """10 m further is 50 kernel widths further."""
    width(0.2)
    cases = [(31, 0.3, 1.0), (34, 0.3, 4.0), (36, 0.4, 4.0), (-100, 0.0, 100.0), (75, 0.7, 5.0)]
    for x_m, similarity, place_m in cases:
        assert found_at(street, x_m, 40) == pytest.approx((similarity, place_m), abs=BYTE)


def test_with_a_wide_kernel_all_places_have_equal_weight(street):
    """Places 1 to 5 around x = 31: 21, 11, 1, 9 and 19 m away."""
    assert found_at(street, 31, 40) == pytest.approx((0.3, 61 / 5), abs=BYTE)


@pytest.mark.parametrize(
    ("x_m", "away", "exponents"),
    [
        (1.0, (1.0, 3.0), (0.0, -1.0)),  # the squares differ by 8, which is 2 x 2^2
        (-2.0, (2.0, 6.0), (0.0, -4.0)),
        (5.5, (5.5, 1.5), (-3.5, 0.0)),
        (2.0, (2.0, 2.0), (0.0, 0.0)),
        (10.0, (10.0, 6.0), (-8.0, 0.0)),
    ],
)
def test_similarity_and_distance_by_hand(bundle_at, width, x_m, away, exponents):
    """Places at 0 and 4 m with similarities 0.2 and 0.8, and a kernel of 2 m."""
    width(2.0)
    bundle = bundle_at([(0, 0, 2), (4, 0, 2)], [0.0], views_of([0.2, 0.8]))
    one, other = np.exp(exponents) / np.exp(exponents).sum()
    expected = (0.2 * one + 0.8 * other, away[0] * one + away[1] * other)
    assert found_at(bundle, x_m, 0) == pytest.approx(expected, abs=BYTE)


@pytest.mark.parametrize("far_m", [10.0, 40.0, 1e3, 1e5])
def test_in_a_sparse_survey_the_nearest_place_counts_whatever_its_distance(bundle_at, width, far_m):
    """With a kernel about the pose, even the weight of the nearest place would underflow to 0."""
    width(2.0)
    bundle = bundle_at([(0, 0, 2), (0, 300, 2), (0, -300, 2)], [0.0], views_of([0.6, 0.9, 0.1]))
    assert found_at(bundle, far_m, 0, y_m=-1e-3) == pytest.approx((0.6, far_m), abs=BYTE)


def test_a_survey_twice_as_dense_says_the_same(bundle_at, width, monkeypatch):
    """Every place occurs twice. Denser places do not get more weight, only nearer ones."""
    width(2.0)
    xyz, similarity = [(2.0 * k, 0, 2) for k in range(5)], [0.1, 0.5, 0.7, 0.2, 0.4]
    once = found_at(bundle_at(xyz, [0.0], views_of(similarity)), 3.1, 0)
    monkeypatch.setattr(similar, "PLACES", 10)
    twice = found_at(bundle_at(xyz * 2, [0.0], views_of(similarity * 2)), 3.1, 0)
    assert twice == pytest.approx(once, abs=BYTE)


@pytest.fixture(scope="module")
def row(bundle_at):
    """Return eight places 1 m apart. The similarity of each is its number in tenths."""
    return bundle_at([(float(k), 0, 2) for k in range(8)], [0.0], views_of([0.1 * k for k in range(8)]))


@given(st.floats(-20, 30), st.floats(-20, 20), st.floats(0.3, 50), st.floats(1.05, 5))
def test_the_wider_the_curve_the_more_the_further_places_count(row, x_m, y_m, width_m, wider):
    """It is between that of the nearest place and the mean of all five. The distance determines the weights."""
    away = np.sort(np.hypot(np.arange(8) - x_m, y_m))[:5]
    with pytest.MonkeyPatch.context() as patch:
        distances = []
        for each in (width_m, wider * width_m):
            patch.setattr(similar, "WIDTH_M", each)
            similarity, place_m = found_at(row, x_m, 0, y_m=y_m)
            assert -BYTE <= similarity <= 0.7 + BYTE
            distances.append(place_m)
    assert away[0] - 1e-6 <= distances[0] <= distances[1] + 1e-6
    assert distances[1] <= away.mean() + 1e-6


def test_several_poses_give_the_results_of_single_poses(street):
    poses = [(31.0, 40.0), (-100.0, 0.0), (36.0, 100.0), (34.0, 270.0)]
    similarity, place_m = similarities_at(
        street,
        np.array([[1.0, 0.0, 0.0]], np.float32),
        R_map_level=np.stack([rotation_z(np.deg2rad(heading)) for _, heading in poses]),
        camera_m=np.array([[x, 0.0, 500.0] for x, _ in poses]),
    )
    expected = [found_at(street, x, heading) for x, heading in poses]
    np.testing.assert_allclose(np.stack([similarity, place_m], axis=1), expected, atol=BYTE)
    assert len({round(each, 3) for each, _ in expected}) > 1
