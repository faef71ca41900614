import pickle
from dataclasses import replace

import numpy as np
import pytest

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, heading_of_camera, inverse, rotation_y, rotation_z, transform_from
from service.localization import refine as refining
from service.localization.refine import RefineSettings, refine, settings_for_rig
from service.registration.covariance import (
    OF_POINTS,
    OF_RAYS,
    covariance_of,
    relative_pose_covariance,
    score_outer_product,
)
from service.registration.local_search import LocalPose
from service.registration.points import PointSettings, inverse_depth_noise
from service.registration.rays import RaySettings, adjust
from service.registration.register import RegistrationSettings
from service.registration.restarts import difference, spread_of_restarts
from service.registration.visibility import SurfelRaycaster
from service.retrieval.prior import Prior
from service.retrieval.starts import StartSettings
from service.scoring import ray_evidence as along_rays
from service.scoring import similarity as similar
from service.scoring.measured import measure
from service.scoring.photometry import BrightnessScorer
from service.scoring.ray_evidence import RayWeights
from service.scoring.scorer import Scores
from service.scoring.similarity import similarity_of
from service.scoring.structure import StructureWeights
from service.scoring.support import LocalScoreWeights, SupportWeights
from service.scoring.verifier import Verifier

CAMERA = PinholeCamera(80, 60, 50.0, 50.0, 39.5, 29.5)
R_LEVEL_CAMERA = rotation_y(np.deg2rad(4.0)) @ R_BODY_OPTICAL
HEADING_DEG = 5.0
TRUE = transform_from(rotation_z(np.deg2rad(HEADING_DEG)) @ R_LEVEL_CAMERA, np.array([0.8, 0.5, 1.5]))
EVERY_VIEW = StartSettings(less_similar=3.0)  # no two cosines are so far apart
#: Largest error of a similarity: a map stores descriptors in bytes. Those of these tests have two components.
BYTE = 4e-3
BY_INLIERS = RegistrationSettings(similarity_weight=0.0)  # so that candidates of both streets come to the end


@pytest.fixture(scope="module")
def cloud(scene_of, streets_at):
    """Return the street, and a copy 40 m beside it without lorry and pillar."""
    return scene_of(*streets_at(-6.0, 0.0), *streets_at(-6.0, 40.0)[:4]).survey()


def taken(street, T_map_camera, *, seed=8):
    """Return the street's depth with noise."""
    inverse_depth = 1 / np.maximum(street.depth(CAMERA, T_map_camera), 1e-3)
    noise = np.random.default_rng(seed).normal(0, 1e-4, inverse_depth.shape)
    return (1 / (inverse_depth + noise)).astype(np.float32)


@pytest.fixture(scope="module")
def depth(street):
    """Return the depth at the true street."""
    return taken(street, TRUE)


@pytest.fixture(scope="module")
def bundle_like(bundle_at):
    """Return five places in the street beside and five in the true one. All views have equal similarity to (1, 0)."""

    def bundle(beside, true):
        xyz = [(x, y, 1.8) for y in (40.0, 0.0) for x in range(5)]
        views = [(s, np.sqrt(1 - s * s)) for s in (beside, true) for _ in range(5)]
        return bundle_at(xyz, [0.0], views)

    return bundle


@pytest.fixture(scope="module")
def bundle(bundle_like):
    return bundle_like(0.9, 0.4)


@pytest.fixture
def both(matches_at):
    """Return a bundle with similar views in the true street and the street beside it."""
    return matches_at([(0, 40, 1.8), (0, 0, 1.8)], [0, 0], [0.9, 0.4])


@pytest.fixture
def here(matches_at):
    return matches_at([(0, 0, 1.8)], [0], [0.9])


@pytest.fixture
def seen_in(frame_with):
    """Return a frame from a depth image."""

    def frame(depth_m, matches, *, R_level_camera=R_LEVEL_CAMERA, T_reference_camera=None):
        noise = inverse_depth_noise(depth_m).total if depth_m.any() else 1e-4
        return frame_with(
            matches,
            depth_m=depth_m,
            camera=CAMERA,
            R_level_camera=R_level_camera,
            height_m=1.5,
            noise=noise,
            T_reference_camera=T_reference_camera,
        )

    return frame


def always_refined(bundle, cloud, frames, prior, settings):
    """Refine, and require at least one candidate."""
    found = refine(bundle, cloud, frames, prior, settings, Verifier.shipped())
    assert found is not None
    return found


NO_DETAILS = {
    "structure": StructureWeights(shared_edges=0.0, upper_inliers=0.0, contrast=0.0),
    "rays": RayWeights(static_inliers=0.0, occlusion_edges=0.0, verified=0.0),
}


def refined(bundle, cloud, *frames, prior=None, **weights):
    support = SupportWeights(**{**NO_DETAILS, **weights}) if weights else SupportWeights()
    settings = RefineSettings(starts=EVERY_VIEW, support=support, registration=BY_INLIERS)
    return refine(bundle, cloud, frames, prior, settings, Verifier.shipped())


ONLY_INLIERS = {"inliers": 1.0, "similarity": 0.0, "likelihood": 0.0}


def test_a_picture_is_found_where_it_was_taken(bundle, cloud, depth, here, seen_in):
    found = refined(bundle, cloud, seen_in(depth, here))
    assert found is not None
    T = found.best.T_map_camera
    np.testing.assert_allclose(T[:3, 3], TRUE[:3, 3], atol=0.05)
    assert np.rad2deg(heading_of_camera(T)) == pytest.approx(HEADING_DEG, abs=0.2)
    np.testing.assert_allclose(T[:3, :3], TRUE[:3, :3], atol=0.005)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


def test_every_candidates_pose_is_its_cameras_and_the_covariance_the_firsts(bundle, cloud, depth, both, seen_in):
    found = refined(bundle, cloud, seen_in(depth, both))
    assert found.best is found.candidates[0]
    for each in found.candidates:
        np.testing.assert_array_equal(each.T_map_camera[:3, 3], each.registered.camera_m)
        R_map_level = each.T_map_camera[:3, :3] @ R_LEVEL_CAMERA.T
        np.testing.assert_allclose(R_map_level, each.registered.R_map_level, atol=1e-12)
    np.testing.assert_array_equal(found.covariance, found.covariance.T)
    deviation, best = np.sqrt(np.diag(found.covariance)[:3]), found.best.registered
    assert (np.abs(TRUE[1, 3] + 40 * (best.hypothesis == 0) - best.camera_m[1])) < 4 * deviation[1] + 0.02
    assert deviation.max() < 0.3


@pytest.mark.parametrize(("weight", "y_m"), [(0.0, 0.5), (1.0, 40.5)])
def test_the_weight_of_the_similarity_decides_between_two_like_streets(
    bundle, cloud, depth, both, seen_in, weight, y_m
):
    """The true street fits better. The views of the other street have a similarity larger by 0.5."""
    found = refined(bundle, cloud, seen_in(depth, both), inliers=1.0, similarity=weight, likelihood=0.0)
    inliers = {each.registered.hypothesis: each.registered.inliers for each in reversed(found.candidates)}
    assert inliers[0] < inliers[1] < inliers[0] + 0.5
    assert found.best.T_map_camera[1, 3] == pytest.approx(y_m, abs=0.3)
    assert found.best.registered.hypothesis == (0 if weight else 1)


@pytest.mark.parametrize("weights", [{}, ONLY_INLIERS, {"inliers": 0.0, "similarity": 0.0, "likelihood": 1.0}])
def test_like_similarity_leaves_it_to_the_points(bundle_like, cloud, depth, both, seen_in, weights):
    found = refined(bundle_like(0.7, 0.7), cloud, seen_in(depth, both), **weights)
    assert found.best.T_map_camera[1, 3] == pytest.approx(0.5, abs=0.05)


def test_similarity_is_of_the_places_around_the_pose_not_of_the_view_that_it_started_from(
    bundle, cloud, depth, matches_at, seen_in
):
    """The start in the true street came from a match of 0.95, but the places there have a similarity of 0.4."""
    found = refined(bundle, cloud, seen_in(depth, matches_at([(0, 0, 1.8)], [0], [0.95])))
    assert [each.scores["similarity"] for each in found.candidates] == pytest.approx(
        [0.4] * len(found.candidates), abs=BYTE
    )


def test_candidates_come_in_the_order_of_their_support(bundle, cloud, depth, both, seen_in):
    found = refined(bundle, cloud, seen_in(depth, both), inliers=2.0, similarity=3.0, likelihood=0.5)
    sums = [
        2 * c.registered.inliers + 3 * c.scores["similarity"] + 0.5 * c.scores["likelihood"] for c in found.candidates
    ]
    support = [candidate.support for candidate in found.candidates]
    assert len(support) > 1
    assert support == pytest.approx(sums)
    assert support == sorted(support, reverse=True)


@pytest.mark.parametrize(("y_m", "heading_rad"), [(0.0, None), (40.0, None), (40.0, 0.0)])
def test_a_prior_decides_where_nothing_else_does(bundle, cloud, depth, both, seen_in, y_m, heading_rad):
    prior = Prior(position_m=np.array([0.0, y_m]), position_std_m=10.0, heading_rad=heading_rad)
    nothing = {"inliers": 0.0, "similarity": 0.0, "likelihood": 0.0}
    found = refined(bundle, cloud, seen_in(depth, both), prior=prior, **nothing)
    assert found.best.T_map_camera[1, 3] == pytest.approx(y_m + 0.5, abs=0.3)
    xy = np.array([each.T_map_camera[:2, 3] for each in found.candidates])
    headings = np.array([heading_of_camera(each.T_map_camera) for each in found.candidates])
    np.testing.assert_allclose(
        [each.support for each in found.candidates], prior.log_weight(xy, headings), atol=5e-3
    )  # the camera's heading is the level frame's but for the lean


def test_an_empty_picture_is_not_registered(bundle, cloud, depth, both, seen_in):
    assert refined(bundle, cloud, seen_in(np.zeros_like(depth), both)) is None


def test_a_picture_of_too_few_points_is_not_registered(bundle, cloud, depth, both, seen_in):
    few = np.zeros_like(depth)
    few[20, 10:39] = depth[20, 10:39]
    assert refined(bundle, cloud, seen_in(few, both)) is None
    few[20, 39:45] = depth[20, 39:45]
    found = refined(bundle, cloud, seen_in(few, both))
    assert found is not None
    assert 30 <= found.points <= 35


@pytest.fixture
def judged(cloud, monkeypatch):
    """Return the cloud with brightness. A fake brightness score of each pose is its y."""
    asked_y_m = []

    def brightness(scorer, poses):
        assert scorer.is_known
        y_m = [pose.camera_m[1] for pose in poses]
        asked_y_m.extend(y_m)
        return Scores(np.array(y_m))

    monkeypatch.setattr(BrightnessScorer, "score", brightness)
    return replace(cloud, brightness=np.ones(len(cloud.surfels), np.float16)), asked_y_m


def test_brightness_decides_among_candidates_that_are_close(bundle_like, judged, depth, both, seen_in):
    lit, asked_y_m = judged
    weights = {"inliers": 1.0, "similarity": 0.0, "likelihood": 0.0, "brightness_gap": 5.0}
    without = refined(bundle_like(0.7, 0.7), lit, seen_in(depth, both), brightness=0.0, **weights)
    found = refined(bundle_like(0.7, 0.7), lit, seen_in(depth, both), brightness=0.1, **weights)
    assert without.best.T_map_camera[1, 3] == pytest.approx(0.5, abs=0.1)
    assert found.best.T_map_camera[1, 3] == pytest.approx(40.5, abs=0.3)
    assert len(asked_y_m) == 2 * len(found.candidates) > 2
    support = [candidate.support for candidate in found.candidates]
    assert support == sorted(support, reverse=True)
    for each in found.candidates[1:]:  # the first was adjusted after it was judged
        assert each.support == pytest.approx(each.registered.inliers + 0.1 * each.registered.camera_m[1])


def test_a_candidate_with_a_large_support_gap_is_not_rendered_and_stays_behind(
    bundle_like, judged, depth, both, seen_in
):
    """By similarity, the street beside has a gap of 9 nats. Its brightness would close the gap but is not computed."""
    lit, asked_y_m = judged
    weights = {"inliers": 1.0, "similarity": 30.0, "likelihood": 0.0, "brightness_gap": 5.0}
    unlit = refined(bundle_like(0.4, 0.7), replace(lit, brightness=None), seen_in(depth, both), **weights)
    assert asked_y_m == []
    found = refined(bundle_like(0.4, 0.7), lit, seen_in(depth, both), brightness=10.0, **weights)
    assert found.best.T_map_camera[1, 3] == pytest.approx(0.5, abs=0.1)
    assert max(asked_y_m, default=0.0) < 20.0
    beside = [[c.support - r.best.support for c in r.candidates if c.T_map_camera[1, 3] > 20] for r in (unlit, found)]
    assert max(beside[1]) <= max(beside[0]) + 1e-9 < -5


def test_brightness_decides_between_two_streets_with_equal_depth(bundle_like, cloud, depth, both, seen_in):
    """The brightness of the map at the true pose, as an image of another scale and sign."""
    rng = np.random.default_rng(2)
    lit = replace(cloud, brightness=rng.uniform(0.05, 1.0, len(cloud.surfels)).astype(np.float16))
    frame = seen_in(depth, both)
    camera = CAMERA.scaled_to(160, 120)
    T = TRUE.copy()
    T[:3, 3] -= lit.origin_m
    surfel_of = SurfelRaycaster(lit, RaySettings()).intersect(T, camera)
    grey = np.where(surfel_of >= 0, 255 - 200 * lit.brightness[np.maximum(surfel_of, 0)], 128).astype(np.uint8)
    frame = replace(frame, query=replace(frame.query, rgb=np.repeat(grey[..., None], 3, axis=2)))
    weights = {"inliers": 1.0, "similarity": 2.0, "likelihood": 0.0}
    blind, found = (refined(bundle_like(0.9, 0.4), each, frame, brightness=30.0, **weights) for each in (cloud, lit))
    assert blind.best.T_map_camera[1, 3] == pytest.approx(40.5, abs=0.3)
    np.testing.assert_allclose(found.best.T_map_camera[:3, 3], TRUE[:3, 3], atol=0.05)


#: Registration from the hypotheses themselves, without ray adjustment. Starts around them would find poses ahead by themselves.
ONE_START = RefineSettings(
    rays=RaySettings(fewest=10**6), registration=RegistrationSettings(offsets_m=((0.0, 0.0),), turns_rad=())
)


def test_a_noisy_query_triggers_a_local_search_and_moves_to_the_best_brightness(
    bundle_like, cloud, depth, here, seen_in, monkeypatch
):
    """Points do not constrain the position along a bare street. The brightness score is largest 1.4 m ahead of the result."""
    lit = replace(cloud, brightness=np.ones(len(cloud.surfels), np.float16))
    ahead = TRUE[:3, 3] + 1.4 * np.array([np.cos(np.deg2rad(HEADING_DEG)), np.sin(np.deg2rad(HEADING_DEG)), 0])
    monkeypatch.setattr(
        BrightnessScorer,
        "score",
        lambda _, poses: Scores(np.array([-np.linalg.norm(pose.camera_m - ahead) for pose in poses])),
    )
    near = [LocalPose(each, 0.5) for each in _shifted(refined(bundle_like(0.4, 0.9), lit, seen_in(depth, here)))]
    monkeypatch.setattr(refining, "search_locally", lambda *_: near)
    smooth = replace(
        seen_in(depth, here), noise=5e-3
    )  # errors that near pixels share make no hollows beside the right pose
    noisy = replace(smooth, independent_noise=5e-3)
    found = {}
    for name, frame, settings in (
        ("noisy", noisy, ONE_START),
        ("exact", seen_in(depth, here), ONE_START),
        ("smooth", smooth, ONE_START),
        ("sure", noisy, replace(ONE_START, near=LocalScoreWeights(stay=1e6))),
    ):
        near[0] = LocalPose(_registered_by(bundle_like(0.4, 0.9), lit, frame), 0.5)
        found[name] = always_refined(bundle_like(0.4, 0.9), lit, (frame,), None, settings)
    moved, sure = found["noisy"], found["sure"]
    np.testing.assert_allclose(moved.best.T_map_camera[:3, 3], ahead, atol=0.05)
    for stayed in (found["exact"], found["smooth"], sure):
        np.testing.assert_allclose(stayed.best.T_map_camera[:3, 3], TRUE[:3, 3], atol=0.05)
    assert moved.best.support >= sure.best.support


def _registered_by(bundle, lit, frame):
    """Return the result of registration alone."""
    return always_refined(bundle, replace(lit, brightness=None), (frame,), None, ONE_START).best.registered


def _shifted(found):
    best = found.best.registered
    ahead = best.R_map_level @ [1.4, 0.0, 0.0]
    return [best, replace(best, camera_m=best.camera_m + ahead), replace(best, camera_m=best.camera_m - ahead)]


# A frame 2 m further on that is turned by 20 degrees, leans otherwise, and was levelled otherwise too.
R_LEVEL_OTHER = rotation_y(np.deg2rad(-3.0)) @ R_BODY_OPTICAL
OTHER = transform_from(rotation_z(np.deg2rad(25.0)) @ R_LEVEL_OTHER, np.array([2.8, 0.3, 1.6]))


@pytest.fixture
def two_frames(street, depth, here, seen_in):
    other = seen_in(
        taken(street, OTHER, seed=9), here, R_level_camera=R_LEVEL_OTHER, T_reference_camera=inverse(TRUE) @ OTHER
    )
    return seen_in(depth, here), other


def test_two_frames_together_are_found_where_the_reference_was_taken(bundle, cloud, two_frames):
    found = refined(bundle, cloud, *two_frames)
    np.testing.assert_allclose(found.best.T_map_camera, TRUE, atol=0.03)
    alone = [refined(bundle, cloud, replace(frame, T_reference_camera=np.eye(4))).points for frame in two_frames]
    assert found.points == sum(alone)


def test_another_frame_localizes_a_reference_without_matches(bundle, cloud, depth, here, two_frames, seen_in):
    found = refined(bundle, cloud, seen_in(np.zeros_like(depth), here), two_frames[1])
    np.testing.assert_allclose(found.best.T_map_camera, TRUE, atol=0.1)
    assert found.best.scores["through"] < 0.02


def test_agreement_is_the_mean_over_frames_at_their_own_poses(bundle, cloud, two_frames, matches_at):
    found = refined(bundle, cloud, *two_frames).best
    alone = []
    for frame, T_true, heading_deg in zip(two_frames, (TRUE, OTHER), (5, 25), strict=True):
        there = matches_at([(*T_true[:2, 3], 1.8)], [heading_deg], [0.9])
        own = refined(bundle, cloud, replace(frame, T_reference_camera=np.eye(4), matches=there)).best
        np.testing.assert_allclose(own.T_map_camera, T_true, atol=0.05)
        alone.append(own.scores)
    for name, off in (("likelihood", 0.1), ("through", 0.02)):
        assert found.scores[name] == pytest.approx(np.mean([each[name] for each in alone]), abs=off)


def test_the_choice_of_the_level_frame_does_not_matter(bundle, cloud, two_frames, matches_at):
    """The level frame of the second frame is rotated by a right angle, and so are the headings of its matches."""
    other = two_frames[1]
    views = replace(other.views, R_level_camera=rotation_z(np.pi / 2) @ other.R_level_camera)
    turned = replace(other, views=views, matches=matches_at([(0, 0, 1.8)], [-90], [0.9]))
    one, same = (refined(bundle, cloud, two_frames[0], each) for each in (other, turned))
    np.testing.assert_allclose(same.best.T_map_camera, one.best.T_map_camera, atol=1e-4)
    np.testing.assert_allclose(same.covariance, one.covariance, rtol=1e-2, atol=1e-9)
    assert same.best.scores["likelihood"] == pytest.approx(one.best.scores["likelihood"], abs=0.01)


def test_similarity_is_the_mean_over_frames(bundle, cloud, two_frames):
    """In the true street with views (0.4, 0.917), a frame (1, 0) has the similarity 0.4 and a frame (0, 1) 0.917."""
    across = replace(two_frames[1], descriptors=np.array([[0.0, 1.0]], np.float32))
    found = refined(bundle, cloud, two_frames[0], across)
    assert found.best.scores["similarity"] == pytest.approx((0.4 + np.sqrt(0.84)) / 2, abs=BYTE)


def test_how_far_the_places_are_is_the_mean_over_frames(bundle, cloud, two_frames, monkeypatch):
    """Places are at whole metres of the street centre. Each frame has the distance of its pose to the nearest place."""
    monkeypatch.setattr(similar, "WIDTH_M", 0.01)
    found = refined(bundle, cloud, *two_frames).best
    stood = [found.T_map_camera @ frame.T_reference_camera for frame in two_frames]
    away = [np.hypot(T[0, 3] - round(T[0, 3]), T[1, 3]) for T in stood]
    assert found.scores["place_m"] == pytest.approx(np.mean(away), abs=0.01)  # the rays move it by less
    assert away[0] > away[1] + 0.1


@pytest.fixture
def asked(monkeypatch):
    """Record the arguments of each function of the last stage, in order."""
    calls = []

    def noted(name, module=refining):
        kept = getattr(module, name)

        def call(*given, **named):
            calls.append((name, given))
            return kept(*given, **named)

        monkeypatch.setattr(module, name, call)

    noted("adjust", along_rays)
    for name in ("spread_of_restarts", "score_outer_product", "covariance_of"):
        noted(name)
    return calls


def test_the_best_supported_candidate_is_adjusted_and_its_covariance_is_that_of_its_rays(
    bundle, cloud, depth, both, seen_in, asked
):
    """It is not the candidate with most inliers, because the views of the other street are more similar.

    Only this candidate is compared along the rays, and its adjusted pose is used again.
    """
    first = seen_in(depth, both)
    frames = [replace(first, noise=noise) for noise in (3e-4, 1e-4, 2e-4)]
    found = refined(bundle, cloud, *frames, inliers=1.0, similarity=1.0, likelihood=0.0, rays_most=1)
    best = found.best.registered
    assert best.inliers < max(each.registered.inliers for each in found.candidates)
    assert [name for name, _ in asked] == ["adjust", "spread_of_restarts", "covariance_of"]
    (raycaster, pictures, before, settings), restarting, covering = (given for _, given in asked)
    information, scatter, noise, heading, model, stability = covering
    assert raycaster.cloud is cloud
    assert settings == RefineSettings().rays
    assert [picture.noise for picture in pictures] == [3e-4, 1e-4, 2e-4]
    again = adjust(raycaster, pictures, before, settings)
    assert again is not None
    adjusted, its_scatter = again
    np.testing.assert_array_equal(best.camera_m, adjusted.camera_m)
    np.testing.assert_array_equal(found.best.T_map_camera[:3, 3], adjusted.camera_m)
    np.testing.assert_allclose(found.best.T_map_camera[:3, :3], adjusted.R_map_level @ R_LEVEL_CAMERA, atol=1e-12)
    np.testing.assert_array_equal(information, adjusted.information)
    np.testing.assert_array_equal(scatter, its_scatter)
    assert noise == 2e-4
    assert model is OF_RAYS
    assert heading == heading_of_camera(found.best.T_map_camera)
    assert restarting == (raycaster, pictures, best, heading, settings, RefineSettings().restarts)
    np.testing.assert_array_equal(stability.restarts, spread_of_restarts(*restarting))
    np.testing.assert_array_equal(stability.shift, difference(best.T_map_level, before.T_map_level))
    assert stability.mapped_inliers == before.inliers / (1.0 - found.best.scores["unmapped"])
    assert stability.along_residual == found.confirmation.along_residual
    expected = covariance_of(information, scatter, noise, heading, OF_RAYS, stability)
    np.testing.assert_array_equal(found.registration_covariance, expected)
    np.testing.assert_array_equal(found.covariance, expected + relative_pose_covariance(3))


def test_the_evidence_along_the_rays_is_that_of_the_final_pose(bundle, cloud, depth, here, seen_in):
    found = always_refined(bundle, cloud, (seen_in(depth, here),), None, RefineSettings())
    (final,) = [each for each in found.compared if each.pose is found.best.registered]
    assert found.ray_evidence == final.evidence
    assert found.verified == final.verified
    assert found.ray_evidence.static_inliers > 0.5


def test_a_result_keeps_no_images_of_the_poses_that_were_compared(bundle, cloud, depth, here, seen_in):
    """A comparison of one frame has 393,216 bytes. A pose with its scatter and its numbers has about two thousand."""
    found = always_refined(bundle, cloud, (seen_in(depth, here),), None, RefineSettings())
    assert found.compared
    assert len(pickle.dumps(found.compared)) < 4000 * len(found.compared)


def test_with_too_few_intersections_pose_and_covariance_are_those_of_the_points(
    bundle, cloud, depth, here, seen_in, asked
):
    settings = RefineSettings(rays=RaySettings(fewest=10**6))
    found = always_refined(bundle, cloud, (seen_in(depth, here),), None, settings)
    best = found.best.registered
    assert [name for name, _ in asked] == ["adjust", "score_outer_product", "covariance_of"]
    of_cloud, points, registered, registration = asked[1][1]
    assert (of_cloud is cloud, registered is best, registration is settings.registration) == (True, True, True)
    assert len(points) == found.points
    information, scatter, _, _, model = asked[2][1]
    np.testing.assert_array_equal(information, best.information)
    np.testing.assert_array_equal(scatter, score_outer_product(cloud, points, best, registration))
    assert model is OF_POINTS


def test_frames_of_a_drive_are_adjusted_together(bundle, cloud, two_frames, asked):
    """The odometry gives the camera pose of each frame relative to the level frame of the reference."""
    refined(bundle, cloud, *two_frames)
    _, pictures, _, _ = asked[0][1]
    for frame, picture in zip(two_frames, pictures, strict=True):
        T_reference_camera = transform_from(two_frames[0].R_level_camera.T, np.zeros(3)) @ picture.T_level_camera
        np.testing.assert_allclose(T_reference_camera, frame.T_reference_camera, atol=1e-9)
        assert picture.focal_baseline_px_m is None


def test_a_stereo_rigs_disparity_offset_is_estimated_where_its_baseline_is_known(bundle, cloud, street, here, seen_in):
    """50 px times 1 m give 5 px of disparity at 10 m. Of these 0.3 px are missing, so all depths are 6 % too large."""
    true = street.depth(CAMERA, TRUE)
    measured = (1 / (1 / np.maximum(true, 1e-3) - 0.3 / 50.0)).astype(np.float32)
    frame = seen_in(measured, here)
    rig = replace(frame, query=replace(frame.query, baseline_m=1.0))
    corrected, believed = (refined(bundle, cloud, each).best.T_map_camera[:2, 3] for each in (rig, frame))
    np.testing.assert_allclose(corrected, TRUE[:2, 3], atol=0.08)
    assert np.linalg.norm(believed - TRUE[:2, 3]) > 2 * np.linalg.norm(corrected - TRUE[:2, 3])


def test_settings_for_a_rig_free_the_offset_once_the_pose_is_roughly_known():
    settings = RefineSettings()
    found = settings_for_rig(settings, 123.0)
    assert found.focal_baseline_px_m == 123.0
    free = {name: getattr(found.registration, name).free_offset for name in ("coarse", "middle", "fine")}
    assert free == {"coarse": False, "middle": True, "fine": True}
    assert not settings.registration.fine.free_offset


@pytest.mark.parametrize(("width", "focal_px"), [(80, 50.0), (40, 25.0)])
def test_the_unit_of_disparity_is_that_of_the_depth_picture(here, seen_in, width, focal_px):
    query = seen_in(np.ones((60, 80), np.float32), here).query
    assert query.focal_baseline_px_m is None
    depth_m = np.ones((width * 3 // 4, width), np.float32)
    assert replace(query, depth_m=depth_m, baseline_m=0.5).focal_baseline_px_m == 0.5 * focal_px


def test_starts_of_several_frames_are_scored_at_the_pose_of_each_frame(bundle_at, frame_with, matches_at, monkeypatch):
    """Place k at x = 10 k has the similarity 0.1 k. The second frame is 10 m ahead, so the mean of k and k + 1 counts."""
    monkeypatch.setattr(similar, "PLACES", 1)
    bundle = bundle_at(
        [(10.0 * k, 0.0, 2.0) for k in range(8)], [0.0], [(0.1 * k, np.sqrt(1 - 0.01 * k * k)) for k in range(8)]
    )
    matches = matches_at([(0, 0, 2)], [0], [0.9])
    ahead = transform_from(np.eye(3), np.array([0.0, 0.0, 10.0]))  # optical: z is forward
    frames = (frame_with(matches), frame_with(matches, T_reference_camera=ahead))
    measured = measure(frames, PointSettings(), focal_baseline_px_m=80.0, is_rig=False)

    def similarity(T_map_level):
        return similarity_of(bundle, measured, T_map_level)[0]

    T_map_level = np.stack([transform_from(np.eye(3), np.array([x, 0.0, 1.4])) for x in (1.0, 29.0)])
    np.testing.assert_allclose(similarity(T_map_level), [0.05, 0.35], atol=BYTE)
    turned = transform_from(rotation_z(np.pi), np.array([30.0, 0.0, 1.4]))[None]  # ahead is now at x = 20
    np.testing.assert_allclose(similarity(turned), [0.25], atol=BYTE)
