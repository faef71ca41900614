from dataclasses import replace

import numpy as np
import pytest

from service.geometry.rigid import rotation_y, rotation_z
from service.registration.points import PointSettings
from service.registration.rays import RaySettings
from service.registration.visibility import Raycasters
from service.retrieval.prior import Prior
from service.scoring.inliers import InlierScorer
from service.scoring.measured import measure
from service.scoring.photometry import BrightnessScorer, PhotometrySettings
from service.scoring.prior import PriorScorer
from service.scoring.ray_evidence import RayScorer, RayWeights
from service.scoring.scorer import Scorer, Scores
from service.scoring.structure import StructureScorer, StructureWeights
from service.scoring.support import LocalScoreWeights, PoseScorer, SupportWeights, scorers_of
from service.scoring.verifier import Verifier

PRIOR = Prior(position_m=np.array([4.0, 0.0]), position_std_m=3.0, heading_rad=0.2)


class HeightScorer:
    """A scorer as a contributor would write it: the height of the camera, and its double as a detail."""

    name = "height"

    def score(self, poses):
        z_m = np.array([pose.camera_m[2] for pose in poses])
        return Scores(z_m, {"twice": 2 * z_m})


@pytest.fixture
def poses(candidate):
    return tuple(
        replace(candidate(xyz=(x, 0.0, z), heading_deg=heading).registered, inliers=inliers)
        for x, z, heading, inliers in ((0.0, 1.0, 0.0, 0.9), (4.0, 2.0, 90.0, 0.5), (9.0, 3.0, -10.0, 0.7))
    )


@pytest.fixture
def measured(frame_with, matches_at):
    return measure(
        (frame_with(matches_at([(0, 0, 2)], [0], [0.9])),), PointSettings(), focal_baseline_px_m=80.0, is_rig=False
    )


@pytest.fixture
def brightness(street_map, measured):
    return BrightnessScorer(Raycasters(street_map, RaySettings()), measured, PhotometrySettings())


@pytest.fixture
def structure(street_map, measured):
    return StructureScorer(street_map, measured, StructureWeights())


@pytest.fixture
def rays(street_map, measured):
    return RayScorer(
        Raycasters(street_map, RaySettings()),
        measured,
        RaySettings(),
        RayWeights(),
        PhotometrySettings(),
        Verifier.shipped(),
    )


@pytest.fixture
def scorer_of(measured, structure, brightness, rays):
    """Return the scorer of poses, for scorers and their weights."""
    return lambda *scorers: PoseScorer(
        measured, scorers, structure, brightness, rays, SupportWeights(), LocalScoreWeights()
    )


@pytest.fixture
def candidates_of(scorer_of, poses):
    """Return the candidates of three poses, for scorers and their weights."""
    return lambda *scorers: scorer_of(*scorers).candidates(poses)


def test_a_new_scorer_needs_a_line_in_the_list_and_nothing_else(candidates_of, poses):
    """Ten times 0.9, 0.5 and 0.7, plus twice 1, 2 and 3: 11, 9 and 13."""
    found = candidates_of((InlierScorer(), 10.0), (HeightScorer(), 2.0))
    assert [each.support for each in found] == pytest.approx([13.0, 11.0, 9.0])
    assert [each.registered for each in found] == [poses[2], poses[0], poses[1]]
    assert dict(found[0].scores) == pytest.approx({"inliers": 0.7, "height": 3.0, "twice": 6.0})


def test_a_scorer_of_weight_zero_is_listed_and_has_no_effect(candidates_of):
    plain = candidates_of((InlierScorer(), 10.0))
    beside = candidates_of((InlierScorer(), 10.0), (HeightScorer(), 0.0))
    assert [each.support for each in beside] == [each.support for each in plain]
    assert [each.scores["height"] for each in beside] == [1.0, 3.0, 2.0]


def test_the_prior_scores_the_position_and_heading_of_each_pose_however_it_leans(poses):
    leaning = replace(poses[0], R_map_level=rotation_z(np.deg2rad(20.0)) @ rotation_y(0.1))
    xy, heading_rad = np.array([[0.0, 0.0], [4.0, 0.0], [9.0, 0.0], [0.0, 0.0]]), np.deg2rad([0.0, 90.0, -10.0, 20.0])
    expected = PRIOR.log_weight(xy, heading_rad)
    np.testing.assert_allclose(PriorScorer(PRIOR).score((*poses, leaning)).values, expected, rtol=1e-12)


@pytest.mark.parametrize(("prior", "names"), [(None, ()), (PRIOR, ("prior",))])
def test_every_scorer_has_the_same_interface_and_a_name_of_its_own(
    bundle_at, street_map, measured, structure, brightness, rays, prior, names
):
    bundle = bundle_at([(0.0, 0.0, 1.8)], [0.0], [(1.0, 0.0)])
    weights = SupportWeights()
    listed = scorers_of(bundle, street_map, measured, prior, weights)
    assert tuple(scorer.name for scorer, _ in listed) == ("inliers", "similarity", "likelihood", *names)
    assert all(weight == getattr(weights, scorer.name) for scorer, weight in listed)
    assert all(
        isinstance(scorer, Scorer) for scorer in (structure, brightness, rays, *(scorer for scorer, _ in listed))
    )
    for each in (structure, brightness, rays):
        assert each.score(()).values.shape == (0,)


def test_only_candidates_near_the_best_get_a_structure_and_the_others_stay_behind(scorer_of, poses, monkeypatch):
    """Supports of 13, 11 and 2 nats. The first two get 1 and 6 nats of structure, and the third the lower of these."""
    asked = []

    def structure(_, poses):
        asked.extend(poses)
        nats = np.array([1.0, 6.0])
        return Scores(nats, {"shared_edges": nats / 10})

    monkeypatch.setattr(StructureScorer, "score", structure)
    monkeypatch.setattr(RayScorer, "score", lambda _, poses: Scores(np.zeros(len(poses))))
    scorer = scorer_of((InlierScorer(), 1.0))
    first, second, third = (
        replace(each, support=support)
        for each, support in zip(scorer.candidates(poses), (13.0, 11.0, 2.0), strict=True)
    )
    found = scorer.with_details([first, second, third])
    assert asked == [first.registered, second.registered]
    assert [each.support for each in found] == [17.0, 14.0, 3.0]
    assert [each.registered for each in found] == [second.registered, first.registered, third.registered]
    assert found[0].scores == {**second.scores, "structure": 6.0, "shared_edges": 0.6, "rays": 0.0}
    assert "structure" not in found[2].scores


def placed(each, *, x, support):
    """Return a candidate with another x and another support; it has a structure."""
    T = each.T_map_camera.copy()
    T[:3, 3] = (x, 0.0, 1.5)
    registered = replace(each.registered, camera_m=T[:3, 3].copy())
    return replace(
        each, T_map_camera=T, registered=registered, support=support, scores={**each.scores, "structure": 0.0}
    )


@pytest.fixture
def ray_scores(monkeypatch, scorer_of, poses):
    """Score candidates at some positions and with some supports by given ray scores; return them, the positions that
    were asked, and those that have a ray score."""

    def ranked(at, nats):
        asked = []

        def rays(_, poses):
            asked.extend(float(pose.camera_m[0]) for pose in poses)
            return Scores(np.array(nats[: len(poses)], np.float64))

        monkeypatch.setattr(StructureScorer, "score", lambda _, poses: Scores(np.zeros(len(poses))))
        monkeypatch.setattr(RayScorer, "score", rays)
        scorer = scorer_of((InlierScorer(), 1.0))
        template = scorer.candidates(poses[:1])[0]
        found = scorer.with_details([placed(template, x=x, support=support) for x, support in at])
        known = [float(each.T_map_camera[0, 3]) for each in found if "rays" in each.scores]
        return [(float(each.T_map_camera[0, 3]), each.support) for each in found], asked, known

    return ranked


def test_the_rays_compare_each_place_once_and_reorder_the_candidates(ray_scores):
    """0.5 m further is the same place. The rays prefer the third candidate: 8 + 9 nats to 10 + 3. The last one is not compared."""
    found, asked, known = ray_scores([(0.0, 10.0), (0.5, 9.0), (20.0, 8.0), (40.0, 1.0)], [3.0, 9.0])
    assert asked == [0.0, 20.0]
    assert known == [20.0, 0.0, 0.5]
    assert found == [(20.0, 17.0), (0.0, 13.0), (0.5, 12.0), (40.0, 4.0)]


def test_one_place_needs_no_rays(ray_scores):
    found, asked, known = ray_scores([(0.0, 10.0), (0.5, 9.0), (20.0, 1.0)], [])
    assert asked == known == []
    assert found == [(0.0, 10.0), (0.5, 9.0), (20.0, 1.0)]


def test_of_many_places_only_the_best_supported_are_compared_and_the_others_get_the_least(ray_scores):
    at = [(10.0 * k, 10.0 - k) for k in range(6)]
    found, asked, known = ray_scores(at, [5.0, 4.0, 3.0, 2.0])
    assert asked == known == [0.0, 10.0, 20.0, 30.0]
    assert found == [(0.0, 15.0), (10.0, 13.0), (20.0, 11.0), (30.0, 9.0), (40.0, 8.0), (50.0, 7.0)]


@pytest.mark.parametrize(
    ("name", "weights"),
    [
        ("brightness_gap", lambda: SupportWeights(brightness_gap=9.0)),
        ("rays_gap", lambda: SupportWeights(rays_gap=9.0)),
    ],
)
def test_compared_candidates_must_have_a_structure(name, weights):
    with pytest.raises(ValueError, match=rf"{name}: 9 must be at most structure_gap \(8\)"):
        weights()
