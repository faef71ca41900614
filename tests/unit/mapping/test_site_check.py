import weakref
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model_training.mapping import site_check
from model_training.mapping.join import of_places
from model_training.mapping.site_check import FEWEST, MOST, HeldScan, held_out, site_of
from service.confidence.features import FEATURES
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from
from service.imaging.view_grid import ViewGrid
from service.maps.calibration import probability
from service.registration.kernel import SURFEL
from service.registration.surfel_map import SurfelMap

GRID = ViewGrid(rows=64, columns=64)


@pytest.mark.parametrize(
    ("places", "count"),
    [(0, 0), (1, 0), (499, 0), (500, 20), (524, 20), (525, 21), (1499, 59), (1500, 60), (100_000, 60)],
)
def test_one_place_in_twenty_five_is_held_out_from_500_places_on_and_never_more_than_60(places, count):
    assert (MOST, FEWEST) == (60, 20)
    assert len(held_out(places)) == count


@given(st.integers(500, 20_000))
def test_held_out_places_are_spread_evenly_and_never_the_first_or_the_last(places):
    numbers = np.array(sorted(held_out(places)))
    assert 0 < numbers[0] <= numbers[-1] < places - 1
    steps = np.diff(np.r_[0, numbers, places - 1])
    assert steps.max() - steps.min() <= 1


odds = st.lists(st.floats(-20, 20), min_size=1, max_size=40).map(np.array)


def test_the_offset_by_hand():
    """One wrong answer at 0.5: p(x) + x = 0 with a unit prior, so x = -0.401. For a right answer, x has the opposite sign."""
    wrong = site_check._offset(np.zeros(1), np.array([False]))
    assert wrong == pytest.approx(-0.40105, abs=1e-4)
    assert probability(np.array([wrong]))[0] + wrong == pytest.approx(0, abs=1e-9)
    assert site_check._offset(np.zeros(1), np.array([True])) == pytest.approx(-wrong)


def test_a_calibrated_share_gives_no_offset():
    """Three of four are right at log 3 (0.75), and one of two at 0."""
    assert site_check._offset(np.full(4, np.log(3)), np.array([1, 1, 1, 0], bool)) == pytest.approx(0, abs=1e-9)
    assert site_check._offset(np.zeros(2), np.array([1, 0], bool)) == pytest.approx(0, abs=1e-9)


def test_many_answers_overrule_the_prior():
    """0.9 was stated and 0.5 is right: the log odds are too large by log 9."""
    count = 20_000
    found = site_check._offset(np.full(count, np.log(9)), np.arange(count) % 2 == 0)
    assert found == pytest.approx(-np.log(9), abs=0.002)


@given(odds, st.integers(0, 2**40))
def test_the_offset_is_where_errors_and_prior_balance(odds_of, bits):
    right = np.array([bits >> k & 1 for k in range(len(odds_of))], bool)
    found = site_check._offset(odds_of, right)
    assert float((probability(odds_of + found) - right).sum()) + found == pytest.approx(0, abs=1e-6)


def test_a_map_to_check_has_neither_calibration_nor_brightness_nor_preview(content):
    """The check images are rendered from the intensities of the same sensor. They agree with the map better than real images."""
    cloud = SurfelMap.prepare(np.zeros(3), np.zeros(4, SURFEL), np.ones(4, np.float32))
    given = replace(content, cloud=cloud, preview_webp=b"x", calibration={"calibrated": True})
    found = site_check._to_check(given)
    assert found.calibration["calibrated"] is False
    assert found.preview_webp == b""
    assert found.cloud is not None
    assert found.cloud.brightness is None
    assert found.cloud.surfels is cloud.surfels
    assert given.cloud is not None
    assert given.cloud.brightness is not None


def sphere(radius_m, *, intensity=40.0):
    """Return a scan with one point in the middle of every cell of the grid, all around."""
    azimuth, elevation = np.meshgrid(np.arange(GRID.around) / GRID.around * 2 * np.pi - np.pi, GRID.elevations_rad)
    flat = np.cos(elevation)
    directions = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    return np.c_[directions * radius_m, np.full(len(directions), intensity)].astype(np.float32)


@pytest.fixture
def noiseless(monkeypatch):
    monkeypatch.setattr(site_check, "_NOISE_PX", (0.0, 0.0))


def drawn(points, number, T_map_level=None):
    scan = HeldScan(points, np.eye(4) if T_map_level is None else T_map_level)
    return site_check._drawn(scan, GRID, number)


@pytest.mark.parametrize("number", range(4))
def test_a_picture_drawn_inside_a_sphere_sees_its_radius_along_every_ray(noiseless, number):
    query, T_map_camera = drawn(sphere(12.0), number)
    rays = query.camera.rays_of_pixels()
    length = np.linalg.norm(rays, axis=-1)
    elevation = np.rad2deg(np.arcsin((rays @ T_map_camera[:3, :3].T)[..., 2] / length))
    ranges, covered = query.depth_m * length, np.abs(elevation) < 15.0  # as far as the grid goes, up and down
    assert 0.2 < covered.mean() < 0.6
    np.testing.assert_allclose(ranges[covered], 12.0, rtol=1e-3)
    assert not ranges[np.abs(elevation) > 15.5].any()


def test_a_picture_sees_what_the_scan_measured_where_it_looks(noiseless):
    """All ranges differ. Each pixel has the range of the panorama cell that its ray intersects."""
    points = sphere(1.0)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    points[:, :3] *= (8.0 + 4.0 * np.sin(2 * azimuth))[:, None]
    query, T_map_camera = drawn(points, 5)
    rays = query.camera.rays_of_pixels() @ T_map_camera[:3, :3].T
    expected = 8.0 + 4.0 * np.sin(2 * np.arctan2(rays[..., 1], rays[..., 0]))
    found = query.depth_m * np.linalg.norm(query.camera.rays_of_pixels(), axis=-1)
    seen = found > 0
    assert seen.mean() > 0.2
    assert np.abs(found - expected)[seen].max() < 0.06  # half a cell is 0.35 degrees, the range changes by 8 m a radian
    assert np.mean((found - expected)[seen]) == pytest.approx(0, abs=0.002)


def test_the_pose_is_that_of_the_scan_in_the_map_and_gravity_is_written():
    T_map_level = transform_from(rotation_z(1.0), np.array([100.0, -50.0, 3.0]))
    query, T_map_camera = drawn(sphere(10.0), 3, T_map_level)
    np.testing.assert_allclose(T_map_camera[:3, 3], [100, -50, 3])
    np.testing.assert_allclose(T_map_camera[:3, :3] @ query.down_camera, [0, 0, -1], atol=1e-12)
    _, unturned = drawn(sphere(10.0), 3)
    np.testing.assert_allclose(T_map_camera, T_map_level @ unturned, atol=1e-12)


def test_headings_differ_from_scan_to_scan_and_are_the_same_the_next_time():
    axes = [drawn(sphere(10.0), number)[1][:3, 2] for number in range(6)]
    assert len({tuple(np.round(axis, 6)) for axis in axes}) == 6
    np.testing.assert_array_equal(drawn(sphere(10.0), 2)[0].depth_m, drawn(sphere(10.0), 2)[0].depth_m)


@pytest.mark.parametrize(("number", "noise_px"), [(0, 0.1), (1, 0.5)])
def test_the_noise_is_that_of_the_presets_by_turns(number, noise_px):
    """The inverse depth error is noise / 80 px m, on a sphere of 5 m. Pixels of a cell share half of the variance."""
    depth_m = drawn(sphere(5.0), number)[0].depth_m
    seen = depth_m > 0
    error = 1 / depth_m[seen] - np.linalg.norm(site_check._CAMERA.rays_of_pixels(), axis=-1)[seen] / 5.0
    assert error.mean() == pytest.approx(0, abs=0.1 * noise_px / 80.0)
    assert error.std() == pytest.approx(noise_px / 80.0, rel=0.1)
    both = np.zeros(depth_m.shape)
    both[seen] = error
    beside = (seen[:, 1:] & seen[:, :-1], both[:, 1:] - both[:, :-1])
    within = beside[1][beside[0]].std()  # most neighbours look into one cell, so share what errs from beam to beam
    assert np.sqrt(0.5) * np.sqrt(2) * noise_px / 80.0 * 0.95 < within < 1.3 * noise_px / 80.0


def test_grey_follows_the_intensity_and_its_median_is_110(noiseless):
    points = sphere(10.0, intensity=40.0)
    points[points[:, 1] > 0, 3] = 80.0
    for number in range(3):
        query, T_map_camera = drawn(points, number)
        rays = query.camera.rays_of_pixels() @ T_map_camera[:3, :3].T
        seen = query.depth_m > 0
        greys = {tuple(np.unique(query.rgb[seen & (side * rays[..., 1] > 0.05)]).tolist()) for side in (-1, 1)}
        assert greys <= {(110,), (220,), (55,), ()}
        np.testing.assert_array_equal(query.rgb[..., 0], query.rgb[..., 2])


@pytest.mark.parametrize(("radius_m", "is_drawn"), [(39.9, True), (40.1, False), (90.0, False)])
def test_ranges_that_map_views_discard_are_not_rendered(noiseless, radius_m, is_drawn):
    """The views discard ranges beyond 40 m."""
    query, _ = drawn(sphere(radius_m), 0)
    assert (query.depth_m > 0).any() == is_drawn
    assert query.rgb.any() == is_drawn


@pytest.fixture(scope="module")
def scan_of_pictures(pictures):
    """Return the scan that a LiDAR at the camera would measure of ``pictures``, at its map pose."""
    _, depth_m, camera = pictures
    points = (camera.rays_of_pixels() * depth_m[..., None]).reshape(-1, 3) @ R_BODY_OPTICAL.T
    scan = np.c_[points, np.full(len(points), 30.0)].astype(np.float32)
    return HeldScan(scan, transform_from(rotation_z(np.pi / 2), np.array([20.0, 100.0, 1.7])))


def asked(content, calibration, scan, *, right, bias, count=30, monkeypatch):
    """Run the check with given odds: each query is answered at its place, or 5 m beside it."""
    number = iter(range(count))

    class Answering:
        @staticmethod
        def open(_bundle):
            return Answering()

        def localize(self, _query):
            T_map_camera = truth.copy()
            T_map_camera[0, 3] += 0.5 if next(number) < right else 5.0
            return type("Answer", (), {"T_map_camera_guess": T_map_camera, "evidence": np.zeros(len(FEATURES))})

    truth = scan.T_map_level
    monkeypatch.setattr(site_check, "Localizer", Answering)
    monkeypatch.setattr(site_check, "_drawn", lambda *_: (None, truth))
    return site_of(lambda: content, [scan] * count, calibration(right=bias))


@pytest.fixture
def calibrated_at(calibration_of, calibration_json):
    """Return a calibration with the same odds of a right pose for all features."""
    return lambda *, right: calibration_of(right=calibration_json()["right"] | {"bias": float(right)})


@pytest.mark.parametrize(("right", "said"), [(27, 0.5), (30, 0.5), (29, 0.9), (15, 0.5)])
def test_confidence_that_was_too_low_is_left_as_it_is(
    content, calibrated_at, scan_of_pictures, monkeypatch, right, said
):
    """All of these queries are in the map. So they cannot show that answers deserve a higher confidence."""
    found = asked(
        content, calibrated_at, scan_of_pictures, right=right, bias=np.log(said / (1 - said)), monkeypatch=monkeypatch
    )
    assert (found.offset, found.queries, found.right) == (0.0, 30, right)
    assert found.expected_calibration_error == pytest.approx(abs(right / 30 - said))


def test_confidence_that_was_too_high_is_lowered(content, calibrated_at, scan_of_pictures, monkeypatch):
    """0.9 was stated, 0.5 was right."""
    found = asked(content, calibrated_at, scan_of_pictures, right=15, bias=np.log(9), monkeypatch=monkeypatch)
    assert -np.log(9) < found.offset < -1.0
    assert found.right == 15
    lowered = float(probability(np.array([np.log(9) + found.offset]))[0])
    assert found.expected_calibration_error == pytest.approx(lowered - 0.5)
    assert lowered < 0.75


def test_a_real_map_is_searched_without_the_held_out_places(content, calibrated_at, scan_of_pictures):
    """The tiny map without its true place: the check uses only the other places, which do not resemble the images."""
    told = []
    calibration = calibrated_at(right=np.log(3))
    rest = of_places(content, np.arange(len(content.T_map_place)) != 8)
    found = site_of(lambda: rest, [scan_of_pictures], calibration, lambda *event: told.append(event))
    assert told == [("site check", 1, 1)]
    assert found.queries == 1
    assert found.offset <= 0
    assert len(content.T_map_place) == 12


def test_the_map_is_not_in_memory_while_it_is_read_from_disk(content, calibrated_at, scan_of_pictures):
    """The descriptors that were written are gone when the first query has its answer."""
    written, alive = [], []

    def content_of():
        fresh = replace(content, descriptors=content.descriptors.copy())
        written.append(weakref.ref(fresh.descriptors))
        return fresh

    site_of(content_of, [scan_of_pictures], calibrated_at(right=0.0), lambda *_: alive.append(written[0]()))
    assert len(alive) == 1
    assert alive[0] is None
