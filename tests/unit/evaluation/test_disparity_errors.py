"""Matching errors computed by hand: two scans show a wall, and a depth image of it has a known disparity error."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from model_training.datasets.dataset import (
    CameraSensor,
    Dataset,
    DatasetDescription,
    DepthSpec,
    LidarSensor,
    Sensors,
    query_folder,
    scan_path,
    write_description,
    write_tum,
)
from model_training.evaluation.disparity_errors import OUTLIER_PX, DisparityErrors, disparity_errors, gradient_of
from service.geometry.rigid import R_BODY_OPTICAL, transform_from

WIDTH, HEIGHT, FOCAL, BASELINE_M, WALL_M = 160, 120, 100.0, 0.8, 10.0
FOCAL_BASELINE = FOCAL * BASELINE_M


def recording(folder: Path, *, off_px: float, baseline_m: float | None = BASELINE_M, hole: bool = False) -> Dataset:
    """Make a recording: the camera at x = 0 looks along x at a wall 10 m ahead. Scans at x = 1 and x = -1 show the wall."""
    y, z = np.meshgrid(np.arange(-6, 6, 0.1), np.arange(-4, 4, 0.1))
    scan_path(folder, 0).parent.mkdir(parents=True)
    poses = []
    for k, x in enumerate((1.0, -1.0)):
        points = np.stack([np.full(y.size, WALL_M - x), y.ravel(), z.ravel(), np.zeros(y.size)], axis=1)
        scan_path(folder, k).write_bytes(points.astype(np.float32).tobytes())
        poses.append(transform_from(np.eye(3), np.array([x, 0.0, 0.0])))
    write_tum(folder / "survey" / "poses.txt", np.arange(2.0), np.array(poses))
    queries = query_folder(folder, "recorded")
    for part in ("rgb", "depth"):
        (queries / part).mkdir(parents=True)
    rgb = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
    rgb[:, : WIDTH // 2] = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH // 2, 3), np.uint8)
    cv2.imwrite(str(queries / "rgb" / "000000.png"), rgb)
    depth_m = np.full((HEIGHT, WIDTH), FOCAL_BASELINE / (FOCAL_BASELINE / WALL_M + off_px))
    if hole:
        depth_m[:, : WIDTH // 2] = 0
    cv2.imwrite(str(queries / "depth" / "000000.png"), np.rint(depth_m * 1000).astype(np.uint16))
    write_tum(queries / "poses.txt", np.zeros(1), transform_from(R_BODY_OPTICAL, np.zeros(3))[None])
    lidar = LidarSensor(name="l", channels=64, top_deg=20, bottom_deg=-20, max_range_m=50)
    camera = CameraSensor(
        name="c",
        width=WIDTH,
        height=HEIGHT,
        fx=FOCAL,
        fy=FOCAL,
        cx=79.5,
        cy=59.5,
        depth=DepthSpec(scale_m=0.001, kind="z", baseline_m=baseline_m),
    )
    write_description(
        folder,
        DatasetDescription(name="wall", source={"kind": "test"}, sensors=Sensors(lidars=[lidar], cameras=[camera])),
    )
    return Dataset(folder)


@pytest.mark.parametrize("off_px", [0.0, 1.5, -0.5])
def test_a_depth_error_is_found_as_disparity(tmp_path, off_px):
    found = disparity_errors(recording(tmp_path / "d", off_px=off_px), "recorded")
    assert len(found.error_px) > 1000
    np.testing.assert_allclose(found.error_px, off_px, atol=2e-3)  # whole millimetres at 10 m are 0.001 px
    np.testing.assert_allclose(found.z_m, WALL_M, atol=1e-3)


def test_holes_are_counted_and_left_out_of_the_sizes(tmp_path):
    found = disparity_errors(recording(tmp_path / "d", off_px=1.0, hole=True), "recorded")
    assert found.unmatched(textured=True) > 0.9  # the textured left half has no depth
    assert found.unmatched(textured=False) < 0.1
    np.testing.assert_allclose(found.sizes(textured=False), 1.0, atol=2e-3)


def test_a_recording_without_a_baseline_is_refused(tmp_path):
    with pytest.raises(ValueError, match="baseline"):
        disparity_errors(recording(tmp_path / "d", off_px=0.0, baseline_m=None), "recorded")


def test_a_ramp_has_its_slope_as_gradient():
    """The grey level rises by three per pixel."""
    ramp = np.repeat((np.arange(60, dtype=np.uint8) * 3)[None, :, None], 3, axis=2).repeat(40, axis=0)
    np.testing.assert_allclose(gradient_of(ramp)[20, 20:40], 3.0, atol=0.05)


def errors_of(error_px, z_m=10.0):
    count = len(error_px)
    return DisparityErrors(
        np.asarray(error_px, float),
        np.zeros(count, bool),
        np.full(count, z_m),
        np.zeros(count, np.int64),
        np.arange(count),
    )


def test_outliers_are_counted_in_their_range():
    found = DisparityErrors.joined([errors_of([0, OUTLIER_PX + 1, np.nan]), errors_of([0.0] * 4, z_m=30.0)])
    assert found.outliers(nearest_m=5, farthest_m=20) == 0.5
    assert found.outliers(nearest_m=20, farthest_m=40) == 0.0
    assert np.isnan(found.outliers(nearest_m=40, farthest_m=50))


def test_independent_errors_have_a_short_correlation_and_smoothed_ones_a_long_one():
    """A moving mean over n values has a triangular correlation, 1 - lag / n. It is 1/e at 0.63 n."""
    noise = np.random.default_rng(0).normal(0, 0.5, 40_000)
    assert errors_of(noise).correlation_length_px() < 2
    smooth = np.convolve(noise, np.full(32, 1 / np.sqrt(32)), "valid")
    assert errors_of(smooth).correlation_length_px() == pytest.approx(32 * (1 - np.exp(-1)), rel=0.15)


def test_rows_of_different_recordings_stay_apart():
    found = DisparityErrors.joined([errors_of([1.0, 2.0]), errors_of([3.0])])
    assert found.line.tolist() == [0, 0, 1]
