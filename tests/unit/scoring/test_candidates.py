from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.rigid import R_BODY_OPTICAL, rotation_y, rotation_z, transform_from
from service.scoring.candidates import distinct_candidates, is_rival, log_shares, support_gaps


@pytest.mark.parametrize(
    ("xyz", "heading_deg", "rival"),
    [((2.9, 0, 1.5), 0, False), ((0, -3.1, 1.5), 0, True), ((2, 2, 3.0), 0, True), ((2, 2, 1.5), 0, False), ((0, 0, 1.5), 29, False),
     ((0, 0, 1.5), -29, False), ((0, 0, 1.5), 31, True), ((0, 0, 1.5), -31, True), ((0, 0, 1.5), 359, False), ((0, 0, 1.5), 180, True)],
)  # fmt: skip
def test_a_rival_stands_three_metres_away_or_looks_thirty_degrees_aside(candidate, xyz, heading_deg, rival):
    here, there = candidate(), candidate(xyz=xyz, heading_deg=heading_deg)
    assert is_rival(here, there) == is_rival(there, here) == rival


@given(st.floats(-180, 180), st.floats(-0.5, 0.5), st.floats(-29.5, 29.5))
def test_whether_it_is_a_rival_does_not_depend_on_how_both_stand(candidate, heading_deg, lean_rad, apart_deg):
    def leaning(degrees):
        R = rotation_z(np.deg2rad(degrees)) @ rotation_y(lean_rad)
        return replace(candidate(), T_map_camera=transform_from(R @ R_BODY_OPTICAL, np.zeros(3)))

    assert not is_rival(leaning(heading_deg), leaning(heading_deg + apart_deg))


def test_of_each_place_the_best_supported_is_kept(candidate):
    best, near, far = candidate(9.0), candidate(8.0, xyz=(1, 0, 1.5)), candidate(7.0, xyz=(20, 0, 1.5))
    back, far_too = candidate(6.0, heading_deg=180), candidate(5.0, xyz=(22, 0, 1.5))
    assert distinct_candidates((best, near, far, back, far_too)) == (best, far, back)
    assert distinct_candidates(()) == ()


@pytest.mark.parametrize(("frames", "gaps"), [(1, [0, 1, 4]), (4, [0, 2, 8])])
def test_support_gaps_grow_with_the_root_of_the_number_of_frames(candidate, frames, gaps):
    supports = [candidate(support, xyz=(20 * k, 0, 1.5)) for k, support in enumerate([10.0, 9.0, 6.0])]
    np.testing.assert_allclose(support_gaps(tuple(supports), frames), gaps)


@given(st.lists(st.floats(0, 700), max_size=8))
def test_shares_add_to_one_and_the_best_one_has_the_most(gaps):
    shares = np.exp(log_shares(np.array([0.0, *gaps])))
    assert shares.sum() == pytest.approx(1.0)
    assert shares[0] == shares.max()
