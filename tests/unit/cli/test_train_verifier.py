"""``streetfix train-verifier`` as a user calls it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.stock import ENCODER  # after the skip
from model_training.verification.examples import ANSWER, STEPS, Examples
from model_training.verification.made_with import MadeWith
from service.cli.main import main
from service.scoring.comparison import COLUMNS, PLANES, ROWS
from service.scoring.verifier import Verifier

# torch's tracing exporter is deprecated in favour of one that needs a newer runtime than the service has
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning")


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Any:
    """Run the command; return code, stdout and stderr."""

    def called(*arguments: str | Path) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            main(["train-verifier", *(str(argument) for argument in arguments)])
        told = capsys.readouterr()
        return int(end.value.code or 0), " ".join(told.out.split()), " ".join(told.err.split())

    return called


def test_the_help_names_every_option(run: Any) -> None:
    code, told, _ = run("--help")
    assert code == 0
    for option in ("--out", "--work", "--encoder", "--cities", "--epochs", "--rate", "--seed"):
        assert option in told


def test_a_missing_folder_of_the_output_is_said_before_the_work(run: Any, tmp_path: Path) -> None:
    code, _, error = run("--out", tmp_path / "none" / "verifier.onnx", "--work", tmp_path / "work")
    assert code == 1
    assert f"--out: folder {tmp_path / 'none'} not found; create it first" in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("content", "message"), [(None, "the encoder cannot be read"), (b"no network", "cannot load the encoder")]
)
def test_a_bad_encoder_is_said_before_the_work(run: Any, tmp_path: Path, content: bytes | None, message: str) -> None:
    encoder = tmp_path / "encoder.onnx"
    if content is not None:
        encoder.write_bytes(content)
    given = ("--out", tmp_path / "verifier.onnx", "--work", tmp_path / "work", "--encoder", encoder)
    code, _, error = run(*given)
    assert code == 1
    assert message in error
    assert not (tmp_path / "work").exists()


@pytest.mark.parametrize("option", ["--cities", "--epochs"])
def test_a_number_out_of_bounds_is_refused_by_its_option(run: Any, tmp_path: Path, option: str) -> None:
    code, _, error = run("--out", tmp_path / "verifier.onnx", option, "0")
    assert code == 2
    assert f"Invalid value for '{option}'" in error


def test_finished_examples_become_a_verifier(run: Any, tmp_path: Path) -> None:
    """A plane is full where the pose is right. Nothing is simulated, because the examples of both cities are there."""
    rng, made_with, work = np.random.default_rng(0), MadeWith.of(ENCODER), tmp_path / "work"
    work.mkdir()
    for k in range(2):
        error_m = np.where(rng.random(48) < 0.5, 0.3, np.inf).astype(np.float32)
        planes = np.zeros((48, len(PLANES), ROWS, COLUMNS), np.int8)
        planes[error_m < 1] = STEPS
        Examples(planes, error_m, np.full(48, ANSWER, np.uint8)).write(work / f"examples-{k}.npz", made_with)
    out = tmp_path / "verifier.onnx"
    code, told, progress = run("--out", out, "--work", work, "--cities", "2", "--epochs", "2")
    assert code == 0
    assert "MB, loss of the last epoch" in told
    assert "epoch 2 of 2" in progress
    assert Verifier.open(out).log_odds([np.ones((len(PLANES), ROWS, COLUMNS), np.float32)]).shape == (1,)
    assert sorted(path.name for path in work.iterdir()) == ["examples-0.npz", "examples-1.npz"]


def test_examples_of_another_encoder_are_refused_with_the_folder(run: Any, tmp_path: Path) -> None:
    nothing = Examples(
        np.empty((0, len(PLANES), ROWS, COLUMNS), np.int8), np.empty(0, np.float32), np.empty(0, np.uint8)
    )
    nothing.write(tmp_path / "examples-0.npz", MadeWith("0" * 64, MadeWith.of(ENCODER).code, PLANES))
    code, _, error = run("--out", tmp_path / "verifier.onnx", "--work", tmp_path, "--cities", "1")
    assert code == 1
    assert "examples-0.npz comes from another encoder); choose another --work, or remove these files" in error
