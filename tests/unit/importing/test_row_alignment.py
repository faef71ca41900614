"""Rows of a stereo pair: a known rotation of the right camera is found and removed."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model_training.importing.row_alignment import RowAlignment, matched_features, row_alignment
from service.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(480, 200, 300.0, 300.0, 239.5, 99.5)
DISPARITY_PX = 9.0


def texture(seed: int) -> np.ndarray:
    """Return an image of blurred noise in three scales, which gives many features."""
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.normal(size=(200 // step + 2, 480 // step + 2)), (480, 200), interpolation=cv2.INTER_CUBIC)
        * step
        for step in (3, 6, 12)
    ]
    image = np.sum(layers, axis=0)
    grey = np.clip(128 + 60 * (image - image.mean()) / image.std(), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def pair(pitch_rad: float, roll_rad: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return a plane at one depth, seen by a right camera with a small rotation: row v of the left image appears at v + rows."""
    left = texture(seed)
    v, u = np.mgrid[:200, :480].astype(np.float64)
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    rows = CAMERA.fy * ((1 + y**2) * pitch_rad + x * roll_rad)
    right = cv2.remap(
        left,
        (u + DISPARITY_PX).astype(np.float32),
        (v - rows).astype(np.float32),
        cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REFLECT,
    )
    return left, right


def test_rows_of_hand_computed_rotations() -> None:
    """At the centre of a camera of 300 px, 1 mrad of pitch is 0.3 px. At x = 0.5, 2 mrad of roll are 0.3 px."""
    u, v = np.array([239.5, 389.5]), np.array([99.5, 99.5])
    assert RowAlignment(1e-3, 0.0, 500).rows_px(u, v, CAMERA) == pytest.approx([0.3, 0.3])
    assert RowAlignment(0.0, 2e-3, 500).rows_px(u, v, CAMERA) == pytest.approx([0.0, 0.3])


@settings(max_examples=8, deadline=None)
@given(st.floats(-0.004, 0.004), st.floats(-0.004, 0.004))
def test_a_small_rotation_is_found_and_removed(pitch_rad: float, roll_rad: float) -> None:
    pairs = [pair(pitch_rad, roll_rad, seed) for seed in range(2)]
    found = row_alignment(pairs, CAMERA)
    assert found is not None
    assert found.pitch_rad == pytest.approx(pitch_rad, abs=2e-4)
    assert found.roll_rad == pytest.approx(roll_rad, abs=4e-4)
    left, right = pairs[0]
    matches = matched_features(left, found.aligned(right, CAMERA))
    assert abs(np.median(matches[:, 3] - matches[:, 1])) < 0.08


def test_false_matches_do_not_change_the_alignment() -> None:
    """A quarter of the pairs comes from another rig; the robust loss ignores their rows."""
    good = [pair(0.001, 0.0, seed) for seed in range(3)]
    found = row_alignment([*good, pair(-0.006, 0.0, 9)], CAMERA)
    assert found is not None
    assert found.pitch_rad == pytest.approx(0.001, abs=2e-4)


def test_images_without_features_give_no_alignment() -> None:
    flat = np.full((200, 480, 3), 90, np.uint8)
    assert matched_features(flat, flat).shape == (0, 4)
    assert row_alignment([(flat, flat)], CAMERA) is None
    assert row_alignment([], CAMERA) is None


def test_alignment_keeps_the_size_and_a_perfect_pair() -> None:
    left, right = pair(0.0, 0.0)
    same = RowAlignment(0.0, 0.0, 500).aligned(right, CAMERA)
    assert same.dtype == np.uint8
    assert np.array_equal(same, right)
    assert left.shape == same.shape
