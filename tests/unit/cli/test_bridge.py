import sys
from pathlib import Path

import pytest

from service.cli.main import main


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(("bridge", *arguments))
    return int(end.value.code or 0)


def test_the_help_names_every_topic(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("ros2", "--help") == 0
    out = capsys.readouterr().out
    for option in (
        "--url",
        "--map",
        "--color-topic",
        "--depth-topic",
        "--info-topic",
        "--pose-topic",
        "--mount",
        "--tf-static-topic",
        "--base-frame",
        "--ground-frame",
        "--camera-height-std-m",
        "--gravity",
        "--imu-topic",
        "--odom-topic",
        "--prior-topic",
        "--prior-age",
        "--rate",
    ):
        assert option in out


def test_bridge_alone_lists_what_it_bridges(capsys: pytest.CaptureFixture[str]) -> None:
    assert run() == 2
    assert "ros2" in "".join(capsys.readouterr())


def test_a_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name in [
        name for name in sys.modules if name.partition(".")[0] == "cyclonedds" or name == "service.bridge.ros2"
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "service.bridge.messages", None)
    monkeypatch.delitem(sys.modules, "service.bridge.messages")
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    assert run("ros2") == 1
    assert 'pip install ".[ros2]"' in capsys.readouterr().err


def test_rclpy_without_ros_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("ros2", "--node", "rclpy") == 1
    assert "source /opt/ros/DISTRIBUTION/setup.bash" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--rate", "-1"], "--rate: -1.0 is not a valid rate"),
        (["--min-confidence", "2"], "--min-confidence: 2.0 is not a valid probability"),
        (["--tolerance", "-1"], "tolerance: -1.0 is not a valid time"),
        (["--mount", "1,2"], "--mount: '1,2' is invalid; give X,Y,Z,QX,QY,QZ,QW"),
        (["--url", "nowhere"], "url: 'nowhere' is not a URL"),
        (["--map", "m", "--map-name", "n"], "--map gives one map"),
    ],
)
def test_invalid_options_are_reported_with_the_remedy(
    capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    assert run("ros2", *arguments) == 1
    assert words in capsys.readouterr().err


def test_a_missing_bundle_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("ros2", "--map", str(tmp_path / "none")) == 1
    assert "none" in capsys.readouterr().err
