"""Train in one process or under torchrun, and write the loss of every step.

Example, two processes:
  python -m torch.distributed.run --standalone --nproc-per-node 2 -m benchmarks.loss_curve --run runs/two --packs PACK \
    --config config.json --out two.json
"""

import argparse
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model_training.training.loop import Progress, TrainingConfig, device_of, train
from model_training.training.processes import joined


def loss_gap(one: NDArray[np.float64], other: NDArray[np.float64], *, window: int = 1) -> float:
    """Return the greatest relative difference of two loss curves.

    Args:
        one: loss of every step (N,).
        other: loss of every step (N,).
        window: steps of a running mean of both curves, at most N.
    """
    means = [np.convolve(curve, np.full(window, 1 / window), mode="valid") for curve in (one, other)]
    return float(np.max(np.abs(means[1] - means[0]) / means[0]))


def main() -> None:
    """Parse the arguments, train, and write the losses."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True, help="folder of the run")
    parser.add_argument("--packs", type=Path, nargs="+", required=True, help="folders of the training cities")
    parser.add_argument("--config", type=Path, required=True, help="file with the fields of TrainingConfig")
    parser.add_argument("--save-every", type=int, default=200, help="steps between checkpoints")
    parser.add_argument("--device", default="cpu", help="auto, cpu or cuda")
    parser.add_argument("--out", type=Path, required=True, help="file to write: a list with the loss of every step")
    arguments = parser.parse_args()
    config = TrainingConfig.model_validate_json(arguments.config.read_bytes())
    losses: list[float] = []

    def note(progress: Progress) -> None:
        losses.append(progress.loss)

    with joined(device_of(arguments.device)) as together:
        train(
            arguments.packs,
            arguments.run,
            config,
            device=arguments.device,
            save_every=arguments.save_every,
            report=note,
            together=together,
        )
        if together.is_first:
            arguments.out.write_text(json.dumps(losses) + "\n")


if __name__ == "__main__":
    main()
