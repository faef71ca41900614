"""Shared parts of the learned baselines: a budget of processor time, a training curve, and checkpoints.

The budget counts processor time of all threads. Other work on the machine and pauses therefore do not change it.
"""

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from service.errors import DatasetError

CURVE = "curve.jsonl"
#: Share of a budget during which the learning rate rises.
WARM_UP = 0.02


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """State of a training at a point of its curve.

    Attributes:
        images: images shown so far.
        processor_s: processor time so far, seconds.
        loss: mean loss since the previous point.
        score: validation score of the method on held-out frames of the training traversal; larger is better.
    """

    images: int
    processor_s: float
    loss: float
    score: float


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch with one thread inside the block: two threads spend more processor time on waiting than they save.

    Measured with other work on two cores: 28.7 training images of 112 x 112 per second of processor time with one
    thread, 14.6 with two.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def cosine_share(share_spent: float, *, warm_up: float = 0.0, least: float = 0.01) -> float:
    """Return the factor of the learning rate: a linear rise, then half a cosine down to ``least``.

    Args:
        share_spent: spent share of the budget, 0 to 1.
        warm_up: share of the budget for the rise.
        least: smallest factor.
    """
    if share_spent < warm_up:
        return max(share_spent / warm_up, least)
    done = (share_spent - warm_up) / (1.0 - warm_up)
    return least + (1.0 - least) * 0.5 * (1.0 + math.cos(math.pi * done))


def set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of all groups, multiplied by a group's ``times`` if it has one.

    Args:
        optimiser: optimiser to change.
        rate: learning rate.
    """
    for group in optimiser.param_groups:
        group["lr"] = rate * group.get("times", 1.0)


def rests(scores: Sequence[float], patience: int) -> int:
    """Count the plateaus of a score: ``patience`` values in a row without a new best; the count restarts after each.

    Args:
        scores: scores in their order.
        patience: length of a plateau.
    """
    best, since, count = -math.inf, 0, 0
    for score in scores:
        best, since = (score, 0) if score > best else (best, since + 1)
        if since == patience:
            since, count = 0, count + 1
    return count


class Training:
    """The folder of a run: settings, curve and last checkpoint.

    The settings are kept beside the checkpoint, and a folder of other settings is refused. The budget is not a setting:
    a run that ended at a budget continues with a larger one. With ``drops``, a run continues at a lower rate after each
    plateau (``rests_so_far``). It ends at the plateau after the last drop.

    Args:
        folder: folder of the run.
        settings: settings of the training, plain JSON values.
        budget_s: budget, processor seconds.
        patience: points without a new best score that make a plateau.
        drops: number of plateaus after which the run continues.

    Raises:
        DatasetError: the folder belongs to other settings.
    """

    def __init__(
        self, folder: Path, settings: Mapping[str, Any], *, budget_s: float, patience: int = 6, drops: int = 0
    ) -> None:
        self.folder, self._budget_s, self._patience, self._drops = folder, budget_s, patience, drops
        folder.mkdir(parents=True, exist_ok=True)
        kept, text = folder / "settings.json", json.dumps(dict(settings), indent=1, sort_keys=True) + "\n"
        if kept.exists() and kept.read_text() != text:
            raise DatasetError(f"{kept} has other settings; remove {folder} to train again", field="settings")
        kept.write_text(text)
        self.curve = read_curve(folder / CURVE)
        self._spent_before = self.curve[-1].processor_s if self.curve else 0.0
        self._began = time.process_time()

    @property
    def processor_s(self) -> float:
        """Processor time of the run, seconds; of earlier processes it counts the time up to their last saved point."""
        return self._spent_before + time.process_time() - self._began

    @property
    def images(self) -> int:
        """Images shown up to the last point."""
        return self.curve[-1].images if self.curve else 0

    @property
    def share_spent(self) -> float:
        """Spent share of the budget, 0 to 1; a learning rate may depend on it."""
        return min(1.0, self.processor_s / self._budget_s)

    @property
    def ended(self) -> str | None:
        """Reason for the end: the budget is spent, or the score stopped gaining; None to continue."""
        if self.processor_s >= self._budget_s:
            return "budget"
        return "stopped gaining" if self.rests_so_far > self._drops else None

    @property
    def rests_so_far(self) -> int:
        """Number of plateaus so far; a learning rate may depend on it."""
        return rests([point.score for point in self.curve], self._patience)

    def point(self, images: int, loss: float, score: float, state: Mapping[str, Any]) -> CurvePoint:
        """Add a point to the curve and save the state, also as the best one if the score is the best so far.

        Args:
            images: images shown so far.
            loss: mean loss since the previous point.
            score: validation score; larger is better.
            state: state to save: state_dicts and plain values.
        """
        point = CurvePoint(images, self.processor_s, loss, score)
        best = not self.curve or score > max(each.score for each in self.curve)
        for name in ("checkpoint.pt", "best.pt") if best else ("checkpoint.pt",):
            part = self.folder / f"{name}.part"
            torch.save(dict(state), part)
            part.rename(self.folder / name)
        self.curve.append(point)
        write_curve(self.folder / CURVE, self.curve)
        return point

    def spend(
        self,
        step: Callable[[], float],
        *,
        batch: int,
        point_every: int,
        score: Callable[[], float],
        state: Callable[[], Mapping[str, Any]],
        progress: Callable[[int, int], None],
    ) -> None:
        """Take steps until the budget is spent or the score stopped gaining. Even a short budget gets one step.

        Args:
            step: takes one step of the optimiser and returns its loss.
            batch: images of a step.
            point_every: images between two points of the curve.
            score: computes the validation score; larger is better.
            state: returns the state to save.
            progress: called after each step with the spent budget and 1000, per mille.
        """
        while not self.curve or self.ended is None:
            images, losses = 0, list[float]()
            while not losses or (images < point_every and self.share_spent < 1.0):
                losses.append(step())
                images += batch
                progress(int(1000 * self.share_spent), 1000)
            self.point(self.images + images, float(np.mean(losses)), score(), state())

    def checkpoint(self) -> dict[str, Any] | None:
        """Load the last saved state; None at the beginning."""
        return self._load("checkpoint.pt")

    def best(self) -> dict[str, Any]:
        """Load the state with the best score.

        Raises:
            DatasetError: nothing was saved yet.
        """
        state = self._load("best.pt")
        if state is None:
            raise DatasetError(f"{self.folder} has no best.pt yet; train first", field="folder")
        return state

    def _load(self, name: str) -> dict[str, Any] | None:
        path = self.folder / name
        if not path.exists():
            return None
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        return state


def read_curve(path: Path) -> list[CurvePoint]:
    """Read the points of a run; none if it has not begun.

    Args:
        path: file of the curve.
    """
    if not path.exists():
        return []
    return [CurvePoint(**json.loads(line)) for line in path.read_text().splitlines()]


def write_curve(path: Path, curve: Sequence[CurvePoint]) -> None:
    """Write the points of a run atomically.

    Args:
        path: file of the curve.
        curve: points of the run.
    """
    part = path.with_suffix(".part")
    part.write_text("".join(json.dumps(asdict(each)) + "\n" for each in curve))
    part.rename(path)


#: Receives stage, number done and total; here a method and per mille of its budget.
Report = Callable[[str, int, int], None]
