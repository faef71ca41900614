import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.confidence.features import FEATURES, TABLE, evidence_of, require_features, weighted_median
from service.confidence.shape import shape_of
from service.errors import BundleError
from service.geometry.rigid import rotation_z
from service.imaging.view_grid import ViewGrid
from service.maps.calibration import read_calibration
from service.retrieval.hypotheses import Hypothesis
from service.retrieval.knn import Neighbour
from service.retrieval.prior import Prior
from service.retrieval.retrieve import Retrieved
from service.scoring.candidates import Refined
from service.scoring.confirmation import Confirmation
from service.scoring.ray_evidence import RayEvidence

CONFIRMATION = Confirmation(upper_front=0.03, contrast=0.2, along_residual=1.7, along_edges=0.1)
RAYS = RayEvidence(static_inliers=0.92, upper_through=0.04, occlusion_edges=0.35, upper_occlusion_edges=0.45)

VERIFIED = 4.5


def refined(*candidates, covariance=None, points=1500, variance_inflation=1.0):
    own = np.eye(6) if covariance is None else covariance
    return Refined(
        candidates,
        own + np.eye(6),
        own,
        points,
        variance_inflation,
        CONFIRMATION,
        RAYS,
        VERIFIED,
        (),
        lambda _: np.eye(6),
    )


def neighbour(x, similarity=0.5, *, y=0.0, z=0.0):
    return Neighbour(0, similarity, 0.0, -1, np.array([x, y, z], np.float64), 0.0)


def hypothesis(weight, x=0.0):
    return Hypothesis(weight, np.array([x, 0.0, 0.0]), 0.0, np.array([0.0, 0.0, 1.0]), 0, -1, 0.5, 1)


@pytest.fixture(scope="module")
def frame(frame_with, matches_at):
    return frame_with(matches_at([(0, 0, 2)], [0], [0.9]))


@pytest.fixture(scope="module")
def weighed(candidate, frame):
    """Return the features by name. Defaults: one candidate, one neighbour, one hypothesis, one frame."""

    def weigh(*, candidates=None, neighbours=None, weights=(1.0,), apart_m=0.0, frames=None, places=None, **options):
        neighbours = neighbours or [neighbour(0)]
        there = np.array(places or [each.position_m[:2] for each in neighbours], np.float64)
        found = evidence_of(
            frames or (frame,),
            refined(*(candidates or [candidate()]), **options),
            Retrieved(
                tuple(neighbours), tuple(hypothesis(weight, apart_m * k) for k, weight in enumerate(weights)), None
            ),
            np.ascontiguousarray(there.T),
            ViewGrid(),
        )
        assert found.shape == (len(FEATURES),)
        return dict(zip(FEATURES, found.tolist(), strict=True))

    return weigh


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("inliers", 0.7),
        ("similarity", 0.8),
        ("likelihood", -1.5),
        ("through", 0.02 / 0.9),
        ("front", 0.2 / 0.9),
        ("unmapped", 0.1),
        ("mapped_inliers", 0.7 / 0.9),
        ("measured", 0.75),
        ("place_m", 1.5),
        ("upper_front", 0.03),
        ("contrast", 0.2),
        ("along_residual", 1.7),
        ("along_edges", 0.1),
        ("static_inliers", 0.92),
        ("upper_through", 0.04),
        ("occlusion_edges", 0.35),
        ("upper_occlusion_edges", 0.45),
        ("verified", 4.5),
    ],
)
def test_features_of_the_best_candidate_are_unchanged(candidate, weighed, name, expected):
    worse = {"similarity": 0.1, "place_m": 7.0, "likelihood": -9.0, "through": 0.9, "front": 0.9, "unmapped": 0.9}
    other = replace(candidate(-1.0, xyz=(50, 0, 1.5)), scores=worse)
    assert weighed(candidates=(candidate(), other))[name] == pytest.approx(expected)


def test_shares_of_mapped_points_stay_finite_where_the_map_shows_nothing(candidate, weighed):
    best = candidate()
    found = weighed(candidates=(replace(best, scores={**best.scores, "unmapped": 1.0, "front": 0.0}),))
    assert found["mapped_inliers"] == pytest.approx(best.registered.inliers / 0.05)
    assert found["front"] == 0.0


@pytest.mark.parametrize(("place_m", "expected"), [(0.0, 0.0), (9.9, 9.9), (10.1, 10.0), (1e4, 10.0)])
def test_distances_of_places_are_limited_to_ten_metres(candidate, weighed, place_m, expected):
    """The calibration data contain no sparser survey."""
    best = candidate()
    assert weighed(candidates=(replace(best, scores={**best.scores, "place_m": place_m}),))["place_m"] == expected


@pytest.mark.parametrize(
    ("rivals", "margin"),
    [
        ([(4.0, (10, 0, 1.5), 0)], 6.0),
        ([(4.0, (10, 0, 1.5), 0), (7.5, (0, 90, 1.5), 0)], 2.5),  # the best rival counts, wherever it comes
        ([(9.9, (1, 0, 1.5), 0), (4.0, (10, 0, 1.5), 0)], 6.0),  # the next frame of the same street is none
        ([(9.0, (0, 0, 1.5), 180)], 1.0),  # the other way round is one
        ([(9.0, (3.1, 0, 1.5), 0)], 1.0),
        ([(9.0, (2.9, 0, 1.5), 29)], 12.0),
        ([(-50.0, (10, 0, 1.5), 0)], 12.0),  # more than 12 nats say no more
        ([], 12.0),
    ],
)
def test_the_margin_is_the_support_over_the_best_rival(candidate, weighed, rivals, margin):
    others = [candidate(support, xyz=xyz, heading_deg=degrees) for support, xyz, degrees in rivals]
    assert weighed(candidates=(candidate(10.0), *others))["margin"] == pytest.approx(margin)


@pytest.mark.parametrize(
    ("supports", "share"),
    [
        ([10.0], 1.0),
        ([10.0, 10.0], 1 / 2),  # two alike
        ([10.0] * 6, 1 / 6),  # six alike, whose margin is the same
        ([10.0, 10.0 - np.log(3.0)], 3 / 4),
        ([10.0, 9.0, 9.0], 1 / (1 + 2 / np.e)),
        ([10.0, -990.0], 1.0),
    ],
)
def test_the_share_is_the_best_ones_among_all_that_exclude_each_other(candidate, weighed, supports, share):
    """Another frame of the same street does not change the share."""
    apart = [candidate(support, xyz=(20 * k, 0, 1.5)) for k, support in enumerate(supports)]
    near = [candidate(support, xyz=(20 * k + 1, 0, 1.5)) for k, support in enumerate(supports)]
    for candidates in (apart, [*apart, *near]):
        assert weighed(candidates=tuple(candidates))["log_share"] == pytest.approx(np.log(share))


def test_the_inlier_advantage_is_over_the_median_rival(candidate, weighed):
    """Another frame of the same street is no rival. Without a rival the value is that of a usual right answer."""

    def with_inliers(inliers, x):
        found = candidate(xyz=(x, 0, 1.5))
        return replace(found, registered=replace(found.registered, inliers=inliers))

    best, same = with_inliers(0.7, 0), with_inliers(0.69, 1)
    rivals = [with_inliers(inliers, 20.0 * (k + 1)) for k, inliers in enumerate((0.5, 0.4, 0.2))]
    assert weighed(candidates=(best, same, *rivals))["inlier_advantage"] == pytest.approx(0.3)
    assert weighed(candidates=(best, same, rivals[0]))["inlier_advantage"] == pytest.approx(0.2)
    assert weighed(candidates=(best, same))["inlier_advantage"] == 0.3


def test_the_similarity_margin_is_against_the_best_other_place(weighed):
    """A place 10.1 m along or across is another place, one at 9.9 m is not. Height does not count."""
    places = [
        neighbour(0, 0.95),
        neighbour(9.9, 0.9),
        neighbour(0, 0.85, z=50),
        neighbour(0, 0.6, y=-10.1),
        neighbour(90, 0.55),
    ]
    assert weighed(neighbours=places)["similarity_margin"] == pytest.approx(0.8 - 0.6)


def test_where_no_other_place_was_found_half_is_taken_for_its_similarity(weighed):
    assert weighed(neighbours=[neighbour(0, 0.95), neighbour(5, 0.9)])["similarity_margin"] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("x_m", "votes"),
    [
        ([0], 1.0),
        ([0, 4.9, 5.1, -4.9], 1.0),  # all that are there
        ([50] * 20, 0.0),
        ([0] * 5 + [50] * 15 + [0] * 20, 0.25),
        ([0] * 40, 1.0),
    ],
)
def test_votes_are_the_first_twenty_places_that_lie_around_the_answer_of_those_that_do(weighed, x_m, votes):
    assert weighed(neighbours=[neighbour(x) for x in x_m])["votes"] == votes


def test_a_sparse_survey_has_fewer_places_to_vote_but_no_smaller_a_share(weighed):
    voters = [neighbour(x) for x in (0, 50, 60, 70)]
    dense, sparse = [(float(x), 0.0) for x in range(-4, 5)], [(0.0, 0.0), (10.0, 0.0)]
    assert weighed(neighbours=voters, places=sparse)["votes"] == 1.0
    assert weighed(neighbours=voters, places=dense)["votes"] == pytest.approx(1 / 9)


@pytest.mark.parametrize(
    ("weights", "entropy"), [([1.0], 0.0), ([0.25] * 4, np.log(4)), ([0.5, 0.5], np.log(2)), ([1.0, 0.0], 0.0)]
)
def test_entropy_measures_over_how_many_clusters_the_weight_is_spread(weighed, weights, entropy):
    assert weighed(weights=weights)["entropy"] == pytest.approx(entropy, abs=1e-9)


def with_prior(frame, **prior):
    return (replace(frame, query=replace(frame.query, prior=Prior(**prior))),)


HERE, FAR = (
    {"position_m": np.zeros(2), "position_std_m": 5.0},
    {"position_m": np.array([60.0, 0.0]), "position_std_m": 5.0},
)


@pytest.mark.parametrize(
    ("prior", "similarity_margin", "entropy", "inlier_advantage"),
    [
        # Deficits of 2.773 nats at 12 m and 5.007 at 60 m, so weights of 0.0625 and 0.0067. The similarity at 60 m is 0.85 - 0.04 * 5.007.
        # The median of 0.1, 0.5 and 0.6 with weights of 0.0067, 0.0067 and 0.0625 is 0.581. The largest weight blends it with 0.3.
        (HERE, 0.8 - 0.6497, 0.0400, 0.0625 * (0.7 - 0.581) + 0.9375 * 0.3),
        ({"heading_rad": 0.0, **HERE}, 0.8 - 0.6497, 0.0400, 0.0625 * (0.7 - 0.581) + 0.9375 * 0.3),
        (FAR, 0.8 - 0.85, np.log(2), 0.7 - 0.5),  # it contradicts the answer, so it excludes nothing
        ({"heading_rad": 0.0}, 0.8 - 0.85, np.log(2), 0.7 - 0.5),  # all headings agree
    ],
)
def test_places_that_the_prior_excludes_are_hardly_rivals(
    candidate, weighed, frame, prior, similarity_margin, entropy, inlier_advantage
):
    found = weighed(
        frames=with_prior(frame, **prior),
        candidates=tuple(with_inliers(candidate, *each) for each in ((0.7, 0), (0.6, 12), (0.5, 60), (0.1, 65))),
        neighbours=[neighbour(60, 0.85), neighbour(0, 0.8), neighbour(12, 0.6)],
        weights=(0.5, 0.5),
        apart_m=60.0,
    )
    assert found["similarity_margin"] == pytest.approx(similarity_margin, abs=1e-4)
    assert found["entropy"] == pytest.approx(entropy, abs=1e-4)
    assert found["inlier_advantage"] == pytest.approx(inlier_advantage, abs=1e-3)


def with_inliers(candidate, inliers, x):
    found = candidate(xyz=(x, 0, 1.5))
    return replace(found, registered=replace(found.registered, inliers=inliers))


def test_excluded_rivals_do_not_outvote_one_that_the_prior_allows(candidate, weighed, frame):
    """A rival at 4 m has nearly as many inliers as the answer. The two at 60 and 65 m have few, and the prior excludes them."""
    candidates = tuple(with_inliers(candidate, *each) for each in ((0.7, 0), (0.69, 4), (0.2, 60), (0.2, 65)))
    frames = with_prior(frame, position_m=np.array([2.0, 0.0]), position_std_m=5.0)
    assert weighed(candidates=candidates, frames=frames)["inlier_advantage"] == pytest.approx(0.01, abs=0.01)


def test_an_excluded_neighbour_is_no_less_similar_than_no_neighbour(weighed, frame):
    """0.55 - 0.04 * 5.007 = 0.35 would be lower than the 0.5 that stands for no neighbour."""
    near = [neighbour(0, 0.8), neighbour(60, 0.55)]
    assert weighed(neighbours=near, frames=with_prior(frame, **HERE))["similarity_margin"] == pytest.approx(0.3)
    low = [neighbour(0, 0.8), neighbour(60, 0.4)]
    assert weighed(neighbours=low, frames=with_prior(frame, **HERE))["similarity_margin"] == pytest.approx(0.4)


def test_a_small_change_of_a_prior_is_a_small_change_of_the_features(candidate, weighed, frame):
    """A limit of the log weight would make a feature jump: by 0.05, 0.69 or 0.2 within 0.1 m."""
    found = [
        weighed(
            frames=with_prior(frame, position_m=np.array([x, 0.0]), position_std_m=5.0),
            candidates=tuple(with_inliers(candidate, *each) for each in ((0.7, 0), (0.6, 12), (0.5, 60), (0.1, 65))),
            neighbours=[neighbour(60, 0.85), neighbour(0, 0.8)],
            weights=(0.5, 0.5),
            apart_m=60.0,
        )
        for x in np.arange(0.0, 40.0, 0.1)
    ]
    for name, most in (("similarity_margin", 0.01), ("entropy", 0.02), ("inlier_advantage", 0.01)):
        assert np.abs(np.diff([each[name] for each in found])).max() < most, name


@given(values=st.lists(st.floats(0, 1), min_size=1, max_size=9), weight=st.floats(1e-3, 1))
def test_the_weighted_median_of_equal_weights_is_the_usual_median(values, weight):
    assert weighted_median(np.array(values), np.full(len(values), weight)) == pytest.approx(np.median(values))


def test_the_weighted_median_follows_the_weights():
    """Half of the weights is 2. The midpoints of the weights are 0.5, 2.5 (values 1 and 2): 1 + 1.5 / 2."""
    assert weighted_median(np.array([2.0, 1.0]), np.array([3.0, 1.0])) == pytest.approx(1.75)
    assert weighted_median(np.array([5.0, 1.0, 9.0]), np.array([1.0, 1e-9, 1e-9])) == pytest.approx(5.0)


def test_a_prior_heading_excludes_the_other_direction(candidate, weighed, frame):
    """The street in the opposite direction is 9 standard deviations away. Its weight is exp(-5.007) = 0.0067."""
    back = candidate(xyz=(0, 0, 1.5), heading_deg=180)
    both = (candidate(10.0), replace(back, registered=replace(back.registered, inliers=0.2)))
    assert weighed(candidates=both)["inlier_advantage"] == pytest.approx(0.5)
    frames = with_prior(frame, heading_rad=0.0)
    expected = 0.0067 * 0.5 + 0.9933 * 0.3
    assert weighed(candidates=both, frames=frames)["inlier_advantage"] == pytest.approx(expected, abs=1e-4)


def test_a_prior_that_allows_no_cluster_leaves_their_entropy(candidate, weighed, frame):
    """The answer lies at the prior, far from all clusters: the search did not find it, registration did."""
    frames = with_prior(frame, position_m=np.array([200.0, 0.0]), position_std_m=5.0)
    found = weighed(candidates=(candidate(xyz=(200, 0, 1.5)),), frames=frames, weights=(0.5, 0.5), apart_m=60.0)
    assert found["entropy"] == pytest.approx(np.log(2))


def test_sigma_is_that_of_the_worst_horizontal_direction(weighed):
    """Sigma is 0.3 m along a street at 30 degrees and 0.1 m across. The 2 m of height do not count."""
    R = rotation_z(np.deg2rad(30))
    covariance = np.eye(6)
    covariance[:3, :3] = R @ np.diag([0.09, 0.01, 4.0]) @ R.T
    assert weighed(covariance=covariance)["log_sigma"] == pytest.approx(np.log(0.3))


@pytest.mark.parametrize("scale", [1.02, 1 / 1.02])
def test_the_scale_feature_is_unsigned_and_in_percent(candidate, weighed, scale):
    assert weighed(candidates=(candidate(scale=scale),))["scale"] == pytest.approx(100 * np.log(1.02))


def test_the_noise_is_the_median_of_the_frames_and_points_are_counted_a_frame(weighed, frame):
    frames = tuple(replace(frame, noise=noise) for noise in (1e-3, 1e-4, 5e-4))
    found = weighed(frames=frames, points=4500)
    assert found["log_noise"] == pytest.approx(np.log(5e-4))
    assert found["points"] == pytest.approx(0.5)
    assert weighed(points=4500)["points"] == pytest.approx(1.5)


@pytest.mark.parametrize(("count", "expected"), [(1, 0.0), (5, np.log(5.0))])
def test_more_frames_speak_for_an_answer(weighed, frame, count, expected):
    assert weighed(frames=(frame,) * count)["frames"] == pytest.approx(expected)


def test_distances_are_from_the_best_candidate(candidate, weighed):
    there = candidate(10.0, xyz=(100, 0, 1.5))
    places = [neighbour(0, 0.9), neighbour(100, 0.7)]
    map_places = [(0.0, 0.0), (98.0, 0.0), (100.0, 0.0)]
    found = weighed(candidates=(there, candidate(1.0)), neighbours=places, places=map_places)
    assert found["votes"] == 0.5
    assert found["similarity_margin"] == pytest.approx(0.8 - 0.9)


def test_margins_of_several_frames_count_by_the_root_of_their_number(candidate, weighed, frame):
    asked = {
        "candidates": (candidate(10.0), candidate(7.0, xyz=(20, 0, 1.5))),
        "neighbours": [neighbour(0), neighbour(30)],
    }
    one, four = weighed(**asked), weighed(**asked, frames=(frame,) * 4)
    assert one["margin"] == pytest.approx(3.0)
    assert four["margin"] == pytest.approx(6.0)
    assert one["log_share"] == pytest.approx(-np.log1p(np.exp(-3)))
    assert four["log_share"] == pytest.approx(-np.log1p(np.exp(-6)))
    assert four["similarity_margin"] == pytest.approx(2 * one["similarity_margin"])


def test_the_shape_is_that_of_the_view_straight_ahead(frame, weighed):
    """The middle one of three turns counts: a wall 6 m ahead with a post. The others have no effect."""
    planes = np.zeros((3, 6, ViewGrid().rows, ViewGrid().columns), np.float32)
    planes[1, 0] = 6.0
    planes[1, 0, :, 40:44] = 3.0
    views = replace(frame.views, planes=planes, turns_rad=(-0.09, 0.0, 0.09))
    found = weighed(frames=(replace(frame, views=views),))
    assert found["far"] == pytest.approx(np.log(6.0))
    assert found["edges"] == pytest.approx(2 / 127)
    assert found["facings"] == pytest.approx(shape_of(planes[1, 0], ViewGrid()).facings)


def test_the_residual_is_the_logarithm_of_the_patches_disagreement(weighed):
    assert weighed(variance_inflation=np.e**2)["residual"] == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("x_m", "expected"),
    [
        ((0, 0, 0, 0, 0), 0.1),
        ((3,), 0.1),
        ((-5, 5), 5.1),
        ((0, 0, 0, 0, 10), 4.1),  # variance 16
        ((0, 0, 0, 0, 0, 1000), 0.1),  # the sixth does not count
    ],
)
def test_the_spread_is_that_of_the_five_most_similar_places(weighed, x_m, expected):
    found = weighed(neighbours=[neighbour(x) for x in x_m])
    assert found["pose_spread"] == pytest.approx(np.log(expected))


@pytest.mark.parametrize("features", [FEATURES[::-1], (*FEATURES[:-1], "more")])
def test_a_calibration_of_other_features_is_refused(calibration_json, features):
    document = calibration_json(features=[{"name": name, "mean": 0.0, "std": 1.0} for name in features])
    calibration = read_calibration(json.dumps(document).encode(), path="x")
    with pytest.raises(
        BundleError, match=r"^maps/town: the confidence features differ from those of this release \(margin, inliers"
    ) as error:
        require_features(calibration, "maps/town")
    assert error.value.field == "calibration.json"
    require_features(read_calibration(json.dumps(calibration_json()).encode(), path="x"), "maps/town")
    require_features(None, "maps/town")


def test_the_table_is_complete_and_its_names_are_unique():
    assert len(set(FEATURES)) == len(TABLE)
    assert all(feature.unit and feature.meaning for feature in TABLE)
    assert {feature.sign for feature in TABLE} == {-1, 0, 1}


def test_the_documents_describe_every_feature_as_the_table_does():
    text = (Path(__file__).parents[3] / "docs" / "how_it_works.md").read_text()
    signs = {1: "+", -1: "-", 0: ""}
    expected = [f"| `{each.name}` | {each.unit} | {each.meaning} | {signs[each.sign]} |" for each in TABLE]
    assert [line for line in text.splitlines() if line in expected] == expected
