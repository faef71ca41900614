"""Tasks that last, fail, or kill their process. Processes import this file as a module of its own name."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from model_training.tasks.job import Share
from service.errors import BundleError


@dataclass(frozen=True, slots=True)
class Work:
    """A task. Its first ``deaths`` processes kill themselves."""

    name: str
    folder: Path
    deaths: int = 0
    lasts_s: float = 0.0
    fails: bool = False


def do(task: Work, share: Share) -> None:
    share(0.25)
    with (task.folder / "order").open("a") as file:
        file.write(task.name)
    if (task.folder / "order").read_text().count(task.name) <= task.deaths:
        os.kill(os.getpid(), signal.SIGKILL)
    if task.fails:
        raise BundleError("the store is full", field="out")
    time.sleep(task.lasts_s)
