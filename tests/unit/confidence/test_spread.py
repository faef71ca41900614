import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.confidence.spread import UNKNOWN_HEADING_RAD, Extent, spread_of
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from

#: A map of 200 m by 20 m.
EXTENT = Extent(np.array([100.0, 0.0, 2.0]), np.diag([3300.0, 33.0, 1.0]))


def pose(x, y=0.0, *, heading_deg=0.0):
    return transform_from(rotation_z(np.deg2rad(heading_deg)) @ R_BODY_OPTICAL, np.array([x, y, 1.5]))


def sure(sigma_m=0.1, heading_rad=0.01):
    return np.diag([sigma_m**2] * 3 + [1e-6, 1e-6, heading_rad**2])


def spread(poses, shares, *, confidence, covariances=None):
    return spread_of(
        poses, covariances or [sure()] * len(poses), np.array(shares), confidence=confidence, extent=EXTENT
    )


def test_two_hypotheses_forty_metres_apart_are_twenty_metres_from_their_middle():
    found = spread([pose(0), pose(40)], [0.5, 0.5], confidence=0.5)
    assert found.hypotheses_weight == 1.0
    np.testing.assert_allclose(found.mean_m, [20, 0, 1.5])
    np.testing.assert_allclose(found.covariance, np.diag([400.01, 0.01, 0.01]), atol=1e-9)


def test_one_hypothesis_that_is_probably_wrong_has_the_size_of_the_map():
    """Found in an evaluation: a single wrong hypothesis stated 0.14 m at an error of 322 m."""
    found = spread([pose(10)], [1.0], confidence=0.02)
    assert found.hypotheses_weight == 0.02
    assert np.sqrt(found.covariance[0, 0]) > 55
    assert found.heading_std_rad == UNKNOWN_HEADING_RAD


def test_without_hypotheses_it_is_the_map():
    found = spread_of([], [], np.zeros(0), confidence=0.0, extent=EXTENT)
    np.testing.assert_allclose(found.mean_m, EXTENT.mean_m)
    np.testing.assert_allclose(found.covariance, EXTENT.covariance)
    assert (found.hypotheses_weight, found.heading_std_rad) == (0.0, UNKNOWN_HEADING_RAD)


def test_headings_go_round_the_circle():
    """20 degrees on both sides of 180 degrees differ from the mean as much as 20 degrees on both sides of 0."""
    across = spread([pose(0, heading_deg=160), pose(0, heading_deg=-160)], [0.5, 0.5], confidence=0.5)
    ahead = spread([pose(0, heading_deg=20), pose(0, heading_deg=-20)], [0.5, 0.5], confidence=0.5)
    assert across.heading_std_rad == pytest.approx(ahead.heading_std_rad)
    assert np.rad2deg(ahead.heading_std_rad) == pytest.approx(20, rel=0.05)
    opposed = spread([pose(0), pose(0, heading_deg=180)], [0.5, 0.5], confidence=0.5)
    assert opposed.heading_std_rad == UNKNOWN_HEADING_RAD


def test_one_certain_hypothesis_is_reported_unchanged():
    found = spread([pose(3, 4, heading_deg=30)], [1.0], confidence=1.0)
    np.testing.assert_allclose(found.mean_m, [3, 4, 1.5])
    np.testing.assert_allclose(found.covariance, 0.01 * np.eye(3), atol=1e-12)
    assert found.heading_std_rad == pytest.approx(0.01, rel=1e-3)


@given(
    xs=st.lists(st.floats(-500, 500), min_size=1, max_size=6),
    supports=st.lists(st.floats(-30, 0), min_size=6, max_size=6),
    confidence=st.floats(0, 1),
)
def test_every_hypothesis_lies_within_what_its_weight_allows(xs, supports, confidence):
    """A component with weight w lies within sqrt((1 - w) / w) standard deviations of the mean, in every direction."""
    shares = np.exp(np.sort(supports[: len(xs)])[::-1])
    shares /= shares.sum()
    found = spread([pose(x) for x in xs], shares, confidence=confidence)
    assert np.isfinite(found.covariance).all()
    assert np.linalg.eigvalsh(found.covariance)[0] > 0
    assert 0 <= found.heading_std_rad <= UNKNOWN_HEADING_RAD
    for x, share in zip(xs, shares, strict=True):
        weight = found.hypotheses_weight * share
        apart = np.array([x, 0.0, 1.5]) - found.mean_m
        assert weight * apart[0] ** 2 <= (1 - weight) * found.covariance[0, 0] + 1e-6


def test_places_of_a_map_stand_for_their_surroundings():
    places_m = np.array([[0.0, 0, 2], [10.0, 0, 2]])
    extent = Extent.of_places(places_m, 3.0)
    np.testing.assert_allclose(extent.mean_m, [5, 0, 2])
    np.testing.assert_allclose(extent.covariance, np.diag([25.0 + 9, 9, 9]))
    np.testing.assert_allclose(Extent.of_places(places_m[:1], 0.0).covariance, np.eye(3))
