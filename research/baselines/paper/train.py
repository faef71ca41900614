"""Training of the paper's CNN: as published (84 iterations), and until it stops gaining."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from model_training.training.precision import Precision, forward_in, native_precision
from research.baselines.learning import Report, Training, one_thread, set_rate
from research.baselines.paper.cnn import PaperCnn
from research.baselines.paper.pictures import LidarPictures, Pictures, Space, fused_pictures
from research.baselines.paper_data.frames import Frames
from research.baselines.paper_data.pairs import Pairs

#: Random share of the frames for training, as in the paper.
LEARNT_SHARE = 0.7
ITERATIONS_AN_EPOCH, EPOCHS = 21, 4  # as in the paper
WATCHED_BLOCKS, WATCHED_SHARE, WATCHED_EACH = 20, 0.05, 10
#: Points of the curve without a gain, a quarter of an epoch each, after which the rate falls.
PATIENCE = 4
#: Number of drops of the rate, and their factor. A plateau at the last rate ends the run.
DROPS, DROP = 2, 0.2
#: Images in memory at a time. Larger batches sum gradients over such chunks.
CHUNK = 128
SEED = 0


@dataclass(frozen=True, slots=True)
class CnnPlan:
    """One way to train the CNN.

    Attributes:
        space: image space of the LiDAR.
        as_paper: True trains by SGDM at rate 3e-4 for 84 iterations, each with a 21st of the training frames. False
            trains by SGDM at ``rate`` in batches of ``batch``; the rate falls at each plateau, until that no longer
            helps or the budget is spent.
        pairs_too: whether a third of each batch are fused RGB-D pairs of the training traversals, in the same image
            space.
        rate: first learning rate, unless ``as_paper``.
        batch: images per batch, unless ``as_paper``. 32 gives a quarter more images per second than 128, since the
            largest planes fit the processor's cache.
        momentum: momentum of SGD.
        weight_decay: weight decay of SGD, MATLAB's default L2 regularisation.
        precision: precision of the forward pass.
    """

    space: Space
    as_paper: bool = False
    pairs_too: bool = False
    rate: float = 0.01
    batch: int = 32
    momentum: float = 0.9
    weight_decay: float = 1e-4
    precision: Precision = field(default_factory=native_precision)


AS_PAPER_RATE = 3e-4


@dataclass(frozen=True, eq=False)
class Split:
    """Rows of frames: 70 % for training, with a held-out part in whole stretches of street, and 30 % for testing.

    Attributes:
        learnt: rows for training.
        watched: held-out rows of the 70 %.
        tested: rows for testing.
    """

    learnt: NDArray[np.int64]
    watched: NDArray[np.int64]
    tested: NDArray[np.int64]

    @property
    def known(self) -> NDArray[np.int64]:
        """Rows (n,) of the paper's 70 %, the frames that K-NN may find."""
        return np.sort(np.concatenate([self.learnt, self.watched]))


def split_of(total: int) -> Split:
    """Make the paper's random 70/30 split; take the held-out stretches from the 70 %.

    Args:
        total: number of frames.
    """
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
    """Return rows (n,) of the training pairs; every twentieth is held out, to end a training and to choose among variants.

    Args:
        total: number of pairs.
    """
    rows = np.arange(total, dtype=np.int64)
    shown: NDArray[np.int64] = rows[rows % 20 != 0]
    return shown


def aside_pairs(total: int) -> NDArray[np.int64]:
    """Return the rows (n,) that ``shown_pairs`` keeps aside.

    Args:
        total: number of pairs.
    """
    return np.arange(0, total, 20)


class CnnTrainer:
    """One training run.

    Args:
        plan: way to train.
        frames: LiDAR frames.
        pairs: RGB-D pairs; None without.
        folder: folder of the run.
        budget_s: budget, processor seconds.
        patience: points without a gain after which the rate falls.
    """

    def __init__(
        self,
        plan: CnnPlan,
        frames: Frames,
        pairs: Pairs | None,
        folder: Path,
        *,
        budget_s: float,
        patience: int = PATIENCE,
    ) -> None:
        self.plan, self.frames, self.pairs = plan, frames, pairs
        self.split = split_of(len(frames))
        # The published variant does no model selection: it trains on all of the 70 %, and its curve shows a part of
        # the 30 %.
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
        """Train to the end and return the network: the last one for the published variant, else the best one.

        Args:
            name: label of the run.
            report: receives the label and the progress per mille.
        """
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
        if losses:  # losses since the last point: the budget ended between two points
            point()

    @property
    def batch(self) -> int:
        """Images per step."""
        return -(-len(self._learnt) // ITERATIONS_AN_EPOCH) if self.plan.as_paper else self.plan.batch

    @property
    def iterations(self) -> int:
        """Iterations of a published run."""
        return ITERATIONS_AN_EPOCH * EPOCHS

    def _done(self, images: int, most: int | None) -> bool:
        if most is not None:
            return images >= most
        return images > 0 and self.training.ended is not None  # even a short budget gets one step

    def step(self, batch: int) -> float:
        """Train on random images and return the mean loss.

        Args:
            batch: number of images.
        """
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
        """Draw random images and their classes."""
        of_pairs = count // 3 if self.plan.pairs_too and self.pairs is not None else 0
        rows = np.sort(self._rng.choice(self._learnt, count - of_pairs, replace=False))
        pictures, street = self.pictures.shaken(rows, self._rng), self.frames.street[rows]
        if of_pairs and self.pairs is not None:
            chosen = np.sort(self._rng.choice(shown_pairs(len(self.pairs)), of_pairs, replace=False))
            pictures = np.concatenate([pictures, fused_pictures(self.pairs, chosen, self.plan.space)])
            street = np.concatenate([street, self.pairs.street[chosen]])
        return pictures, street

    def _watched_accuracy(self) -> float:
        """Return the accuracy on held-out stretches of street, or on held-out pairs if the plan trains on pairs."""
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
    """Convert images to the network's input (B, 3, H, W) in 0..1.

    Args:
        pictures: images (B, H, W, 3).
    """
    return torch.from_numpy(pictures).permute(0, 3, 1, 2).float().div_(255)


def outputs(
    net: PaperCnn, drawn: Callable[[NDArray[np.int64]], Pictures], count: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compute features (n, 128) and class scores (n, 16) of images.

    Args:
        net: the network.
        drawn: returns the images of rows.
        count: number of rows n; the rows are 0 to n - 1.
    """
    net.eval()
    features, scores = [], []
    with torch.inference_mode():
        for first in range(0, count, CHUNK):
            found = net.features(as_input(drawn(np.arange(first, min(first + CHUNK, count)))))
            features.append(found.numpy())
            scores.append(net.last(found).numpy())
    return np.concatenate(features), np.concatenate(scores)
