"""The training loop: draw pairs, step, log, save, resume."""

import json
import signal
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from types import FrameType
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch.nn.parallel import DistributedDataParallel
from torch.utils.tensorboard import SummaryWriter

from model_training.datasets.files import read_bytes, reading
from model_training.training.augment import Augmentation, Augmenter
from model_training.training.batches import Batch, Choice, City, open_cities
from model_training.training.encoder_net import EncoderNet, EncoderShape, queries_first
from model_training.training.from_onnx import net_of, require_shape
from model_training.training.losses import Side, hardest_triplet, paired_info_nce
from model_training.training.memory import DescriptorMemory
from model_training.training.precision import Precision, forward_in
from model_training.training.processes import ALONE, Processes
from model_training.training.shared_norm import share_statistics
from service.errors import DatasetError
from service.imaging.view_grid import PLANES, ViewGrid
from service.retrieval.encoder import Encoder

#: Pairs that are augmented together on a CPU.
PAIRS_AT_ONCE = 16
#: Batches that set the statistics of an encoder exported without them, and greatest number of pairs per batch.
STATISTICS_BATCHES, STATISTICS_PAIRS = 12, 64

_LOSSES = {"info_nce": paired_info_nce, "triplet": hardest_triplet}


class TrainingConfig(BaseModel):
    """Everything that decides what a run learns.

    The run keeps it beside its checkpoint. A run refuses to go on with another configuration.

    Attributes:
        steps: training steps.
        pairs: pairs per batch, of all processes together.
        optimiser: AdamW, or SGD with Nesterov momentum.
        learning_rate: greatest learning rate.
        weight_decay: of the optimiser.
        momentum: of ``sgdm``.
        warm_up_steps: steps of the linear warm-up.
        gradient_norm: the gradient is clipped to this norm.
        largest_scale: greatest inverse temperature of the loss.
        seed: seed of all random numbers.
        turn_deg: greatest rotation between a query and its map view, degrees.
        memory_after: step from which descriptors of earlier batches are used; None never uses them.
        memory_steps: age in steps beyond which a descriptor is not used.
        stale_negatives: use remembered descriptors as negatives too. Otherwise they only choose hard negatives.
        alike_seeds: pairs of a batch whose hard negatives are drawn with them.
        alike_each: hard negatives per such pair.
        loss: InfoNCE or triplet loss.
        blind: planes (``service.imaging.view_grid.PLANES``) that are set to 0 in queries.
        precision: of the forward pass. bfloat16 takes half the time if the processor supports it.
        shards: parts of a batch that have their own random numbers. Up to so many processes can share a batch, and any number
            of processes learns the same.
        encoder: sizes of the encoder.
        augmentation: errors of the views.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    steps: int = 4000
    pairs: int = 128
    optimiser: Literal["adamw", "sgdm"] = "adamw"
    learning_rate: float = 2e-3
    weight_decay: float = 1e-3
    momentum: float = 0.9
    warm_up_steps: int = 100
    gradient_norm: float = 2.0
    largest_scale: float = 60.0
    seed: int = 0
    turn_deg: float = 9.0  # a fan of 24 headings is off by up to 7.5 degrees
    memory_after: int | None = 300  # at first descriptors drift too fast
    memory_steps: int = 400
    stale_negatives: bool = True
    alike_seeds: int = 8
    alike_each: int = 7
    loss: Literal["info_nce", "triplet"] = "info_nce"
    blind: tuple[str, ...] = ()
    precision: Precision = "float32"
    shards: int = Field(default=1, ge=1)
    encoder: EncoderShape = EncoderShape()
    augmentation: Augmentation = Augmentation()


@dataclass(frozen=True, slots=True)
class Progress:
    """State after a step, for progress bars and logs.

    Attributes:
        step: steps done.
        steps: all steps.
        loss: mean loss of the batch.
        accuracy: share of the pairs whose own survey view is the most similar one.
        images_per_s: views per second since this call began.
    """

    step: int
    steps: int
    loss: float
    accuracy: float
    images_per_s: float


def device_of(name: str) -> torch.device:
    """Return the torch device of a name.

    Args:
        name: ``cpu``, ``cuda``, or ``auto``, which takes CUDA if there is a CUDA device.

    Raises:
        DatasetError: the name is unknown, or there is no such device.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise DatasetError(f"device: {name!r} is not auto, cpu or cuda", field="device")
    if name == "cuda" and not torch.cuda.is_available():
        raise DatasetError("device: torch finds no CUDA device here; use --device cpu, or auto", field="device")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def train(
    packs: list[Path],
    run: Path,
    config: TrainingConfig,
    *,
    device: str = "auto",
    resume: bool = True,
    save_every: int = 200,
    start_from: Path | None = None,
    report: Callable[[Progress], None] = lambda _: None,
    together: Processes = ALONE,
) -> EncoderNet:
    """Train an encoder on packs.

    The folder of the run holds ``config.json``, ``checkpoint.pt`` and the TensorBoard log.
    The first Ctrl-C or SIGTERM saves a checkpoint and ends. The same call continues from there.
    Several processes share each batch. They learn the same as one process with the same ``config``, except for rounding.

    Args:
        packs: folders of the training cities.
        run: folder of the run.
        config: everything that decides what the run learns.
        device: ``auto``, ``cpu`` or ``cuda``.
        resume: continue from the checkpoint in ``run`` if there is one.
        save_every: steps between checkpoints.
        start_from: folder of a run, or an exported encoder, whose weights the run starts from.
        report: called after every step, in the first process.
        together: processes that train together; all call this function with the same arguments.

    Raises:
        DatasetError: the folder belongs to another configuration or other cities, a pack or checkpoint is unusable, or the
            processes cannot share a batch.
        EncoderError: ``start_from`` is a file, but no encoder of the configured shape.
        KeyboardInterrupt: after the checkpoint was saved.
    """
    place = together.device(device_of(device))
    require_shards(config, together.count)
    if start_from is not None:
        require_start(start_from, config.encoder)
    together.require_shared(run, "run")
    together.in_turn(lambda: _keep_config(run, config))
    together.in_turn(lambda: _keep_packs(run, packs, start_from))
    state = _State(packs, run, config, place, together, start_from=start_from, resume=resume)
    together.wait()  # no process may replace the checkpoint before all have read it
    state.share()
    with (
        SummaryWriter(str(run / "tensorboard")) if together.is_first else nullcontext() as log,
        _Interrupt() as interrupt,
    ):
        began, images = time.perf_counter(), 0
        for step in range(state.first_step, config.steps):
            done = state.step(step)
            images += 2 * done.pairs
            if log is not None:
                speed = images / (time.perf_counter() - began)
                report(Progress(step + 1, config.steps, done.loss, done.accuracy, speed))
                if (step + 1) % 10 == 0:
                    log.add_scalar("loss", done.loss, step + 1)
                    log.add_scalar("own_view_first", done.accuracy, step + 1)
                    log.add_scalar("scale", done.scale, step + 1)
            if (step + 1) % save_every == 0 or step + 1 == config.steps:
                state.save(step + 1)
            if together.any(interrupt.asked):
                state.save(step + 1)
                raise KeyboardInterrupt
    return state.trained()


@dataclass(frozen=True, slots=True)
class _Step:
    """Result of one step: loss, share of pairs whose own survey view is the most similar one, inverse temperature, pairs."""

    loss: float
    accuracy: float
    scale: float
    pairs: int


class _State:
    """Everything that a run changes: weights, optimiser, random numbers, and descriptors of earlier batches.

    Its start is the checkpoint of the run if ``resume``, else the weights of ``start_from``, else random weights.
    """

    def __init__(
        self,
        packs: list[Path],
        run: Path,
        config: TrainingConfig,
        place: torch.device,
        together: Processes,
        *,
        start_from: Path | None,
        resume: bool,
    ) -> None:
        self._run, self._config, self._place, self._together = run, config, place, together
        grid = ViewGrid(rows=config.encoder.rows, columns=config.encoder.columns)
        torch.manual_seed(config.seed)
        self._rng = np.random.default_rng(config.seed)
        self._generator = torch.Generator(device=place).manual_seed(config.seed)
        self._augment = Augmenter(config.augmentation, grid, self._generator, place)
        self._cities = open_cities(packs, grid, turn_deg=config.turn_deg, pairs=config.pairs, device=place)
        self._log_scale = torch.nn.Parameter(torch.tensor(float(np.log(1 / 0.07)), device=place))
        resumes = resume and self._checkpoint.exists()
        net = EncoderNet(config.encoder)
        if start_from is not None and not start_from.is_dir() and not resumes:
            net = net_of(start_from, config.encoder, *_views_of_all(self._cities, config, self._augment, self._rng))
            self._log_scale.data.fill_(float(np.log(config.largest_scale)))
        net = net.to(place)
        self._net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stub
        self._encode: torch.nn.Module = self._net
        self._optimiser = _optimiser([*self._net.parameters(), self._log_scale], config)
        self._memories = [
            DescriptorMemory(len(city.pack.queries), config.encoder.descriptor, place) for city in self._cities
        ]
        self.first_step = 0
        if start_from is not None and start_from.is_dir():
            before = read_checkpoint(start_from, place)
            self._net.load_state_dict(before["net"])
            self._log_scale.data.copy_(before["log_scale"])
        if resumes:
            self._restore()

    @property
    def _checkpoint(self) -> Path:
        return self._run / "checkpoint.pt"

    def _restore(self) -> None:
        kept = read_checkpoint(self._run, self._place)
        self._net.load_state_dict(kept["net"])
        self._optimiser.load_state_dict(kept["optimiser"])
        self._log_scale.data.copy_(kept["log_scale"])
        self._generator.set_state(kept["generator"].cpu())
        self._rng.bit_generator.state = json.loads(kept["rng"])
        self.first_step = int(kept["step"])
        for memory, descriptors in zip(self._memories, kept["memories"], strict=True):
            memory.restore(descriptors)

    def save(self, step: int) -> None:
        """Write the checkpoint, in the first process only.

        Args:
            step: number of finished steps.
        """
        if not self._together.is_first:
            return
        part = self._checkpoint.with_suffix(".part")
        torch.save(
            {
                "net": self._net.state_dict(),
                "optimiser": self._optimiser.state_dict(),
                "log_scale": self._log_scale.detach(),
                "step": step,
                "generator": self._generator.get_state(),
                "rng": json.dumps(self._rng.bit_generator.state),
                "memories": [memory.state() for memory in self._memories],
            },
            part,
        )
        part.rename(self._checkpoint)

    def share(self) -> None:
        """Let the gradients of all processes count, and switch the network to training."""
        self._encode = _shared(self._net, self._together, self._place)
        self._net.train()

    def step(self, step: int) -> _Step:
        """Draw a batch of one city, compute the loss, and change the weights.

        Args:
            step: number of the step, from 0.
        """
        config, together = self._config, self._together
        _set_rate(self._optimiser, config, step)
        number = int(self._rng.integers(len(self._cities)))
        memory = self._memories[number]
        known, wanted = self._remembered(memory, step)
        choice = self._cities[number].choose(config.pairs, self._rng, wanted)
        of_queries, of_surveys = self._descriptors(self._cities[number], choice, step)
        scale = self._log_scale.exp().clamp(max=config.largest_scale)
        q = Side(of_queries, choice.query_xy.to(self._place))
        m = Side(of_surveys, choice.survey_xy.to(self._place))
        earlier = torch.from_numpy(np.setdiff1d(known, choice.pairs) if config.stale_negatives else known[:0])
        earlier = earlier.to(self._place)
        losses, first_ones = _LOSSES[config.loss](
            q,
            m,
            scale=scale,
            more_queries=Side(memory.queries[earlier], memory.queries_xy[earlier]),
            more_surveys=Side(memory.surveys[earlier], memory.surveys_xy[earlier]),
        )
        memory.keep(choice.pairs, q.descriptors, m.descriptors, q.xy, m.xy, step)
        loss = losses.mean()
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]  # torch's own stub leaves it untyped
        together.average_gradient(self._log_scale)
        torch.nn.utils.clip_grad_norm_(self._net.parameters(), config.gradient_norm)
        self._optimiser.step()
        return _Step(float(loss.detach()), float(first_ones.float().mean()), float(scale.detach()), len(choice))

    def _remembered(self, memory: DescriptorMemory, step: int) -> tuple[NDArray[np.int64], NDArray[np.int64] | None]:
        """Return pairs with recent descriptors, and hard negatives to draw; None draws without them."""
        config = self._config
        remembers = config.memory_after is not None and step >= config.memory_after
        known = memory.recent(step, config.memory_steps) if remembers else np.zeros(0, np.int64)
        if len(known) <= config.pairs:
            return known, None
        seeds = self._rng.choice(known, min(config.alike_seeds, len(known)), replace=False)
        return known, self._together.of_first(memory.hard_negatives(seeds, known, config.alike_each))

    def _descriptors(self, city: City, choice: Choice, step: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the descriptors of the queries and of the survey views of the whole batch, of all processes."""
        config = self._config
        bounds = shard_bounds(len(choice), config.shards)
        planes = _own_views(city, choice, bounds, self._together, self._augment, config, step)
        count = len(planes) // 2
        with forward_in(config.precision, self._place.type):
            descriptors = self._encode(planes, queries_first(planes, count))
        descriptors = descriptors.float()
        return self._together.gather(descriptors[:count], descriptors[count:], sizes=_sizes(bounds, self._together))

    def trained(self) -> EncoderNet:
        """Return the network in evaluation mode, with layers that need no other process."""
        net = self._net
        if self._together.count > 1:
            net = EncoderNet(self._config.encoder).to(self._place)
            net.load_state_dict(self._net.state_dict())
        trained: EncoderNet = net.eval()
        return trained


def require_shards(config: TrainingConfig, processes: int) -> None:
    """Check that processes can share a batch.

    Args:
        config: pairs and shards of a batch.
        processes: number of processes.

    Raises:
        DatasetError: there are more processes than shards, or a shard could be empty.
    """
    if processes > config.shards:
        raise DatasetError(
            f"shards: {processes} processes share each batch, but the run has --shards {config.shards}; start no more "
            f"processes than shards, or train in another --run folder with --shards {processes}",
            field="shards",
        )
    if config.shards > config.pairs // 2:  # a batch without duplicates has at least half of its pairs
        raise DatasetError(
            f"shards: a batch of {config.pairs} pairs has at most {config.pairs // 2} shards, not {config.shards}; use more "
            "--pairs or fewer --shards",
            field="shards",
        )


def shard_bounds(pairs: int, shards: int) -> list[int]:
    """Return the first pair of every shard of a batch, and the number of pairs.

    Args:
        pairs: pairs of the batch.
        shards: number of shards; their sizes differ by at most 1.
    """
    return [k * pairs // shards for k in range(shards + 1)]


def _sizes(bounds: list[int], together: Processes) -> list[int]:
    """Pairs of each process."""
    return [bounds[shards.stop] - bounds[shards.start] for shards in together.shares(len(bounds) - 1)]


def _own_views(
    city: City,
    choice: Choice,
    bounds: list[int],
    together: Processes,
    augment: Augmenter,
    config: TrainingConfig,
    step: int,
) -> torch.Tensor:
    """Augmented planes of the pairs of this process, queries before survey views.

    A batch of one shard takes its random numbers from one sequence. Of several shards, each has a sequence of its own
    that depends on seed, step and shard. So a pair gets the same errors in any process.
    """
    if config.shards == 1:
        return views_of(city.read(choice), augment, augment.device, blind=config.blind)
    queries, surveys = [], []
    for shard in together.shares(config.shards)[together.rank]:
        augment.seed([config.seed, step, shard])
        batch = city.read(choice[bounds[shard] : bounds[shard + 1]])
        planes = views_of(batch, augment, augment.device, blind=config.blind)
        queries.append(planes[: len(planes) // 2])
        surveys.append(planes[len(planes) // 2 :])
    return torch.cat([*queries, *surveys])


def _shared(net: EncoderNet, together: Processes, place: torch.device) -> torch.nn.Module:
    """Return what a step calls for descriptors: the network, or the network with gradients of all processes."""
    if together.tensors is None:
        return net
    share_statistics(net, together.tensors)
    gpus = [place.index] if place.type == "cuda" else None
    # All processes have the same running statistics already, because these come from the batches of all processes.
    return DistributedDataParallel(net, device_ids=gpus, process_group=together.tensors, forward_sync_buffers=False)


def require_start(start_from: Path, shape: EncoderShape) -> None:
    """Check ``start_from`` before anything is simulated or written.

    Args:
        start_from: folder of a run, or an exported encoder.
        shape: shape that the encoder must have.

    Raises:
        DatasetError: it does not exist, or is a folder without a checkpoint or with an encoder of another shape.
        EncoderError: it is a file, but no encoder of this shape.
    """
    if not start_from.exists():
        raise DatasetError(
            f"start_from: {start_from}: file or folder not found; give the folder of a run, or an encoder (.onnx)",
            field="start_from",
        )
    if not start_from.is_dir():
        require_shape(start_from, shape)
        return
    if not (start_from / "checkpoint.pt").is_file():
        raise DatasetError(
            f"start_from: {start_from} has no checkpoint.pt; give the folder of a trained run, or an encoder (.onnx)",
            field="start_from",
        )
    found = read_config(start_from).encoder
    if found != shape:
        raise DatasetError(
            f"start_from: {start_from} has the shape {found}, but this training expects {shape}; start from a run of "
            "that shape",
            field="start_from",
        )


def _views_of_all(
    cities: list[City], config: TrainingConfig, augment: Augmenter, rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Augmented planes and sides of ``STATISTICS_BATCHES`` batches, spread over all cities."""
    planes, sides = [], []
    for k in range(STATISTICS_BATCHES):
        batch = cities[k * len(cities) // STATISTICS_BATCHES].draw(min(config.pairs, STATISTICS_PAIRS), rng)
        planes.append(views_of(batch, augment, augment.device, blind=config.blind).cpu())
        sides.append(torch.arange(len(planes[-1])) < len(batch.query_xy))
    return torch.cat(planes), torch.cat(sides).float()


def views_of(batch: Batch, augment: Augmenter, place: torch.device, *, blind: tuple[str, ...] = ()) -> torch.Tensor:
    """Return the augmented planes of a batch, queries before survey views.

    A CPU works on parts of ``PAIRS_AT_ONCE`` pairs: their planes stay in its cache. That takes little more than half the time.

    Args:
        batch: B pairs.
        augment: draws the errors.
        place: device of the result.
        blind: planes that are set to 0 in queries.

    Returns:
        Planes (2 B, 6, rows, columns).
    """
    count = len(batch.query_xy)
    size = PAIRS_AT_ONCE if place.type == "cpu" else count
    planes = torch.empty(2 * count, len(PLANES), *batch.query_ranges.shape[1:], device=place)
    for first in range(0, count, size):
        part = slice(first, min(first + size, count))
        rows_seen = augment.cut_rows(batch.rows_seen.to(place), part.stop - first)
        planes[count + first : count + part.stop] = augment.survey(
            batch.survey_ranges[part].to(place),
            batch.survey_intensity[part].to(place),
            batch.survey_height_m[part].to(place),
            rows_seen,
        )
        seen = None if batch.query_seen is None else batch.query_seen[part].to(place)
        planes[part] = augment.query(
            batch.query_ranges[part].to(place),
            batch.query_rgb[part].to(place),
            batch.query_height_m[part].to(place),
            rows_seen,
            seen=seen,
        )
    planes[:count, [PLANES.index(name) for name in blind]] = 0.0
    return planes


def load_run(run: Path, *, device: str = "cpu") -> EncoderNet:
    """Load the network of a run's last checkpoint, in evaluation mode.

    Args:
        run: folder of the run.
        device: torch device that the checkpoint is loaded on.

    Raises:
        DatasetError: the folder holds no run.
    """
    if not (run / "checkpoint.pt").exists():
        raise DatasetError(f"{run} has no checkpoint.pt; train first: streetfix train --run {run}", field="run")
    net = EncoderNet(read_config(run).encoder)
    net.load_state_dict(read_checkpoint(run, device)["net"])
    return net.eval()


def read_checkpoint(run: Path, device: str | torch.device) -> dict[str, Any]:
    """Read the last checkpoint of a run.

    Args:
        run: folder of the run.
        device: torch device of the tensors.

    Raises:
        DatasetError: it is missing or damaged.
    """
    path = run / "checkpoint.pt"
    with reading(path):
        try:
            loaded: dict[str, Any] = torch.load(path, map_location=device, weights_only=True)
        except (RuntimeError, EOFError, UnpicklingError) as error:
            raise DatasetError(
                f"{path}: the file is damaged ({type(error).__name__}); train again in another --run folder",
                field="run",
            ) from error
    return loaded


def read_config(run: Path) -> TrainingConfig:
    """Read the configuration of a run.

    Args:
        run: folder of the run.

    Raises:
        DatasetError: ``config.json`` is missing, or another release wrote it.
    """
    path = run / "config.json"
    try:
        return TrainingConfig.model_validate_json(read_bytes(path))
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise DatasetError(
            f"{path}: {where or 'the file'}: {first['msg']}; train again in another --run folder", field="run"
        ) from error


def read_packs(run: Path) -> list[str]:
    """Read the names of the packs that a run learnt from.

    Args:
        run: folder of the run.

    Raises:
        DatasetError: ``packs.json`` is missing or damaged.
    """
    path = run / "packs.json"
    try:
        names = json.loads(read_bytes(path))
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: not valid JSON; train again in another --run folder", field="run") from error
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise DatasetError(f"{path}: not a list of names; train again in another --run folder", field="run")
    return names


def trained_on(run: Path) -> tuple[str, ...]:
    """Return the cities that a run was trained on, as ``KIND-SEED``.

    Cities of the run that it started from are included.

    Args:
        run: folder of the run.
    """
    return tuple("-".join(name.split("-")[1:3]) for name in read_packs(run))


def _keep_packs(run: Path, packs: list[Path], start_from: Path | None) -> None:
    """Write the names of the packs of this run and of the run before it. Refuse to continue with other cities."""
    path = run / "packs.json"
    if start_from is None:
        earlier = []
    elif start_from.is_dir():
        earlier = read_packs(start_from)
    else:
        earlier = [f"encoder-{name}" for name in Encoder.open(start_from).trained_on]
    names = earlier + [folder.name for folder in packs]
    if not path.exists():
        path.write_text(json.dumps(names, indent=1) + "\n")
    elif read_packs(run) != names:
        raise DatasetError(f"{path} names other cities; choose another --run folder, or remove this one", field="run")


def _keep_config(run: Path, config: TrainingConfig) -> None:
    path = run / "config.json"
    if path.exists():
        if read_config(run) != config:
            raise DatasetError(
                f"{path} has another configuration; choose another --run folder, or remove this one", field="run"
            )
        return
    path.write_text(config.model_dump_json(indent=2) + "\n")


def _optimiser(parameters: list[torch.nn.Parameter], config: TrainingConfig) -> torch.optim.Optimizer:
    if config.optimiser == "sgdm":
        return torch.optim.SGD(
            parameters,
            lr=config.learning_rate,
            momentum=config.momentum,
            weight_decay=config.weight_decay,
            nesterov=True,
        )
    return torch.optim.AdamW(parameters, lr=config.learning_rate, weight_decay=config.weight_decay)


def _set_rate(optimiser: torch.optim.Optimizer, config: TrainingConfig, step: int) -> None:
    """Set the learning rate: linear warm-up, then half a cosine down to a hundredth."""
    warm = min(1.0, (step + 1) / max(1, config.warm_up_steps))
    rate = float(config.learning_rate * warm * (0.5 * (1 + np.cos(np.pi * step / config.steps)) + 0.01))
    for group in optimiser.param_groups:
        group["lr"] = rate


class _Interrupt:
    """Handle Ctrl-C and SIGTERM: the first ends the run after the step. A Ctrl-C after that ends it at once.

    torchrun sends SIGTERM before it starts the processes again, and a cluster before it takes a machine away. A second SIGTERM changes
    nothing: systemd and Slurm send one to all processes, and torchrun then sends its own one.
    """

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> "_Interrupt":
        self._before: dict[signal.Signals, Any] = {}
        for number in (signal.SIGINT, signal.SIGTERM):
            try:
                self._before[number] = signal.signal(number, self._note)
            except ValueError:  # only the main thread may set a signal handler
                break
        return self

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.asked = True

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
