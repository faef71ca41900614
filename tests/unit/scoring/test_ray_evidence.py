from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.camera import PinholeCamera
from service.registration.points import PointSettings
from service.registration.rays import RaySettings, adjust
from service.registration.surfel_map import SurfelMap
from service.registration.surfel_tiles import SurfelTiles
from service.registration.visibility import Raycasters, SurfelRaycaster
from service.scoring import ray_evidence as along_rays
from service.scoring.comparison import PLANES, FrameCells
from service.scoring.measured import measure
from service.scoring.photometry import PhotometrySettings
from service.scoring.ray_evidence import RayScorer, RayWeights, mean_evidence, ray_evidence_of
from service.scoring.ray_image import RayImage, ray_image_of
from service.scoring.verifier import Verifier

#: 60 columns and 40 rows, 1.5 m above the ground. A ray of row r gains (19.5 - r) / 20 m for each metre of depth.
SHAPE = (40, 60)
CLIMB = np.repeat((19.5 - np.arange(40)) / 20, 60).reshape(SHAPE)
CAMERA_M = 1.5


def image(z_m, mapped_m, sigma=1e-3):
    return RayImage(
        surfel_of=np.zeros(SHAPE, np.int32),
        z_m=np.asarray(z_m, float),
        mapped_m=np.asarray(mapped_m, float),
        sigma=np.full(SHAPE, sigma),
        climb=CLIMB,
        camera_m=CAMERA_M,
    )


def scene(wall_m=10.0, *, columns=(), object_m=5.0, top_m=np.inf):
    """A ground, a wall behind it, and an object in some columns that is ``top_m`` high."""
    ground = np.where(CLIMB < 0, CAMERA_M / np.maximum(-CLIMB, 1e-9), np.inf)
    z = np.minimum(ground, wall_m)
    for column in columns:
        covered = object_m * CLIMB[:, column] + CAMERA_M <= top_m
        z[covered, column] = np.minimum(z[covered, column], object_m)
    return z


#: Rows 0 to 18 of the wall at 10 m are higher than 2 m: 10 (19.5 - r) / 20 > 0.5. Rows 0 to 21 are higher than 0.3 m.
UPPER_10, RAISED_10 = 19, 22


def test_a_right_pose_has_only_inliers():
    seen = scene()
    found = ray_evidence_of(image(seen, seen))
    assert found.static_inliers == pytest.approx((RAISED_10 * 60 + 10) / (RAISED_10 * 60 + 20))
    assert found.upper_through == 0.0


def test_a_wall_that_the_camera_sees_through_is_a_contradiction():
    """Rows 0 to 17 of a wall at 5 m are at least 2 m high. Each ray ends 5 m behind it."""
    columns = range(10)
    found = ray_evidence_of(image(scene(), scene(columns=columns)))
    others = 50 * UPPER_10
    assert found.upper_through == pytest.approx(10 * 18 / (10 * 18 + others + 20))
    # The rays through the wall are above 0.3 m in rows 0 to 21. Rows 18 to 21 of the wall may be a vehicle that left.
    assert found.static_inliers == pytest.approx((50 * RAISED_10 + 10) / (50 * RAISED_10 + 10 * 18 + 20))


def test_a_vehicle_that_left_or_came_is_no_contradiction():
    """1.8 m high and 5 m away."""
    without, vehicle = scene(), scene(columns=range(10), top_m=1.8)
    assert (without != vehicle).any()
    for seen, mapped in ((without, vehicle), (vehicle, without)):
        found = ray_evidence_of(image(seen, mapped))
        assert found.upper_through == 0.0
        assert found.static_inliers > 0.985
        assert (found.occlusion_edges, found.upper_occlusion_edges) == (0.0, 0.0)


def test_a_new_house_is_a_contradiction():
    """It stands in front of the map's wall, above the height of a vehicle: those pixels are no inliers."""
    found = ray_evidence_of(image(scene(columns=range(10)), scene()))
    high = 10 * 18  # above 2 m at a depth of 5 m
    assert found.static_inliers == pytest.approx((50 * RAISED_10 + 10) / (50 * RAISED_10 + high + 20))
    assert found.upper_through == 0.0


def test_a_pole_has_an_edge_on_each_side():
    """Both images show it at the same place, or three columns apart. The pole is 5 m away, and 2 m high or higher in rows 0 to 17.

    An edge needs a difference of 1.25 m. The ground beside the pole is at 30 / (row - 19.5) m, so rows 0 to 24 have edges.
    """
    pole, moved = scene(columns=(30,)), scene(columns=(33,))
    rows, high = 25, 18
    found = ray_evidence_of(image(pole, pole))
    assert found.occlusion_edges == pytest.approx(4 * rows / (4 * rows + 20))
    assert found.upper_occlusion_edges == pytest.approx(4 * high / (4 * high + 20))
    other = ray_evidence_of(image(pole, moved))
    assert (other.occlusion_edges, other.upper_occlusion_edges) == (0.0, 0.0)


def test_an_edge_has_its_partner_although_a_hole_is_beside_it():
    """The map shows the pole a column further right, where the image has a hole. So no edge of the map is compared.

    The left edge of the image's pole is within a pixel of the map's. Rows 18 to 24 may be a vehicle that came, 0 to 17 are higher.
    """
    seen = scene(columns=(30,))
    seen[:, 31] = 0.0
    found = ray_evidence_of(image(seen, scene(columns=(31,))))
    assert (found.occlusion_edges, found.upper_occlusion_edges) == pytest.approx((18 / 38, 18 / 38))


def test_what_lies_below_the_ground_of_the_map_is_no_vehicle_that_left():
    """From column 30 on, the rays to the ground (rows 23 to 39) go twice as far. These 17 edges count, and the map has none there."""
    mapped = scene(columns=(10,))
    seen = mapped.copy()
    seen[23:, 30:] *= 2
    found = ray_evidence_of(image(seen, mapped))
    assert found.occlusion_edges == pytest.approx(4 * 25 / (4 * 25 + 17 + 20))


def test_without_a_surface_nothing_is_said():
    nothing = np.zeros(SHAPE)
    for seen, mapped in ((nothing, scene()), (scene(), nothing), (nothing, nothing)):
        assert astuple(ray_evidence_of(image(seen, mapped))) == (0.5, 0.0, 0.0, 0.0)


@given(seed=st.integers(0, 2**32 - 1), sigma=st.floats(1e-6, 0.5))
def test_the_numbers_are_shares(seed, sigma):
    rng = np.random.default_rng(seed)
    z, mapped = (np.where(rng.random(SHAPE) < rng.random(), rng.uniform(0.3, 80.0, SHAPE), 0.0) for _ in range(2))
    found = astuple(ray_evidence_of(image(z, mapped, sigma)))
    assert np.isfinite(found).all()
    assert min(found) >= 0
    assert max(found) < 1


def evidence_at(raycaster, measured, pose):
    return mean_evidence([ray_evidence_of(ray_image_of(raycaster, each, each.pose(pose))) for each in measured])


def scorer_of(cloud, measured, settings=None, verifier=None):
    settings, verifier = settings or RaySettings(), verifier or Verifier.shipped()
    return RayScorer(Raycasters(cloud, settings), measured, settings, RayWeights(), PhotometrySettings(), verifier)


@pytest.fixture
def raycaster(street_map):
    return SurfelRaycaster(street_map, RaySettings())


@pytest.fixture
def measured(frame_with, matches_at, candidate, raycaster):
    """Return one frame that measures the street from the pose of ``candidate``."""
    frame = frame_with(matches_at([(0, 0, 2)], [0], [0.9]))
    T = frame.pose_of_camera(candidate(xyz=(0.0, 0.0, 1.5)).registered.T_map_level)
    camera = PinholeCamera(120, 90, 60.0, 60.0, 59.5, 44.5)
    query = replace(frame.query, depth_m=raycaster.depth(T, camera).astype(np.float32), camera=camera)
    return measure((replace(frame, query=query),), PointSettings(), focal_baseline_px_m=80.0, is_rig=True)


def test_the_map_is_seen_from_the_pose(raycaster, measured, candidate):
    right, beside, turned = (
        evidence_at(raycaster, measured, candidate(xyz=xyz, heading_deg=heading).registered)
        for xyz, heading in (((0.0, 0.0, 1.5), 0.0), ((0.0, 1.5, 1.5), 0.0), ((0.0, 0.0, 1.5), 20.0))
    )
    assert right.static_inliers > 0.95
    assert right.upper_through < 0.02
    assert right.occlusion_edges > 0.5
    for wrong in (beside, turned):
        assert wrong.static_inliers < right.static_inliers - 0.2
        assert wrong.occlusion_edges < right.occlusion_edges - 0.2


def test_the_surfels_have_an_origin_of_their_own(street, raycaster, measured, candidate):
    away = SurfelRaycaster(SurfelMap.prepare(np.array([100.0, -50.0, 3.0]), street.surfels()), RaySettings())
    expected = evidence_at(raycaster, measured, candidate(xyz=(0.0, 0.0, 1.5)).registered)
    found = evidence_at(away, measured, candidate(xyz=(100.0, -50.0, 4.5)).registered)
    assert astuple(found) == pytest.approx(astuple(expected), abs=1e-3)


def test_the_depth_is_corrected_by_scale_and_offset(raycaster, measured, candidate):
    """A measured inverse depth of q means (q + offset / focal length times baseline) / scale."""
    pose = candidate(xyz=(0.0, 0.0, 1.5)).registered
    (one,) = measured
    expected = evidence_at(raycaster, measured, pose)
    inverse = one.picture.inverse
    shown = np.where(inverse > 0, 1.25 * inverse - 0.5 / 80.0, 0).astype(np.float32)
    changed = replace(one, picture=replace(one.picture, inverse=np.maximum(shown, 0)))
    found = evidence_at(raycaster, (changed,), replace(pose, scale=1.25, offset=0.5))
    assert astuple(found) == pytest.approx(astuple(expected), abs=0.02)
    assert evidence_at(raycaster, (changed,), pose).static_inliers < expected.static_inliers - 0.1


@pytest.mark.parametrize("offset", [-1e6, -0.5, 1e6])
def test_no_offset_makes_a_number_that_is_not_finite(raycaster, measured, candidate, offset):
    found = astuple(evidence_at(raycaster, measured, replace(candidate().registered, offset=offset)))
    assert np.isfinite(found).all()
    assert all(0 <= share < 1 for share in found)


def test_depth_without_a_baseline_has_no_offset(raycaster, measured, candidate):
    pose = candidate(xyz=(0.0, 0.0, 1.5)).registered
    (one,) = measured
    plain = replace(one, picture=replace(one.picture, focal_baseline_px_m=None))
    assert evidence_at(raycaster, (plain,), replace(pose, offset=3.0)) == evidence_at(raycaster, measured, pose)


def test_another_frame_is_compared_at_its_own_pose(raycaster, frame_with, matches_at, candidate):
    """It looks at the street from 3 m ahead of the reference."""
    frame, pose = frame_with(matches_at([(0, 0, 2)], [0], [0.9])), candidate(xyz=(0.0, 0.0, 1.5)).registered
    camera = PinholeCamera(120, 90, 60.0, 60.0, 59.5, 44.5)
    ahead = np.eye(4)
    ahead[2, 3] = 3.0
    frames = []
    for T_reference_camera in (np.eye(4), ahead):
        T = frame.pose_of_camera(pose.T_map_level) @ T_reference_camera
        seen = replace(frame.query, depth_m=raycaster.depth(T, camera).astype(np.float32), camera=camera)
        frames.append(replace(frame, query=seen, T_reference_camera=T_reference_camera))
    _, other = measure(tuple(frames), PointSettings(), focal_baseline_px_m=80.0, is_rig=True)
    assert evidence_at(raycaster, (other,), pose).static_inliers > 0.95
    assert evidence_at(raycaster, (replace(other, is_reference=True),), pose).static_inliers < 0.9


def test_frames_are_averaged(raycaster, measured, candidate):
    pose = candidate(xyz=(0.0, 0.0, 1.5)).registered
    (one,) = measured
    blind = replace(one, is_reference=False, picture=replace(one.picture, inverse=np.zeros_like(one.picture.inverse)))
    expected = 0.5 * (np.array(astuple(evidence_at(raycaster, measured, pose))) + (0.5, 0.0, 0.0, 0.0))
    assert astuple(evidence_at(raycaster, (one, blind), pose)) == pytest.approx(tuple(expected))


def test_the_scorer_weighs_three_numbers_of_the_adjusted_poses(street_map, measured, candidate):
    """The second pose is 0.3 m ahead. Its adjustment moves it to the first."""
    scorer = scorer_of(street_map, measured)
    right, ahead, beside = (
        candidate(xyz=xyz).registered for xyz in ((0.0, 0.0, 1.5), (0.3, 0.0, 1.5), (0.0, 12.0, 1.5))
    )
    values = scorer.score((right, ahead, beside)).values
    found = [scorer.at(pose) for pose in (right, ahead, beside)]
    assert values == pytest.approx(
        [12 * each.evidence.static_inliers + 13 * each.evidence.occlusion_edges + 0.6 * each.verified for each in found]
    )
    assert values[1] == pytest.approx(values[0], abs=0.5)
    assert values[2] < values[0] - 3
    np.testing.assert_allclose(scorer.at(ahead).pose.camera_m, scorer.at(right).pose.camera_m, atol=0.02)


def test_a_pose_is_adjusted_once(street_map, measured, candidate, monkeypatch):
    asked = []

    def counted(raycaster, pictures, pose, settings):
        asked.append(pose)
        return adjust(raycaster, pictures, pose, settings)

    monkeypatch.setattr(along_rays, "adjust", counted)
    scorer = scorer_of(street_map, measured)
    pose, like_it = candidate(xyz=(0.0, 0.0, 1.5)).registered, candidate(xyz=(0.0, 0.0, 1.5)).registered
    scorer.score((pose,))
    first = scorer.at(pose)
    assert scorer.at(pose) is first
    assert scorer.at(like_it) is not first
    assert [each is pose for each in asked] == [True, False]


def test_a_pose_with_too_few_rays_is_compared_as_it_is(street_map, measured, candidate):
    settings = RaySettings(fewest=10**6)
    pose = candidate(xyz=(0.0, 0.0, 1.5)).registered
    found = scorer_of(street_map, measured, settings).at(pose)
    assert found.pose is pose
    assert found.scatter is None
    assert found.evidence == evidence_at(SurfelRaycaster(street_map, settings), measured, pose)


class Listening(Verifier):
    """A verifier that keeps what it is asked, and gives the next of some log odds for each comparison."""

    def __init__(self, *odds):
        self.asked, self._odds = [], list(odds)

    def log_odds(self, comparisons):
        self.asked += comparisons
        return np.array([self._odds.pop(0) for _ in comparisons], np.float32)


def test_the_comparisons_of_a_pose_are_those_that_the_verifier_saw(street_map, measured, candidate):
    verifier = Listening(1.5)
    scorer = scorer_of(street_map, measured, verifier=verifier)
    found = scorer.at(candidate(xyz=(0.3, 0.0, 1.5)).registered)
    np.testing.assert_array_equal(scorer.comparisons(found.pose), verifier.asked)
    other = scorer.comparisons(candidate(xyz=(0.3, 0.0, 1.5)).registered)
    assert np.abs(other[0] - verifier.asked[0]).max() > 0.1


IN_VIEW, MAPPED, MAPPED_BRIGHTNESS = (PLANES.index(name) for name in ("in_view", "mapped", "mapped_brightness"))


@pytest.fixture
def two_frames(frame_with, matches_at, candidate, raycaster):
    """Return two frames of different cameras: at the pose of ``candidate``, and 3 m ahead with a narrow field of view."""
    frame, pose = frame_with(matches_at([(0, 0, 2)], [0], [0.9])), candidate(xyz=(0.0, 0.0, 1.5)).registered
    ahead, frames = np.eye(4), []
    ahead[2, 3] = 3.0
    for T_reference_camera, focal_px in ((np.eye(4), 60.0), (ahead, 120.0)):
        camera = PinholeCamera(120, 90, focal_px, focal_px, 59.5, 44.5)
        T = frame.pose_of_camera(pose.T_map_level) @ T_reference_camera
        seen = replace(frame.query, depth_m=raycaster.depth(T, camera).astype(np.float32), camera=camera)
        frames.append(replace(frame, query=seen, T_reference_camera=T_reference_camera))
    return measure(tuple(frames), PointSettings(), focal_baseline_px_m=80.0, is_rig=True)


def test_the_verifier_sees_every_frame_in_its_own_cells_and_their_mean_counts(street_map, two_frames, candidate):
    verifier = Listening(3.0, 0.5)
    found = scorer_of(street_map, two_frames, verifier=verifier).at(candidate(xyz=(0.0, 0.0, 1.5)).registered)
    assert found.verified == 1.75
    assert len(verifier.asked) == 2
    own = [FrameCells.of(each, PhotometrySettings()).in_view for each in two_frames]
    for comparison, in_view in zip(verifier.asked, own, strict=True):
        np.testing.assert_array_equal(comparison[IN_VIEW] == 1, in_view)
    assert own[1].sum() < 0.7 * own[0].sum()
    for comparison in verifier.asked:  # both frames measure the map as it is from their own positions
        both = (comparison[PLANES.index("measured")] > 0) & (comparison[MAPPED] > 0)
        assert both.sum() > 1000
        assert (np.abs(comparison[PLANES.index("difference_ratio")][both]) > 0.1).mean() < 0.05


@pytest.mark.parametrize("odds", [-2.0, 0.0, 5.0])
def test_the_log_odds_of_the_verifier_enter_the_score(street_map, measured, candidate, odds):
    pose = candidate(xyz=(0.0, 0.0, 1.5)).registered
    plain, judged = (
        scorer_of(street_map, measured, verifier=Listening(each)).score((pose,)).values[0] for each in (0.0, odds)
    )
    assert judged == pytest.approx(plain + 0.6 * odds)


def test_the_shipped_verifier_prefers_the_right_pose(street_map, measured, candidate):
    """The others are 3 m beside it, turned by 30 degrees, and 9 m behind it. The ray adjustment moves a pose by decimetres only."""
    scorer = scorer_of(street_map, measured)
    right, *wrong = (
        scorer.at(candidate(xyz=xyz, heading_deg=heading).registered).verified
        for xyz, heading in (
            ((0.0, 0.0, 1.5), 0.0),
            ((0.0, 3.0, 1.5), 0.0),
            ((0.0, 0.0, 1.5), 30.0),
            ((-9.0, 0.0, 1.5), 0.0),
        )
    )
    assert right > max(wrong) + 1


@pytest.fixture
def bright_map(street_map):
    """Return the street with intensities of 30 on its left side and 10 on its right side."""
    surfels = street_map.unpacked(np.s_[:])
    intensities = np.where(surfels["xyz"][:, 1] > 0, 30, 10).astype(np.float32)
    return SurfelMap.prepare(street_map.origin_m, surfels, intensities)


def test_the_verifier_sees_the_brightness_of_the_map_on_its_side_of_the_street(bright_map, measured, candidate):
    verifier = Listening(0.0)
    scorer_of(bright_map, measured, verifier=verifier).at(candidate(xyz=(0.0, 0.0, 1.5)).registered)
    (comparison,) = verifier.asked
    hit = comparison[MAPPED] == 1
    left, right = (comparison[MAPPED_BRIGHTNESS][:, side][hit[:, side]] for side in (np.s_[:60], np.s_[68:]))
    assert left.size > 1000
    assert right.size > 1000
    assert left.min() > 0.05
    assert right.max() < -0.05
    assert (comparison[MAPPED_BRIGHTNESS][~hit] == 0).all()


@pytest.mark.parametrize("have_brightness", [True, False])
def test_a_tiled_map_shows_brightness_only_if_all_tiles_have_it(bright_map, measured, candidate, have_brightness):
    """Brightness must not depend on the tile: queries in a map without it somewhere use none anywhere."""
    tiles = SurfelTiles(
        lambda xy_m: [(0,)] * len(xy_m), lambda _: bright_map, np.zeros(3), have_brightness, lambda: [0]
    )
    verifier = Listening(0.0)
    scorer_of(tiles, measured, verifier=verifier).at(candidate(xyz=(0.0, 0.0, 1.5)).registered)
    (comparison,) = verifier.asked
    assert (comparison[MAPPED] == 1).any()
    assert (comparison[MAPPED_BRIGHTNESS] != 0).any() == have_brightness
