"""Average the weights of two training runs (Wortsman et al., CVPR 2022).

The mean keeps what the first run learnt beyond the data of the second run.
Both runs must lie in one basin of the loss. That holds for a run and a run that started from it.
The statistics of batch normalisation fit neither run after averaging.
They are computed again over augmented training batches (Izmailov et al., UAI 2018).
"""

import json
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import torch

from model_training.training.encoder_net import EncoderNet, queries_first
from model_training.training.loop import TrainingConfig, load_run, read_checkpoint, read_config, read_packs
from model_training.training.sampling import augmented_batches
from service.errors import DatasetError

#: Batches that set the statistics of batch normalisation.
BATCHES = 150


def average(
    first: Path,
    second: Path,
    packs: list[Path],
    run: Path,
    *,
    share: float = 0.5,
    seed: int = 0,
    batches: int = BATCHES,
    report: Callable[[int], None] = lambda _: None,
) -> EncoderNet:
    """Write a run whose weights are ``(1 - share) * first + share * second``.

    Args:
        first: folder of the run that the second run started from.
        second: folder of the later run.
        packs: folders of the training cities that set the statistics of batch normalisation.
        run: folder to write. It holds ``config.json`` (of the second run), ``checkpoint.pt`` and ``packs.json``.
        share: weight of the second run, 0..1.
        seed: seed of the batches.
        batches: number of batches.
        report: called with the number of batches done.

    Raises:
        DatasetError: a folder holds no run, the shapes of the encoders differ, or ``run`` already exists.
    """
    if (run / "checkpoint.pt").exists():
        raise DatasetError(f"{run} already contains a run; choose another --run folder, or remove it", field="run")
    net, other = load_run(first), load_run(second)
    config = read_config(second)
    if net.shape != other.shape:
        raise DatasetError(f"{first} and {second}: the encoders must have the same shape", field="run")
    mean = {
        name: torch.lerp(value, other.state_dict()[name], share) if value.is_floating_point() else value
        for name, value in net.state_dict().items()
    }
    net.load_state_dict(mean)
    _renew_statistics(net, packs, config, seed, batches, report)
    run.mkdir(parents=True, exist_ok=True)
    (run / "config.json").write_text(config.model_dump_json(indent=2) + "\n")
    names = {name: None for each in (first, second) for name in read_packs(each)}
    (run / "packs.json").write_text(json.dumps(list(names), indent=1) + "\n")
    part = run / "checkpoint.part"
    torch.save({"net": net.state_dict(), "log_scale": _log_scale(second)}, part)
    part.rename(run / "checkpoint.pt")
    return net


def _renew_statistics(
    net: EncoderNet, packs: list[Path], config: TrainingConfig, seed: int, batches: int, report: Callable[[int], None]
) -> None:
    """Set mean and variance of batch normalisation to plain averages over ``batches`` augmented batches."""
    norms = [module for module in net.modules() if isinstance(module, torch.nn.BatchNorm2d)]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # torch then computes a plain average
    net.train()
    with torch.no_grad():
        for step, (planes, queries) in enumerate(islice(augmented_batches(packs, config, seed=seed), batches), 1):
            net(planes, queries_first(planes, queries))
            report(step)
    for norm in norms:
        norm.momentum = 0.1
    net.eval()


def _log_scale(run: Path) -> torch.Tensor:
    scale: torch.Tensor = read_checkpoint(run, "cpu")["log_scale"]
    return scale
