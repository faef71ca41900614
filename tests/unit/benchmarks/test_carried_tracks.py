"""Robots that carry their track: their answers beside those of a track that the service holds, and the size of the bytes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import tracks as rows
from benchmarks.carried_tracks import carried, equal
from benchmarks.report import Report
from model_training.evaluation.tracks import Step, Tracks, followed
from service.geometry.rigid import transform_from
from service.localization.localizer import Localizer
from service.localization.track_bytes import MOST_BYTES
from service.maps.reader import MapBundle
from service.maps.writer import write_bundle
from service.retrieval.query import Query

LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
AHEAD = transform_from(np.eye(3), np.array([0.0, 0.0, 1.0]))
MAC_BYTES = 32
#: Bytes of a track: what comes before the modes, and a mode.
HEAD_BYTES, MODE_BYTES = 38, 150


class Shown:
    """A frame with given images."""

    def __init__(self, T_map_camera: np.ndarray, pictures: Any) -> None:
        self.T_map_camera, self._pictures = T_map_camera, pictures

    def query(self, _grid: Any) -> Query:
        rgb, depth_m, camera = self._pictures
        return Query(rgb=rgb, depth_m=depth_m, camera=camera)


@pytest.fixture(scope="module")
def bundle(
    content_of: Callable[..., Any], constant_calibration: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory
) -> MapBundle:
    """Its calibration gives one frame a confidence of 0.8, below the threshold of 0.9."""
    folder: Path = tmp_path_factory.mktemp("carried") / "tiny"
    write_bundle(folder, content_of(calibration=constant_calibration(right=0.8, known=0.95, threshold=0.9)))
    return MapBundle.open(folder)


@pytest.fixture
def drive(bundle: MapBundle, pictures: Any) -> list[Step]:
    """Three frames at one place. The odometry says 1 m each, which lies within the uncertainty of a pose."""
    rgb, depth_m, camera = pictures
    x, y = Localizer.open(bundle).localize(Query(rgb=rgb, depth_m=depth_m, camera=camera)).T_map_camera_guess[:2, 3]
    shown: Any = Shown(transform_from(LEVEL, np.array([x, y, 1.5])), pictures)
    return [Step(shown, None), Step(shown, AHEAD), Step(shown, AHEAD)]


def test_a_carried_track_gives_the_answers_of_a_held_one_where_that_registers_one_frame(
    bundle: MapBundle, drive: list[Step]
) -> None:
    """The images stand still and the odometry does not. So a pose of several frames lies elsewhere than that of the newest one."""
    localizer, told = Localizer.open(bundle), []
    lost = [drive[0], replace(drive[1], T_previous_camera=None), drive[2]]
    found = carried(localizer, [drive, lost], lambda _, done, __: told.append(done))
    held = followed(localizer, [drive, lost])
    assert found.tracks.accepted.tolist() == held.accepted.tolist() == [[False, True, True], [False, False, True]]
    assert found.tracks.epoch.tolist() == held.epoch.tolist() == [[0, 0, 0], [0, 0, 0]]
    assert (found.tracks.frames.tolist(), held.frames.tolist()) == ([[1, 1, 1], [1, 1, 1]], [[1, 2, 3], [1, 1, 2]])
    assert equal(found.tracks, held).tolist() == [[True, False, False], [True, True, False]]
    assert told == [1, 2]


def test_the_size_is_that_of_the_sealed_modes(bundle: MapBundle, drive: list[Step]) -> None:
    sizes = carried(Localizer.open(bundle), [drive]).sizes
    modes = (sizes - MAC_BYTES - HEAD_BYTES) / MODE_BYTES
    assert (modes == np.floor(modes)).all()
    assert (modes >= 1).all()
    assert (sizes <= MAC_BYTES + MOST_BYTES).all()


def test_after_a_frame_without_depth_the_odometry_refers_to_the_last_answer(
    bundle: MapBundle, drive: list[Step], pictures: Any
) -> None:
    rgb, depth_m, camera = pictures
    blind: Any = Shown(drive[0].frame.T_map_camera, (rgb, np.zeros_like(depth_m), camera))  # type: ignore[arg-type]
    half = transform_from(np.eye(3), np.array([0.0, 0.0, 0.5]))
    first, second = drive[:2]
    found = carried(Localizer.open(bundle), [[first, Step(blind, half), replace(second, T_previous_camera=half)]])
    direct = carried(Localizer.open(bundle), [[first, second]])
    assert found.tracks.accepted.tolist() == [[False, False, True]]
    assert found.tracks.error_m[0, [0, 2]] == pytest.approx(direct.tracks.error_m[0])
    assert (np.isinf(found.tracks.error_m).tolist(), found.sizes[0, 1]) == ([[False, True, False]], 0)


def tracks(accepted: list[bool], error_m: list[float], epoch: list[int]) -> Tracks:
    return Tracks(np.array([accepted]), np.array([error_m]), np.array([epoch]), np.ones((1, len(epoch)), np.int64))


def test_answers_are_equal_in_status_epoch_and_error() -> None:
    one = tracks([True] * 5, [0.5, 0.5, 0.5, 0.5, np.inf], [0] * 5)
    other = tracks([True, False, True, True, True], [0.5009, 0.5, 0.5, 0.502, np.inf], [0, 0, 1, 0, 0])
    assert equal(one, other).tolist() == [[True, False, False, False, True]]


def test_the_rows_of_a_carried_track(bundle: MapBundle, drive: list[Step]) -> None:
    report = Report("accuracy", "none")
    rows._carried_rows(report, bundle, [drive, drive], followed(Localizer.open(bundle), [drive, drive]))
    found = {row["id"]: (row["value"], row["n"]) for row in report.rows}
    sizes = carried(Localizer.open(bundle), [drive]).sizes
    assert found == {
        "filter.carried.last_frame": (1.0, 2),
        "filter.carried.wrong_and_accepted": (0.0, 6),
        "filter.carried.equal_answers": (pytest.approx(1 / 3), 6),
        "filter.carried.equal_answers_alone": (1.0, 2),
        "filter.carried.equal_status": (1.0, 6),
        "filter.carried.largest_bytes": (float(sizes.max()), 6),
        "filter.carried.median_bytes": (float(np.median(sizes)), 6),
    }
