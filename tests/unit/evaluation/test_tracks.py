"""Drives for tracks: odometry between frames, and robots that are carried away."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from model_training.evaluation.tracks import Tracks, displaced, followed, steps_of
from service.geometry.rigid import inverse, transform_from
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.retrieval.query import Query

LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class Shown:
    """A frame with given images."""

    def __init__(self, T_map_camera: np.ndarray, pictures: Any = None) -> None:
        self.T_map_camera, self._pictures = T_map_camera, pictures

    def query(self, _grid: Any) -> Query:
        rgb, depth_m, camera = self._pictures
        return Query(rgb=rgb, depth_m=depth_m, camera=camera)


def at(x: float, pictures: Any = None) -> Any:
    return Shown(transform_from(LEVEL, np.array([x, 0.0, 1.5])), pictures)


def test_the_odometry_is_the_true_step_with_small_errors():
    steps = steps_of([at(0.0), at(2.0), at(4.0)], np.random.default_rng(1))
    assert steps[0].T_previous_camera is None
    for step in steps[1:]:
        assert step.T_previous_camera is not None
        np.testing.assert_allclose(step.T_previous_camera[:3, 3], [0, 0, 2], atol=5 * 0.01 * 2)
        assert not np.allclose(step.T_previous_camera, inverse(at(0.0).T_map_camera) @ at(2.0).T_map_camera)


def test_a_carried_robot_goes_on_with_another_drive_and_reports_a_step_ahead():
    drives = [steps_of([at(x), at(x + 1), at(x + 2)], np.random.default_rng(1)) for x in (0.0, 100.0)]
    carried = displaced(drives, 2, step_m=1.5)
    places = [
        [step.frame.T_map_camera[0, 3] for step in drive if step.frame.T_map_camera is not None] for drive in carried
    ]
    assert places == [
        [0, 1, 100, 101, 102],
        [100, 101, 0, 1, 2],
    ]
    jump = carried[0][2].T_previous_camera
    assert jump is not None
    np.testing.assert_array_equal(jump[:3, 3], [0, 0, 1.5])


def test_answers_are_compared_with_the_truth(bundle_path: Path, pictures: Any):
    """The map has no calibration, so all answers are LOCALIZED; the true pose of the second robot is 5 m off."""
    localizer = Localizer.open(MapBundle.open(bundle_path))
    rgb, depth_m, camera = pictures
    x, y = localizer.localize(Query(rgb=rgb, depth_m=depth_m, camera=camera)).T_map_camera_guess[:2, 3]
    true = transform_from(LEVEL, np.array([x, y, 1.5]))
    far = transform_from(LEVEL, np.array([x + 5.0, y, 1.5]))
    told: list[int] = []
    found = followed(
        localizer,
        [steps_of([Shown(T, pictures), Shown(T, pictures)], np.random.default_rng(1)) for T in (true, far)],  # type: ignore[list-item]
        lambda _, done, __: told.append(done),
    )
    np.testing.assert_array_equal(found.right(1.0), [[True, True], [False, False]])
    np.testing.assert_array_equal(found.wrong(1.0), [[False, False], [True, True]])
    assert found.error_m[1, 0] == pytest.approx(5.0)
    assert (found.frames.tolist(), told) == ([[1, 1], [1, 1]], [1, 2])


def test_a_refused_answer_is_neither_right_nor_wrong():
    found = Tracks(np.array([[False, True]]), np.array([[0.1, 3.0]]), np.zeros((1, 2), int), np.ones((1, 2), int))
    assert found.right(1.0).tolist() == [[False, False]]
    assert found.wrong(1.0).tolist() == [[False, True]]
