"""Training the paper's CNN: as the paper says (84 iterations), and until it stops gaining."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from model_training.baselines.learning import Report, Training, one_thread, set_rate
from model_training.baselines.paper.cnn import PaperCnn
from model_training.baselines.paper.pictures import LidarPictures, Pictures, Space, fused_pictures
from model_training.baselines.paper_data.frames import Frames
from model_training.baselines.paper_data.pairs import Pairs
from model_training.training.precision import Precision, forward_in, native_precision

LEARNT_SHARE = 0.7  # of the frames, at random: the paper's split
ITERATIONS_AN_EPOCH, EPOCHS = 21, 4  # the paper's
WATCHED_BLOCKS, WATCHED_SHARE, WATCHED_EACH = 20, 0.05, 10
PATIENCE = 4  # points of the curve without a gain, a quarter of an epoch each, after which the rate falls
DROPS, DROP = 2, 0.2  # how often, and to how much; a rest at the last rate ends the run
CHUNK = 128  # pictures in memory at a time; gradients of a larger batch are summed over them
SEED = 0


@dataclass(frozen=True, slots=True)
class CnnPlan:
    """One way to train it.

    Attributes:
        space: the LiDAR's image space.
        as_paper: SGDM, rate 3e-4, 84 iterations of a 21st of the training frames; else SGDM at ``rate`` in batches of ``batch``,
            the rate falling whenever it stops gaining, until that helps no more or its budget is spent.
        pairs_too: a third of each batch are fused RGB-D pairs of the training drives, in the same image space.
        precision: of the forward pass.
    """

    space: Space
    as_paper: bool = False
    pairs_too: bool = False
    rate: float = 0.01
    batch: int = 32  # a quarter more pictures a second than 128: a batch's largest planes stay in the processor's cache
    momentum: float = 0.9
    weight_decay: float = 1e-4  # MATLAB's default L2 regularisation
    precision: Precision = field(default_factory=native_precision)


AS_PAPER_RATE = 3e-4


@dataclass(frozen=True, eq=False)
class Split:
    """Rows of frames: 70 % to learn from, of which ``watched`` (whole stretches of street) are kept aside, and 30 % to test."""

    learnt: NDArray[np.int64]
    watched: NDArray[np.int64]
    tested: NDArray[np.int64]

    @property
    def known(self) -> NDArray[np.int64]:
        """The paper's 70 %: what K-NN may find."""
        return np.sort(np.concatenate([self.learnt, self.watched]))


def split_of(total: int) -> Split:
    """The paper's random 70/30 split; stretches of the drive that stopping is decided on are taken from the 70 %."""
    rng = np.random.default_rng(SEED)
    order = rng.permutation(total)
    learnt = np.sort(order[: round(LEARNT_SHARE * total)])
    length = max(1, round(total * WATCHED_SHARE / WATCHED_BLOCKS))
    starts = rng.choice(max(1, total - length), min(WATCHED_BLOCKS, max(1, total // length)), replace=False)
    aside = np.zeros(total, bool)
    for start in starts:
        aside[start : start + length] = True
    return Split(learnt[~aside[learnt]], learnt[aside[learnt]], np.sort(order[round(LEARNT_SHARE * total) :]))


def shown_pairs(total: int) -> NDArray[np.int64]:
    """Rows of the training pairs that are learnt from; every twentieth is kept aside, to end a training and to choose among variants."""
    rows = np.arange(total, dtype=np.int64)
    shown: NDArray[np.int64] = rows[rows % 20 != 0]
    return shown


def aside_pairs(total: int) -> NDArray[np.int64]:
    """The others."""
    return np.arange(0, total, 20)


class CnnTrainer:
    """One run: a plan, its data, its folder."""

    def __init__(
        self, plan: CnnPlan, frames: Frames, pairs: Pairs | None, folder: Path, *, budget_s: float, patience: int = PATIENCE
    ) -> None:  # fmt: skip
        self.plan, self.frames, self.pairs = plan, frames, pairs
        self.split = split_of(len(frames))
        # As printed nothing is chosen by what is watched: all of the 70 % is learnt from, some of the 30 % is watched.
        self._learnt = self.split.known if plan.as_paper else self.split.learnt
        self._watched = self.split.tested[::WATCHED_EACH] if plan.as_paper else self.split.watched
        self.pictures = LidarPictures(frames, plan.space)
        self.training = Training(
            folder, asdict(plan) | {"frames": len(frames)}, budget_s=budget_s, patience=patience, drops=DROPS
        )
        self._rng = np.random.default_rng([SEED, self.training.images])
        torch.manual_seed(SEED)
        self.net = PaperCnn().to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch documents it, its stub does not
        rate = AS_PAPER_RATE if plan.as_paper else plan.rate
        self._optimiser = torch.optim.SGD(self.net.parameters(), rate, plan.momentum, weight_decay=plan.weight_decay)
        state = self.training.checkpoint()
        if state is not None:
            self.net.load_state_dict(state["net"])
            self._optimiser.load_state_dict(state["optimiser"])

    def run(self, name: str, report: Report = lambda *_: None) -> PaperCnn:
        """Train to the end and give the network back: the last one as in the paper, else the best one."""
        with one_thread():
            self._train(name, report)
        if not self.plan.as_paper:
            self.net.load_state_dict(self.training.best()["net"])
        trained: PaperCnn = self.net.eval()
        return trained

    def _train(self, name: str, report: Report) -> None:
        batch = self.batch
        most = self.iterations * batch if self.plan.as_paper else None
        every = batch * max(1, ITERATIONS_AN_EPOCH // 3) if self.plan.as_paper else max(batch, len(self._learnt) // 4)
        images, losses = self.training.images, list[float]()

        def point() -> None:
            state = {"net": self.net.state_dict(), "optimiser": self._optimiser.state_dict()}
            self.training.point(images, float(np.mean(losses)), self._watched_accuracy(), state)
            losses.clear()

        while not self._done(images, most):
            if not self.plan.as_paper:
                set_rate(self._optimiser, self.plan.rate * DROP**self.training.rests_so_far)
            losses.append(self.step(batch))
            images += batch
            spent = images / most if most else self.training.share_spent
            report(name, round(1000 * spent), 1000)
            if images // every > (images - batch) // every:
                point()
        if losses:  # since the last point, where the budget ended between two
            point()

    @property
    def batch(self) -> int:
        """Pictures of a step."""
        return -(-len(self._learnt) // ITERATIONS_AN_EPOCH) if self.plan.as_paper else self.plan.batch

    @property
    def iterations(self) -> int:
        """Of a run as the paper has it."""
        return ITERATIONS_AN_EPOCH * EPOCHS

    def _done(self, images: int, most: int | None) -> bool:
        if most is not None:
            return images >= most
        return images > 0 and self.training.ended is not None  # a short budget buys a step too

    def step(self, batch: int) -> float:
        """Learn from so many pictures drawn at random; the mean loss."""
        self.net.train()
        self._optimiser.zero_grad(set_to_none=True)
        total = 0.0
        for first in range(0, batch, CHUNK):
            pictures, street = self._drawn(min(CHUNK, batch - first))
            with forward_in(self.plan.precision):
                scores = self.net(as_input(pictures))
            loss = functional.cross_entropy(scores.float(), torch.from_numpy(street))
            share = len(street) / batch
            (loss * share).backward()  # type: ignore[no-untyped-call]  # torch's own stub leaves it untyped
            total += float(loss.detach()) * share
        self._optimiser.step()
        return total

    def _drawn(self, count: int) -> tuple[Pictures, NDArray[np.int64]]:
        """Pictures and classes, drawn at random."""
        of_pairs = count // 3 if self.plan.pairs_too and self.pairs is not None else 0
        rows = np.sort(self._rng.choice(self._learnt, count - of_pairs, replace=False))
        pictures, street = self.pictures.shaken(rows, self._rng), self.frames.street[rows]
        if of_pairs and self.pairs is not None:
            chosen = np.sort(self._rng.choice(shown_pairs(len(self.pairs)), of_pairs, replace=False))
            pictures = np.concatenate([pictures, fused_pictures(self.pairs, chosen, self.plan.space)])
            street = np.concatenate([street, self.pairs.street[chosen]])
        return pictures, street

    def _watched_accuracy(self) -> float:
        """Of stretches of street that are not shown; of pairs that are not shown, where pairs are learnt from."""
        if self.plan.pairs_too and self.pairs is not None:
            pairs, aside = self.pairs, aside_pairs(len(self.pairs))
            _, scores = outputs(
                self.net, lambda chosen: fused_pictures(pairs, aside[chosen], self.plan.space), len(aside)
            )
            return float((scores.argmax(axis=1) == pairs.street[aside]).mean())
        rows = self._watched
        _, scores = outputs(self.net, lambda chosen: self.pictures.of(rows[chosen]), len(rows))
        return float((scores.argmax(axis=1) == self.frames.street[rows]).mean())


def as_input(pictures: Pictures) -> torch.Tensor:
    """Pictures (B, H, W, 3) as the network reads them: (B, 3, H, W) in 0..1."""
    return torch.from_numpy(pictures).permute(0, 3, 1, 2).float().div_(255)


def outputs(
    net: PaperCnn, drawn: Callable[[NDArray[np.int64]], Pictures], count: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Features (n, 128) and class scores (n, 16) of ``drawn(rows)`` for rows 0 to ``count``."""
    net.eval()
    features, scores = [], []
    with torch.inference_mode():
        for first in range(0, count, CHUNK):
            found = net.features(as_input(drawn(np.arange(first, min(first + CHUNK, count)))))
            features.append(found.numpy())
            scores.append(net.last(found).numpy())
    return np.concatenate(features), np.concatenate(scores)
