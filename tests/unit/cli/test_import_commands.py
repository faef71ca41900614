"""``import``, ``convert`` and ``record`` as a user calls them."""

import os
from pathlib import Path

import numpy as np
import pytest

from model_training.datasets.dataset import Dataset
from service.cli.main import main


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return int(end.value.code or 0)


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    """Write three scan files with poses a metre apart. One file is truncated."""
    folder = tmp_path / "scans"
    folder.mkdir()
    for k in range(4):
        np.full((5, 4), k + 1, np.float32).tofile(folder / f"{k}.bin")
    np.array([[1, 2, 3, 4], [np.nan, 0, 0, 0]], np.float32).tofile(folder / "0.bin")
    (folder / "3.bin").write_bytes(b"cut off")
    (folder / "poses.txt").write_text("".join(f"{0.1 * k} {k} 0 0 0 0 0 1\n" for k in range(4)))
    return folder


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (
            "import",
            ["rosbag", "kitti-raw", "kitti-object", "--hold-out", "--topic", "--extrinsics", "--odometry", "Example:"],
        ),
        ("convert", ["mcap", "kitti-raw", "--queries", "Example:"]),
        ("record", ["carla", "--town", "--weather", "Example:"]),
    ],
)
def test_help_names_formats_options_and_an_example(command, words, capsys, monkeypatch):
    monkeypatch.setitem(os.environ, "COLUMNS", "200")
    assert run(command, "--help") == 0
    told = capsys.readouterr().out
    assert [word for word in words if word not in told] == []


def test_import_says_what_came_in_and_what_did_not(scans, tmp_path, capsys):
    assert run("import", "clouds", scans, "--out", tmp_path / "out", "--hold-out", "2") == 0
    told = capsys.readouterr().out
    assert "4 scans (.bin)" in told
    assert "2 scans (1 held out), 0 image pairs" in told
    assert "left out: 1 points that are not finite" in told
    assert (
        "left out: 1 scan: its size is not a multiple of 16 bytes (rows of four float32): truncated (first: 3.bin)"
        in told
    )
    assert len(Dataset(tmp_path / "out").survey_poses()) == 2


def test_help_says_which_options_need_an_extra(capsys):
    assert run("import", "--help") == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "Needs gtsam and small_gicp, which the extra mapping installs. Without them, the default keeps" in told
    assert "The command ignores the recording's own poses. Needs the extra odometry." in told


def test_import_takes_poses_of_another_file(scans, tmp_path, capsys):
    poses = (scans / "poses.txt").rename(tmp_path / "mine.txt")
    assert run("import", "clouds", scans, "--poses", poses, "--out", tmp_path / "out") == 0
    told = capsys.readouterr().out.replace("\n", " ")
    assert f"poses are those of {poses}; if they err by decimetres, --align corrects them with the scans" in told
    np.testing.assert_allclose(Dataset(tmp_path / "out").survey_poses()[:, 0, 3], [0, 1, 2])


def test_import_without_poses_says_where_they_may_come_from(scans, tmp_path, capsys):
    (scans / "poses.txt").unlink()
    assert run("import", "clouds", scans, "--out", tmp_path / "out") == 1
    assert "has no poses; give a TUM file with --poses, or find them with --odometry" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("rosbag", ("--topic", "scan"), "topic: 'scan' is not ROLE=NAME"),
        ("rosbag", ("--sync", "guess"), "sync: 'guess' is not valid; choose interpolate or nearest"),
        ("carla", ("--depth", "sgbm"), "carla has no 'sgbm' depth"),
        ("clouds", ("--hold-out", "1"), "hold_out: 1 would leave no survey"),
        ("rosbag", ("--extrinsics", "nowhere.json"), "nowhere.json: cannot be read as JSON"),
        ("rosbag", ("--camera", "nowhere.json"), "nowhere.json: not a valid camera"),
        ("clouds", ("--poses", "nowhere.txt"), "nowhere.txt is missing"),
        (
            "clouds",
            ("--poses", "x.txt", "--odometry"),
            "--odometry finds the poses, so --poses has no effect; give one of the two",
        ),
    ],
)
def test_import_refuses_an_option_by_name(scans, tmp_path, capsys, kind, options, message):
    assert run("import", kind, scans, "--out", tmp_path / "out", *options) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_convert_and_import_go_round(scans, tmp_path, capsys):
    run("import", "clouds", scans, "--out", tmp_path / "first")
    assert run("convert", tmp_path / "first", "--to", "mcap", "--out", tmp_path / "drive") == 0
    assert "3 moments, images of: no query set" in capsys.readouterr().out
    assert run("import", "rosbag", tmp_path / "drive", "--topic", "scan=/points", "--out", tmp_path / "second") == 0
    told = capsys.readouterr().out
    assert "scan: /points, 3 x PointCloud2\n" in told
    assert "poses: /odometry, 3 x Odometry (guessed)" in told
    assert "poses are of: base_link" in told
    first, second = Dataset(tmp_path / "first"), Dataset(tmp_path / "second")
    np.testing.assert_allclose(second.survey_poses(), first.survey_poses(), atol=1e-8)
    np.testing.assert_array_equal(second.scan(2), first.scan(2))


def test_convert_refuses_what_it_does_not_know(scans, tmp_path, capsys):
    run("import", "clouds", scans, "--out", tmp_path / "first")
    capsys.readouterr()
    for options, message in (
        (("--to", "ros3"), "to: 'ros3' is not valid; choose one of: mcap, sqlite3, bag, kitti-raw"),
        (("--to", "mcap", "--queries", "evening"), "no query set 'evening'"),
    ):
        assert run("convert", tmp_path / "first", *options, "--out", tmp_path / "drive") == 1
        assert message in capsys.readouterr().err
    assert not (tmp_path / "drive").exists()


def test_record_refuses_what_it_cannot_record_from(tmp_path, capsys):
    assert run("record", "gazebo", "--out", tmp_path / "out") == 1
    assert "kind: 'gazebo' is not a known simulator; choose: carla" in capsys.readouterr().err


def test_record_says_what_comes_next(tmp_path, capsys, monkeypatch):
    from model_training.importing import carla_record

    asked = []

    def recorded(host, port, out, settings, *, report):
        asked.append((host, port, settings.frames, settings.step_s, settings.seed, settings.town, settings.weather))
        report(1, settings.frames)
        return settings.frames

    monkeypatch.setattr(carla_record, "record", recorded)
    options = (
        "--host",
        "there",
        "--port",
        "2222",
        "--frames",
        "5",
        "--step",
        "0.2",
        "--seed",
        "3",
        "--town",
        "Town02",
        "--weather",
        "ClearNoon",
    )
    assert run("record", "carla", "--out", tmp_path / "out", *options) == 0
    assert asked == [("there", 2222, 5, 0.2, 3, "Town02", "ClearNoon")]
    assert f"5 frames; next: streetfix import carla {tmp_path / 'out'}" in capsys.readouterr().out
