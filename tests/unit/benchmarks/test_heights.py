"""Errors of camera heights: estimated by the service, and given by the caller."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.heights import LIDAR_M, height_error_rows, height_errors
from benchmarks.report import Report
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(160, 120, 80.0, 80.0, 79.5, 59.5)


class Flat:
    """A dataset with one query of a level camera over flat ground, or over no ground. The scan's origin is LIDAR_M above the ground."""

    folder = "flat"

    def __init__(self, height_m, *, ground=True, truth=True):
        rays = CAMERA.rays_of_pixels()
        with np.errstate(divide="ignore"):
            z = np.where(rays[..., 1] > 0, height_m / rays[..., 1], 0.0)
        self._depth_m = np.where((z < 30) & ground, z, 0.0).astype(np.float32)
        self._T = np.eye(4)
        self._T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # optical frame: z ahead, y down
        self._T[2, 3] = height_m
        self._truth = truth

    def survey_poses(self):
        T = np.eye(4)[None].repeat(2, axis=0)
        T[:, 2, 3], T[1, 0, 3] = LIDAR_M, 50.0
        return T

    def queries(self, _name):
        camera = SimpleNamespace(pinhole=lambda: CAMERA)
        yield SimpleNamespace(
            T_map_camera=self._T if self._truth else None, depth_m=lambda: self._depth_m, camera=camera
        )


def flat(height_m, **more) -> Any:
    """Return a ``Flat`` in place of a dataset."""
    return Flat(height_m, **more)


def test_an_estimated_height_is_that_of_the_ground_in_the_image():
    assert height_errors(flat(0.8), ("level",)) == pytest.approx([0.0], abs=0.02)


def test_without_ground_a_given_height_counts_and_else_the_usual_one():
    """The camera is 0.8 m high. The usual height is 1.5 m, and the caller says 0.9 m."""
    assert height_errors(flat(0.8, ground=False), ("level",)) == pytest.approx([0.7])
    assert height_errors(flat(0.8, ground=False), ("level",), told_m=0.9) == pytest.approx([0.1])


def test_a_query_without_a_true_pose_is_refused():
    with pytest.raises(DatasetError, match="flat: a query has no true pose"):
        height_errors(flat(0.8, truth=False), ("level",))


def test_the_bar_counts_for_estimated_and_given_heights(tmp_path):
    """Medians: estimated 0.02 and 0.03 m, of both 0.025 m; given 0.06 m at both heights."""
    report = Report("x", "x", folder=tmp_path)
    seen = {0.4: np.array([0.01, 0.02, 0.03]), 1.5: np.array([0.02, 0.03, 0.04])}
    told = {0.4: np.array([0.06]), 1.5: np.array([0.06])}
    height_error_rows(report, seen, told)
    rows = {row["id"]: row for row in report.rows}
    assert {name: (row["value"], row["n"]) for name, row in rows.items()} == {
        "height.0.4.error_m": (0.02, 3),
        "height.1.5.error_m": (0.03, 3),
        "height.seen_error_m": (0.025, 6),
        "height.0.4.given.error_m": (0.06, 1),
        "height.1.5.given.error_m": (0.06, 1),
        "height.told_error_m": (0.06, 2),
        "height.told_or_seen_error_m": (0.06, 8),
    }
    assert not rows["height.told_or_seen_error_m"]["holds"]
    assert rows["height.told_or_seen_error_m"]["why"].endswith(": told")
