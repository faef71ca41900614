"""A training that stops at given steps, so that a test can add and kill machines there. torchrun starts it.

The first process appends a line for each step: number of processes, step, loss. It then waits if ``hold-PROCESSES-STEP`` is in the
folder, until that file is gone.
"""

import json
import sys
import time
from pathlib import Path

from model_training.training.loop import Progress, TrainingConfig, device_of, train
from model_training.training.processes import joined


def main(folder: Path, pack: Path) -> None:
    config = TrainingConfig.model_validate_json((folder / "config.json").read_bytes())
    with joined(device_of("cpu")) as together, (folder / "steps.jsonl").open("a") as steps:

        def note(progress: Progress) -> None:
            steps.write(json.dumps([together.count, progress.step, progress.loss]) + "\n")
            steps.flush()
            while (folder / f"hold-{together.count}-{progress.step}").exists():
                time.sleep(0.02)

        train([pack], folder / "run", config, device="cpu", save_every=3, report=note, together=together)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
