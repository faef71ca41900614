import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest


class Ape(NamedTuple):
    """The output of ``evo_ape`` for the translations of two trajectories. It associates ``pairs`` of poses by time."""

    rmse_m: float
    pairs: int


@pytest.fixture
def evo_ape(tmp_path: Path) -> Callable[..., Ape]:
    """Run ``evo_ape tum TRUE ANSWERED`` with further options."""
    beside = Path(sys.executable).with_name("evo_ape")
    program = str(beside) if beside.exists() else shutil.which("evo_ape")
    if program is None:
        pytest.skip("evo_ape is not installed; it is in the dependency group `oracle` of pyproject.toml")

    def run(true: Path, answered: Path, *options: str) -> Ape:
        # evo keeps its settings in the home folder: it gets one of its own.
        done = subprocess.run(
            [program, "tum", str(true), str(answered), "--pose_relation", "trans_part", "--verbose", *options],
            cwd=tmp_path,
            env=os.environ | {"HOME": str(tmp_path)},
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        error, count = re.search(r"rmse\s+([\d.]+)", done.stdout), re.search(r"Compared (\d+)", done.stdout)
        assert error is not None
        assert count is not None
        return Ape(float(error[1]), int(count[1]))

    return run
