import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.doubt import Strangers, _false_rows, average_precision, confidence_and_right, curve, nonsense
from benchmarks.report import Report


@pytest.mark.parametrize(
    ("confidence", "right", "negative", "expected"),
    [
        ([0.9, 0.7], [1, 1], [0.8, 0.1], (1 + 2 / 3) / 2),
        ([0.9, 0.8], [1, 1], [0.7, 0.1], 1.0),
        ([0.2, 0.1], [1, 1], [0.9, 0.8], (1 / 3 + 2 / 4) / 2),
        ([0.9, 0.5, 0.3], [1, 1, 1], [0.6, 0.4], (1 + 2 / 3 + 3 / 5) / 3),
        ([0.9, 0.99, 0.7], [1, 0, 1], [0.8, 0.1], (1 + 2 / 3) / 2),  # what is wrong inside the map is another matter
        ([0.4], [1], [], 1.0),
    ],
)
def test_average_precision_by_hand(confidence, right, negative, expected):
    found = average_precision(np.array(confidence), np.array(right, bool), np.array(negative, np.float64))
    assert found == pytest.approx(expected)


scores = st.lists(st.floats(0, 1), min_size=1, max_size=30, unique=True)


@given(scores, st.randoms(use_true_random=False))
def test_average_precision_is_one_only_where_every_true_answer_is_surer_than_every_false_one(confidence, chance):
    right = np.array([chance.random() < 0.5 for _ in confidence])
    scored = np.array(confidence)
    if not right.any():
        return
    found = average_precision(scored[right], np.ones(int(right.sum()), bool), scored[~right])
    parted = not (~right).any() or scored[right].min() > scored[~right].max()
    assert (found > 1 - 1e-12) == parted
    assert 0 < found <= 1 + 1e-12


def test_no_answer_is_no_confidence_and_not_right(predictions_of):
    T_true = np.tile(np.eye(4), (4, 1, 1))
    T_answer = T_true.copy()
    T_answer[:, 0, 3], T_answer[:, 2, 3] = [0.6, 0.7, 0.0, np.nan], 9.0
    T_answer[:, 1, 3] = [0.79, 0.8, 0.0, np.nan]
    confidence, right = confidence_and_right(
        predictions_of(T_true, T_answer, confidence=np.array([0.9, 0.8, np.nan, np.nan]))
    )
    assert right.tolist() == [True, False, True, False]
    assert confidence.tolist() == [0.9, 0.8, 0.0, 0.0]


def test_false_accepts_are_counted_where_ninety_five_in_a_hundred_true_ones_are_accepted():
    """Right answers at 0.00 to 1.00 give the level 0.05. Two of four out-of-map queries reach it, and the service accepted one."""
    report = Report("none", "none")
    confidence, right = np.arange(102) / 100, np.ones(102, bool)
    right[101], confidence[101] = False, 0.01
    outside = Strangers(np.array([0.01, 0.049, 0.05, 0.9]), np.array([False, False, False, True]))
    _false_rows(report, "x", outside, confidence, right, 0.5)
    first, default, second = report.rows
    assert (default["id"], default["value"]) == ("x.accepted_by_default", 0.25)
    assert (first["id"], first["value"], first["n"], first["holds"]) == ("x.false_accepts_at_95", 0.5, 4, True)
    assert second["id"] == "x.average_precision"
    assert 0.9 < second["value"] < 1


@pytest.fixture(scope="module")
def pictures():
    return nonsense(np.random.default_rng(6), "precise", count=2)


def test_nonsense_comes_in_five_kinds_as_often_as_asked_for(pictures):
    assert {kind: len(queries) for kind, queries in pictures.items()} == dict.fromkeys(
        ("indoor", "blank_wall", "covered_lens", "sky", "noise"), 2
    )
    for queries in pictures.values():
        for query in queries:
            assert (query.rgb.shape, query.rgb.dtype) == ((480, 640, 3), np.uint8)
            assert (query.depth_m.shape, query.depth_m.dtype) == ((480, 640), np.float32)
            assert np.isfinite(query.depth_m).all()
            assert query.depth_m.min() >= 0
            assert query.depth_m.any()


@pytest.mark.parametrize(
    ("kind", "share", "nearest_m", "furthest_m"),
    [
        ("indoor", (0.9, 1.0), 0.3, 20.0),
        ("blank_wall", (0.9, 1.0), 0.5, 60.0),
        ("covered_lens", (0.08, 0.12), 0.15, 0.7),
        ("sky", (0.01, 0.03), 4.5, 70.0),
        ("noise", (0.8, 1.0), 0.9, 50.0),
    ],
)
def test_each_kind_has_as_much_depth_as_it_would(pictures, kind, share, nearest_m, furthest_m):
    for query in pictures[kind]:
        measured = query.depth_m[query.depth_m > 0]
        assert share[0] <= measured.size / query.depth_m.size <= share[1]
        assert np.percentile(measured, 1) > nearest_m
        assert np.percentile(measured, 99) < furthest_m


def test_the_same_seed_invents_the_same(pictures):
    again = nonsense(np.random.default_rng(6), "precise", count=2)
    np.testing.assert_array_equal(again["indoor"][1].depth_m, pictures["indoor"][1].depth_m)
    assert np.abs(pictures["indoor"][0].depth_m - pictures["indoor"][1].depth_m).max() > 0.1


def test_a_room_is_as_high_as_rooms_are(pictures):
    """Except for depth noise, the floor is 1.5 m below the camera and the ceiling at most 2 m above it."""
    for query in pictures["indoor"]:
        rays = query.camera.rays_of_pixels()
        points = rays * query.depth_m[..., None]
        assert np.percentile(points[..., 1], 99) == pytest.approx(1.5, abs=0.05)  # down
        assert np.percentile(points[..., 1], 1) > -2.05


def test_a_stereo_rig_invents_depth_where_there_is_none_and_errs_more(pictures):
    stereo = nonsense(np.random.default_rng(6), "stereo", count=8)
    shares = [(query.depth_m > 0).mean() for query in stereo["sky"]]
    assert max(shares) > 0.1 > min(shares)  # in some of the pictures

    def roughness(queries):
        return np.median([np.abs(np.diff(query.depth_m[240, query.depth_m[240] > 0])).mean() for query in queries])

    assert roughness(stereo["blank_wall"]) > 2 * roughness(pictures["blank_wall"])


def test_the_curve_gives_the_accepted_right_share_for_each_share_of_out_of_map_queries():
    confidence, right = np.array([0.9, 0.8, 0.7, 0.6]), np.array([True, True, False, True])
    points = dict(curve(confidence, right, np.array([0.85, 0.1, 0.65, 0.2])))
    assert points[0.0] == 0.25  # surer than every stranger is 0.9 alone
    assert points[0.2] == 0.25  # a fifth of four strangers is none
    assert points[0.5] == 0.75  # two of them let 0.6 pass, and 0.7, which is wrong
    assert points[1.0] == 0.75
