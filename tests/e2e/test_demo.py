"""The demo as a user runs it: processes of their own, real sockets. An untrained encoder: only the road counts here."""

import os
import re
import shlex
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
KITTI = ROOT.parent / "shared" / "data" / "kitti_stereo" / "training"
COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()"]
# Plain output, as in a continuous integration's log.
ENVIRONMENT = {name: value for name, value in os.environ.items() if name not in ("FORCE_COLOR", "COLUMNS")}


@pytest.fixture(scope="module")
def arguments(encoder_of: Callable[..., bytes], tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("demo")
    (folder / "encoder.onnx").write_bytes(encoder_of())
    return [
        *COMMAND,
        "demo",
        "--streets",
        "3",
        "--queries",
        "3",
        "--encoder",
        str(folder / "encoder.onnx"),
        "--out",
        str(folder / "out"),
    ]


def run(arguments: list[str]) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        arguments, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, timeout=300, env=ENVIRONMENT
    )


@pytest.fixture(scope="module")
def once(arguments: list[str]) -> str:
    """What is printed with ``--once``."""
    done = run([*arguments, "--once"])
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_each_answer_is_shown_beside_the_truth(once: str) -> None:
    rows = re.findall(
        r"^│ (\d) +│ .+ │ (?:Street 3|no street) +│ (?:right|wrong)? *│ +\d+\.\d\d m │$", once, re.MULTILINE
    )
    assert rows == ["1", "2", "3"]
    assert re.search(r"^[0-3] of [1-3] streets right$", once, re.MULTILINE)
    in_one_line = " ".join(once.split())
    assert re.search(
        r"position off by \d+\.\d\d m \(median\), \d+\.\d\d m \(largest\); [0-3] of [1-3] over 1 m", in_one_line
    )


def test_with_once_it_says_how_to_serve_again(once: str) -> None:
    assert re.search(r"streetfix serve \S+/out/map --samples \S+/out/samples$", once, re.MULTILINE)


@pytest.fixture
def serving(arguments: list[str], once: str) -> Iterator[tuple["subprocess.Popen[str]", str, str]]:
    """A demo that goes on serving over what ``once`` made: process, address, and what it printed."""
    process = subprocess.Popen(
        arguments,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
        preexec_fn=_mind_ctrl_c,
    )
    assert process.stdout is not None
    printed = ""
    for line in process.stdout:
        printed += line
        if found := re.search(r"^serving at (http://\S+)", line):
            break
    else:
        raise AssertionError(process.communicate())
    yield process, found[1], printed
    process.terminate()  # not kill: it takes its service with it
    process.communicate(timeout=30)


def _mind_ctrl_c() -> None:
    """A test run in the background is started with Ctrl-C ignored, and would hand that on."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def is_listening(url: str) -> bool:
    try:
        socket.create_connection(("127.0.0.1", int(url.rsplit(":", 1)[1])), timeout=10).close()
    except ConnectionRefusedError:
        return False
    return True


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_goes_on_serving_until_it_is_told_to_stop(
    serving: tuple["subprocess.Popen[str]", str, str], number: signal.Signals
) -> None:
    process, url, _ = serving
    assert is_listening(url)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    # The signal may come while the last lines are being printed, which then come again.
    assert (process.returncode, out.endswith("stopped\n"), "Traceback" in err) == (0, True, False)
    assert not is_listening(url)


def test_what_was_made_is_used_again_and_the_command_it_names_works(
    serving: tuple["subprocess.Popen[str]", str, str],
) -> None:
    process, _, printed = serving
    command = re.search(r"^  \S+ (localize --url .+)$", printed, re.MULTILINE)
    assert command is not None
    answered = run([*COMMAND, *shlex.split(command[1]), "--json"])
    assert answered.returncode == 0, answered.stderr
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert not any(stage in err for stage in ("survey", "queries", "places"))


def test_another_plan_in_the_same_folder_is_refused(arguments: list[str], once: str) -> None:
    done = run([*arguments, "--seed", "5", "--once"])
    assert done.returncode == 1
    assert "contains the simulation of another plan" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_missing_encoder_is_told_before_anything_is_made(tmp_path: Path) -> None:
    done = run([*COMMAND, "demo", "--encoder", str(tmp_path / "none.onnx"), "--out", str(tmp_path / "out"), "--once"])
    assert done.returncode == 1
    assert "make encoder" in done.stderr
    assert not (tmp_path / "out").exists()


def test_real_frames_are_asked_each_with_its_own_camera(encoder_of: Callable[..., bytes], tmp_path: Path) -> None:
    if not KITTI.is_dir():
        pytest.skip(f"the recorded frames are not there: {KITTI}")
    for name, kinds in {"000001": ("image_2", "image_3", "velodyne", "calib"), "000107": ("velodyne",)}.items():
        for kind in kinds:
            (tmp_path / "source" / kind).mkdir(parents=True, exist_ok=True)
            file = next((KITTI / kind).glob(f"{name}.*"))
            (tmp_path / "source" / kind / file.name).symlink_to(file)
    (tmp_path / "encoder.onnx").write_bytes(encoder_of())
    arguments = [
        *COMMAND,
        "demo",
        "--encoder",
        str(tmp_path / "encoder.onnx"),
        "--out",
        str(tmp_path / "out"),
        "--once",
    ]
    done = run([*arguments, "--real", str(tmp_path / "source")])
    assert done.returncode == 0, done.stderr
    assert re.search(r"^│ 000001 │ (000001|000107) ", done.stdout, re.MULTILINE)
    assert re.search(r"^[01] of 1 first places right$", done.stdout, re.MULTILINE)
    elsewhere = run([*arguments, "--real", str(tmp_path)])
    assert (elsewhere.returncode, "was imported from another source" in elsewhere.stderr) == (1, True)
