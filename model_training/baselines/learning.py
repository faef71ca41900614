"""What the learned baselines share: a budget of processor time, a curve of what they gained, checkpoints to go on from.

A budget is counted in processor time of all threads, so that neither other work on the machine nor a pause changes what a
method is given.
"""

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from service.errors import DatasetError

CURVE = "curve.jsonl"
WARM_UP = 0.02  # of a budget: the rate rises first


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """State of a training after ``images`` shown: processor time (s), mean loss since the last point, and ``score``.

    ``score`` is what the method watches, on frames of the training drive that are not shown; larger is better.
    """

    images: int
    processor_s: float
    loss: float
    score: float


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch with one thread: two spend more processor time on waiting for each other than they save.

    Measured with other work on two cores: 28.7 pictures of 112 x 112 learnt from in a second of processor time, with two
    threads 14.6.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def cosine_share(share_spent: float, *, warm_up: float = 0.0, least: float = 0.01) -> float:
    """Of a learning rate, when a share of the budget is spent: a line up, then half a cosine down to ``least``."""
    if share_spent < warm_up:
        return max(share_spent / warm_up, least)
    done = (share_spent - warm_up) / (1.0 - warm_up)
    return least + (1.0 - least) * 0.5 * (1.0 + math.cos(math.pi * done))


def set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Give all groups the rate, a group's ``times`` over where it has such a factor."""
    for group in optimiser.param_groups:
        group["lr"] = rate * group.get("times", 1.0)


def rests(scores: Sequence[float], patience: int) -> int:
    """How often a score rested: ``patience`` values in a row without a new best, counted anew after each rest."""
    best, since, count = -math.inf, 0, 0
    for score in scores:
        best, since = (score, 0) if score > best else (best, since + 1)
        if since == patience:
            since, count = 0, count + 1
    return count


class Training:
    """A run's folder: its settings, its curve and its last checkpoint.

    ``settings`` (plain JSON values) are kept beside the checkpoint; a folder of other settings is refused. ``budget_s`` is no
    setting: a run that ended at a budget goes on when it is given more. A run that may ``drops`` times go on at a lower rate
    (``rests_so_far``) ends at the rest after them; without drops at the first.

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
            raise DatasetError(f"{kept} is of other settings; remove {folder} to train anew", field="settings")
        kept.write_text(text)
        self.curve = read_curve(folder / CURVE)
        self._spent_before = self.curve[-1].processor_s if self.curve else 0.0
        self._began = time.process_time()

    @property
    def processor_s(self) -> float:
        """Processor time that the run has taken, in earlier sessions too, up to the last saved point of each."""
        return self._spent_before + time.process_time() - self._began

    @property
    def images(self) -> int:
        """Images shown up to the last point."""
        return self.curve[-1].images if self.curve else 0

    @property
    def share_spent(self) -> float:
        """Of the budget, 0 to 1: what a learning rate may follow."""
        return min(1.0, self.processor_s / self._budget_s)

    @property
    def ended(self) -> str | None:
        """Why there is nothing more to do: the budget is spent, or the score stopped gaining; None to go on."""
        if self.processor_s >= self._budget_s:
            return "budget"
        return "stopped gaining" if self.rests_so_far > self._drops else None

    @property
    def rests_so_far(self) -> int:
        """How often the score stopped gaining: what a learning rate may follow that falls then."""
        return rests([point.score for point in self.curve], self._patience)

    def point(self, images: int, loss: float, score: float, state: Mapping[str, Any]) -> CurvePoint:
        """Note a point of the curve and save ``state`` (state_dicts and plain values), and apart the best one so far."""
        point = CurvePoint(images, self.processor_s, loss, score)
        best = not self.curve or score > max(each.score for each in self.curve)
        for name in ("checkpoint.pt", "best.pt") if best else ("checkpoint.pt",):
            part = self.folder / f"{name}.part"
            torch.save(dict(state), part)
            part.rename(self.folder / name)
        self.curve.append(point)
        write_curve(self.folder / CURVE, self.curve)
        return point

    def checkpoint(self) -> dict[str, Any] | None:
        """The last saved state, or None at the beginning."""
        return self._load("checkpoint.pt")

    def best(self) -> dict[str, Any]:
        """The state with the best score.

        Raises:
            DatasetError: nothing was saved yet.
        """
        state = self._load("best.pt")
        if state is None:
            raise DatasetError(f"{self.folder} holds no best.pt yet; train first", field="folder")
        return state

    def _load(self, name: str) -> dict[str, Any] | None:
        path = self.folder / name
        if not path.exists():
            return None
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        return state


def read_curve(path: Path) -> list[CurvePoint]:
    """The points of a run; none where it has not begun."""
    if not path.exists():
        return []
    return [CurvePoint(**json.loads(line)) for line in path.read_text().splitlines()]


def write_curve(path: Path, curve: Sequence[CurvePoint]) -> None:
    """Write the points of a run, whole or not at all."""
    part = path.with_suffix(".part")
    part.write_text("".join(json.dumps(asdict(each)) + "\n" for each in curve))
    part.rename(path)


Report = Callable[[str, int, int], None]  # stage, done, of; here: a method, and per mille of its budget
