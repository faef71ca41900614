import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from research.baselines.paper_data.picture25d import REACH_M, SIZE, aligned_heading, picture_from_above
from service.geometry.rigid import rotation_z


def street_scan() -> NDArray[np.float64]:
    """Return two walls along x, 10 m apart, and ground. The left wall is longer ahead."""
    rng = np.random.default_rng(3)
    left = np.c_[rng.uniform(-20, 40, 3000), np.full(3000, 5.0), rng.uniform(-1.8, 4, 3000)]
    right = np.c_[rng.uniform(-20, 25, 2000), np.full(2000, -5.0), rng.uniform(-1.8, 4, 2000)]
    ground = np.c_[rng.uniform(-20, 30, 2000), rng.uniform(-5, 5, 2000), np.full(2000, -1.8)]
    return np.concatenate([left, right, ground])


def test_a_point_lands_in_its_cell_with_its_height() -> None:
    ground = np.c_[np.linspace(-30, 30, 200), np.full(200, -20.0), np.zeros(200)]
    picture = picture_from_above(np.concatenate([ground, [[10.0, 20.0, 6.0]]]), aligned=False)

    row, column = int((REACH_M - 10.0) * SIZE / 100), int((REACH_M - 20.0) * SIZE / 100)
    assert picture[row, column] == round(1 + 6.0 * 254 / 12)
    assert picture[0, 0] == 0


def test_the_highest_return_of_a_cell_is_drawn() -> None:
    ground = np.c_[np.linspace(-30, 30, 200), np.full(200, -20.0), np.zeros(200)]
    low, high = [[10.0, 20.0, 3.0]], [[10.0, 20.0, 6.0]]

    both = picture_from_above(np.concatenate([ground, high, low]), aligned=False)

    assert (both == picture_from_above(np.concatenate([ground, low, high]), aligned=False)).all()
    assert both.max() == round(1 + 6.0 * 254 / 12)


@given(st.floats(min_value=-3.1, max_value=3.1))
def test_pca_takes_the_vehicle_s_heading_out(turn_rad: float) -> None:
    scan = street_scan()
    turned = scan @ rotation_z(turn_rad).T

    still = aligned_heading(scan)

    assert np.cos(aligned_heading(turned) - still - turn_rad) == pytest.approx(1.0, abs=1e-9)


def test_an_aligned_picture_looks_the_same_from_any_heading_and_a_plain_one_does_not() -> None:
    scan = street_scan()
    turned = scan @ rotation_z(1.0).T

    def alike(aligned: bool) -> float:
        a, b = (picture_from_above(each, aligned=aligned) > 0 for each in (scan, turned))
        return float((a & b).sum() / (a | b).sum())

    assert alike(aligned=True) > 0.7
    assert alike(aligned=False) < 0.2


def test_a_frame_without_returns_is_black() -> None:
    assert not picture_from_above(np.zeros((0, 3)), aligned=True).any()
