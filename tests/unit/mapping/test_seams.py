"""How well the tiles of a map agree about the scans that several of them have."""

from pathlib import Path

import numpy as np
import pytest

from model_training.mapping.seams import LARGE_M, Seams, read_positions, seams_of, write_positions


def at(*x_m: float) -> np.ndarray:
    return np.column_stack([x_m, np.zeros((len(x_m), 2))])


def test_the_differences_are_those_of_the_scans_that_several_tiles_have() -> None:
    """Scan 2 is in three tiles, 1 and 4 cm from the first; scan 7 is in two, 2 cm apart; scans 1 and 9 are in one."""
    tiles = [
        (np.array([1, 2]), at(0.0, 10.0)),
        (np.array([2, 7]), at(10.01, 20.0)),
        (np.array([9, 7, 2]), at(30.0, 20.02, 10.04)),
    ]
    found = seams_of(tiles)
    assert found is not None
    assert found.scans == 2
    assert found.median_m == pytest.approx(0.02)
    assert found.largest_m == pytest.approx(0.04)
    assert found.warning is None
    assert str(found) == (
        "tiles: 2 scans are in several tiles; their aligned positions differ by 2.0 cm (median), 4.0 cm at most"
    )


def test_tiles_without_a_common_scan_have_no_seams() -> None:
    assert seams_of([]) is None
    assert seams_of([(np.array([1, 2]), at(0.0, 1.0)), (np.array([3]), at(2.0))]) is None


def test_a_difference_above_five_centimetres_is_a_warning_with_its_remedy() -> None:
    assert Seams(3, 0.0, LARGE_M).warning is None
    warning = Seams(3, 0.01, 0.12).warning
    assert warning is not None
    assert "the tiles disagree by up to 12 cm" in warning
    assert "--tile-m" in warning


def test_positions_come_back_and_a_tile_without_them_has_none(tmp_path: Path) -> None:
    file = tmp_path / "tile.positions.npy"
    assert read_positions(file) is None
    write_positions(file, at(1.0, 2.0))
    np.testing.assert_array_equal(read_positions(file), at(1.0, 2.0))
    assert [each.name for each in tmp_path.iterdir()] == ["tile.positions.npy"]
