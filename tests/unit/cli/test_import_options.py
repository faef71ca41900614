"""Every option of ``streetfix import`` is used or refused, for every format."""

import inspect
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from model_training.cli import import_dataset
from model_training.cli.import_options import SINGLE_FRAMES, kinds
from model_training.importing.kinds import KINDS
from model_training.importing.kitti_object import KittiObjectSummary
from model_training.importing.recording import Notes
from model_training.importing.take import TakeSummary
from model_training.importing.trajectory import Trajectory
from model_training.odometry import find
from service.cli.main import main

#: A value of each option, and the options that it needs.
VALUES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "depth": (("--depth", "lidar"), ()),
    "poses": (("--poses", "poses.txt"), ()),
    "queries": (("--queries", "evening"), ()),
    "pictures": (("--no-pictures",), ()),
    "hold-out": (("--hold-out", "5"), ()),
    "hold-out-first": (("--hold-out-first", "1"), ("--hold-out", "5")),
    "sync": (("--sync", "nearest"), ()),
    "tolerance": (("--tolerance", "0.3"), ()),
    "topic": (("--topic", "scan=/points"), ()),
    "extrinsics": (("--extrinsics", "extrinsics.json"), ()),
    "camera": (("--camera", "camera.json"), ()),
    "baseline-m": (("--baseline-m", "0.12"), ()),
    "align": (("--align",), ()),
    "odometry": (("--odometry",), ()),
    "loops": (("--no-loops",), ("--odometry",)),
    "lidar-height": (("--lidar-height", "1.5"), ("--odometry",)),
    "georeference": (("--georeference", "-33.87,151.21,20,90"), ()),
    "rectified": (("--no-rectified",), ()),
    "deskew": (("--no-deskew",), ()),
    "turn-stamp": (("--turn-stamp", "end"), ()),
    "vertical-correction": (("--no-vertical-correction",), ()),
}
DEPTH_OF_SINGLE_FRAMES = ("--depth", "stored")
TRAJECTORY = Trajectory(np.array([0.0]), np.eye(4)[None], "its own")


@dataclass
class Nothing:
    """A recording without frames."""

    kind: str
    notes: Notes = field(default_factory=Notes)
    has_images: bool = True
    georeference: dict[str, float] | None = None

    def trajectory(self) -> Trajectory:
        return TRAJECTORY


@dataclass
class Found:
    trajectory: Trajectory = TRAJECTORY
    loops: int = 0
    disagreement_m: tuple[float, float] = (0.0, 0.0)


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return what the command does with a recording: the calls of its steps, which do nothing."""
    (tmp_path / "extrinsics.json").write_text(json.dumps({"T_vehicle_lidar": np.eye(4).tolist()}))
    (tmp_path / "camera.json").write_text(json.dumps(dict.fromkeys(("width", "height", "fx", "fy", "cx", "cy"), 8)))
    (tmp_path / "poses.txt").write_text("0 1 2 3 0 0 0 1\n")
    monkeypatch.chdir(tmp_path)
    made = list[Any]()

    def opened(kind: str, source: Path, settings: Any) -> Nothing:
        made.append(("open", repr(settings)))
        return Nothing(kind)

    def turning(recording: Nothing, stamp: str, *, source: str) -> Nothing:
        made.append(("times", stamp, source))
        return recording

    def posed(recording: Nothing, trajectory: Trajectory, *, align: bool | None, report: object) -> Any:
        made.append(("poses", trajectory.name, align))
        return trajectory, None

    def found(recording: Nothing, *, close_loops: bool, expected_height_m: float, report: object) -> Found:
        made.append(("odometry", close_loops, expected_height_m))
        return Found()

    def taken(recording: Nothing, trajectory: Trajectory, out: Path, settings: Any, *, report: object) -> TakeSummary:
        made.append(("take", repr(settings), trajectory.T_map_vehicle.tolist()))
        return TakeSummary(1, 0, 0, 0, (), ())

    def single(source: Path, out: Path, *, depth: str, progress: object) -> KittiObjectSummary:
        made.append(("single frames", depth))
        return KittiObjectSummary(1, 1, 0, 1, ())

    for name, stand_in in (
        ("open_recording", opened),
        ("with_turn_times", turning),
        ("usual_poses", posed),
        ("take", taken),
        ("import_kitti_object", single),
    ):
        monkeypatch.setattr(import_dataset, name, stand_in)
    monkeypatch.setattr(find, "find_trajectory", found)
    return made


def run(kind: str, *options: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(["import", kind, "source", "--out", "out", *options])
    return int(end.value.code or 0)


def takes(kind: str, option: str) -> bool:
    if option == "turn-stamp":
        return kind in ("rosbag", "clouds")
    return option == "depth" if kind == SINGLE_FRAMES else option in KINDS[kind].takes


def test_the_table_has_every_option() -> None:
    parameters = set(inspect.signature(import_dataset.command).parameters) - {"kind", "source", "out"}
    assert {option.replace("-", "_") for option in VALUES} == parameters


@pytest.mark.parametrize("option", VALUES)
@pytest.mark.parametrize("kind", kinds())
def test_an_option_changes_the_import_or_is_refused_with_its_value(
    kind: str, option: str, calls: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    given, needed = VALUES[option]
    if (kind, option) == (SINGLE_FRAMES, "depth"):
        given = DEPTH_OF_SINGLE_FRAMES
    if takes(kind, option):
        assert run(kind, *needed) == 0
        without = calls.copy()
        calls.clear()
        assert run(kind, *needed, *given) == 0
        assert calls != without
    else:
        assert run(kind, *given) == 1
        error = capsys.readouterr().err
        assert f"{' '.join(given)}: {kind} does not use this option; omit it. It is for: " in " ".join(error.split())
        assert calls == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--no-loops",), "--no-loops: it works only with --odometry; give --odometry too, or omit it"),
        (("--lidar-height", "1.5"), "--lidar-height 1.5: it works only with --odometry; give --odometry too"),
        (("--hold-out-first", "1"), "--hold-out-first 1: it works only with --hold-out; give --hold-out too"),
        (("--queries", "x", "--no-pictures"), "--queries x: --no-pictures imports no images; omit one of the two"),
        (("--depth", "lidar", "--no-pictures"), "--depth lidar: --no-pictures imports no images"),
        (("--camera", "camera.json", "--no-pictures"), "--camera camera.json: --no-pictures imports no images"),
        (("--turn-stamp", "end", "--no-deskew"), "--turn-stamp end: --no-deskew needs no times of points; omit one"),
        (("--turn-stamp", "start"), "turn-stamp: 'start' is not valid; choose one of: begin, middle, end"),
        (("--odometry", "--no-align"), "align: --odometry finds poses from the scans alone; give one of the two"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    options: tuple[str, ...], message: str, calls: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("rosbag", *options) == 1
    assert message in " ".join(capsys.readouterr().err.split())
    assert calls == []


def test_lines_about_images_are_printed_only_if_images_are_wanted(
    calls: list[Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    notes = Notes(("a list",), {"path": "drive"}, ("no image has stored depth",))
    monkeypatch.setattr(import_dataset, "open_recording", lambda kind, *_: Nothing(kind, notes))
    assert run("kitti-raw") == 0
    assert "a list\nno image has stored depth\n" in capsys.readouterr().out
    assert run("kitti-raw", "--no-pictures") == 0
    assert "no image has stored depth" not in capsys.readouterr().out


def test_a_georeference_of_the_recording_is_not_replaced_and_does_not_hold_for_odometry(
    calls: list[Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    own = {"latitude_deg": 49.0, "longitude_deg": 8.4, "height_m": 110.0}
    monkeypatch.setattr(import_dataset, "open_recording", lambda kind, *_: Nothing(kind, georeference=own))
    assert run("kitti-raw", "--georeference", "50,8") == 1
    assert "--georeference 50,8: the recording has a georeference of its own poses; omit this option" in " ".join(
        capsys.readouterr().err.split()
    )
    assert run("kitti-raw", "--odometry") == 0
    assert "does not hold for poses by odometry; give that of the first scan with --georeference" in " ".join(
        capsys.readouterr().out.split()
    )
    assert "georeference=None, own_frame=False" in calls[-1][1]
    assert run("kitti-raw", "--odometry", "--georeference", "50,8") == 0
    assert "does not hold" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "deskewed", "line"),
    [
        ((), 3, "3 of 3 scans"),
        (("--no-deskew",), 0, "0 of 3 scans, because --no-deskew was given"),
        (
            (),
            0,
            (
                "0 of 3 scans, because their points have no usable times; unless they are corrected already, record clouds with a time for "
                "each point, or correct them before the import; --turn-stamp gives times to the clouds of a spinning LiDAR (rosbag, clouds)"
            ),
        ),
    ],
)
def test_scans_that_keep_the_motion_have_their_cause(
    options: tuple[str, ...],
    deskewed: int,
    line: str,
    calls: list[Any],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    summary = TakeSummary(2, 1, 0, 0, (), (), deskewed)
    monkeypatch.setattr(import_dataset, "take", lambda *_, **__: summary)
    assert run("rosbag", *options) == 0
    assert f"corrected for the vehicle's motion: {line}" in capsys.readouterr().out.splitlines()


def test_scans_from_images_need_the_camera_without_images_too(calls: list[Any]) -> None:
    assert run("tum-rgbd", "--camera", "camera.json", "--no-pictures") == 0


@pytest.mark.parametrize("options", [("--queries", "evening"), ("--depth", "lidar"), ("--baseline-m", "0.12")])
def test_options_of_images_are_refused_for_a_recording_without_images(
    options: tuple[str, ...],
    calls: list[Any],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(import_dataset, "open_recording", lambda *_: Nothing("rosbag", has_images=False))
    assert run("rosbag", *options) == 1
    error = " ".join(capsys.readouterr().err.split())
    assert f"{' '.join(options)}: source has no images, so this option has no effect; omit it" in error
