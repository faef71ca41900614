"""Training time of each learned method for the same number of images, measured by steps of all methods in turn in one run.

The trainings themselves run on different machines beside other work. Their times cannot be compared. So this comparison
is a run of its own: some steps of every method, round after round.
"""

import json
import os
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks.paper.data import PaperData, Size
from benchmarks.paper.kept import COMMAND
from benchmarks.paper.ours import config_as_paper, pack_of, seconds_a_step
from benchmarks.provenance import Run, this_process
from model_training.training.encoder_net import EncoderShape
from research.baselines.dual import learn
from research.baselines.dual.pictures import Sweeps, pictures_of
from research.baselines.gallery import thinned
from research.baselines.learning import one_thread
from research.baselines.paper.train import CnnTrainer
from research.baselines.paper.variants import PLANS
from research.baselines.regression.pictures import MapFrame
from research.baselines.regression.train_pose import PoseLearner, PoseSettings
from service.imaging.view_grid import ViewGrid

#: Number of rounds, and the least processor time of each method in a round, seconds.
ROUNDS, LEAST_S = 3, 3.0
#: Steps that do not count: caches are cold and buffers are not allocated yet.
WARM_UP = 3
Measure = Callable[[], float]


@dataclass(frozen=True)
class Pace:
    """Processor time per image of each method, and the run that measured it.

    Attributes:
        seconds_an_image: processor seconds per image by method, one value per round.
        load: processes that wanted a core, averaged over a minute, before and after (1 is this process alone).
        run: the run that measured.
    """

    seconds_an_image: Mapping[str, list[float]]
    load: tuple[float, float] = (0.0, 0.0)
    run: Run = field(default_factory=lambda: this_process(COMMAND))

    def minutes(self, method: str, images: int) -> float | None:
        """Return processor minutes for a number of images, by the median round; None for an unmeasured method.

        Args:
            method: name of the method.
            images: number of images.
        """
        rounds = self.seconds_an_image.get(method)
        return None if rounds is None else float(np.median(rounds)) * images / 60

    def save(self, path: Path) -> None:
        """Write JSON atomically.

        Args:
            path: file to write.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        part.write_text(json.dumps(asdict(self) | {"run": self.run.as_json()}, indent=1) + "\n")
        part.rename(path)

    @staticmethod
    def read(path: Path) -> "Pace | None":
        """Load a measurement; return None if it does not exist.

        Args:
            path: file to read.
        """
        if not path.exists():
            return None
        told = json.loads(path.read_text())
        return Pace(**told | {"load": tuple(told["load"]), "run": Run(**told["run"])})

    def to_the_quickest(self) -> list[float]:
        """Return the ratio of our time to the quickest other method's, per round; below 1 ours is quicker."""
        others = [times for name, times in self.seconds_an_image.items() if not name.startswith("streetfix")]
        return [
            ours / min(of)
            for ours, of in zip(self.seconds_an_image["streetfix"], zip(*others, strict=True), strict=True)
        ]


def measure_pace(data: PaperData, report: Callable[[str, int, int], None]) -> Pace:
    """Measure all learned methods in turn, each with one thread.

    Of the paper's baseline only the first network counts: an image is one that GoogLeNet learns from. The time of
    PointNetLK is left out, in the baseline's favour. Data of another size than the paper's get a single step, as a
    check that everything runs.

    Args:
        data: shared data.
        report: receives a label, the number done and the total.
    """
    rounds, least_s = (ROUNDS, LEAST_S) if data.size == Size() else (1, 0.0)
    before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder, one_thread():
        methods = _methods(data, Path(folder), least_s)
        found: dict[str, list[float]] = {name: [] for name in methods}
        for turn in range(rounds):
            for number, (name, measure) in enumerate(methods.items()):
                found[name].append(measure())
                report("pace", turn * len(methods) + number + 1, rounds * len(methods))
    return Pace(found, (before, os.getloadavg()[0]))


def _methods(data: PaperData, folder: Path, least_s: float) -> dict[str, Measure]:
    config = config_as_paper(data.size)
    stock = config.model_copy(update={"encoder": EncoderShape()})

    def warm(step: Callable[[], int]) -> Measure:
        for _ in range(WARM_UP if least_s else 0):
            step()
        return partial(_timed, step, least_s)

    methods: dict[str, Measure] = {
        "streetfix": lambda: seconds_a_step(pack_of(data, config.encoder), config) / (2 * config.pairs),
        "streetfix_stock_shape": lambda: seconds_a_step(pack_of(data, stock.encoder), stock) / (2 * stock.pairs),
        "googlenet": warm(_googlenet(data)),
        "dual_encoder": warm(_towers(data, "dual")),
        "fov_encoder": warm(_towers(data, "fov")),
    }
    for name, plan in PLANS.items():
        trainer = CnnTrainer(plan, data.frames, data.pairs if plan.pairs_too else None, folder / name, budget_s=60.0)
        methods[f"cnn_{name}"] = warm(partial(_cnn_step, trainer))
    return methods


def _timed(step: Callable[[], int], least_s: float) -> float:
    """Return the processor seconds per image of steps that return their number of images."""
    began, images = time.process_time(), 0
    while images == 0 or time.process_time() - began < least_s:
        images += step()
    return (time.process_time() - began) / images


def _cnn_step(trainer: CnnTrainer) -> int:
    trainer.step(trainer.batch)
    return trainer.batch


def _googlenet(data: PaperData) -> Callable[[], int]:
    learner = PoseLearner(data.pairs, MapFrame.of(data.pairs.T_map_camera[:, :3, 3]), PoseSettings())
    rows = np.arange(len(data.pairs))

    def step() -> int:
        drawn = learner.draw(rows)
        learner.step(drawn, 0.5)
        return len(drawn)

    return step


def _towers(data: PaperData, kind: learn.Kind) -> Callable[[], int]:
    settings = learn.BEST[kind]
    pictures = pictures_of(data.pairs, learn.size_of(kind))
    views = learn.views_of(kind, pictures.camera, ViewGrid())
    sweeps = Sweeps.of(data.frames, thinned(data.frames.places[:, :2], settings.frames_spacing_m))
    lesson = learn.Lesson.of(pictures, np.array(data.pairs.views), sweeps, views, settings)
    towers = learn.towers_of(settings, views).to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch documents it, its stub does not
    optimiser = torch.optim.AdamW(towers.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
    batches = lesson.batches(settings, np.random.default_rng(0))

    def step() -> int:
        batch = next(batches)
        learn.step(towers.train(), optimiser, batch, settings)
        return 2 * len(batch[0])

    return step
