"""The mean of two runs' weights: keeps what the first knew beyond the second's data (Wortsman et al., CVPR 2022).

Both must lie in one basin, as a run and the one that started from it do. Batch normalisation's statistics belong to
neither mean, so they are taken anew over augmented training batches (Izmailov et al., UAI 2018).
"""

import json
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import torch

from model_training.training.draws import augmented_batches
from model_training.training.encoder_net import EncoderNet
from model_training.training.loop import TrainingConfig, load_run, read_checkpoint, read_config, read_packs
from service.errors import DatasetError

BATCHES = 150


def average(
    first: Path, second: Path, packs: list[Path], run: Path, *, share: float = 0.5, seed: int = 0, batches: int = BATCHES,
    report: Callable[[int], None] = lambda _: None,
) -> EncoderNet:  # fmt: skip
    """Write a run whose weights are ``(1 - share) * first + share * second``.

    Args:
        first: folder of the run that the second one started from.
        second: folder of the later run.
        packs: training cities for the statistics of batch normalisation.
        run: folder to write; holds ``config.json`` (the second run's), ``checkpoint.pt`` and ``packs.json``.
        share: of the second run, 0..1.
        seed: of the batches.
        batches: how many.
        report: called with the number of batches seen.

    Raises:
        DatasetError: a folder holds no run, the encoders' shapes differ, or ``run`` is there already.
    """
    if (run / "checkpoint.pt").exists():
        raise DatasetError(f"{run} holds a run already; take another --run folder, or remove it", field="run")
    net, other = load_run(first), load_run(second)
    config = read_config(second)
    if net.shape != other.shape:
        raise DatasetError(
            f"{first} and {second} are encoders of different shapes; only like ones have a mean", field="run"
        )
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
    """Means and variances of batch normalisation as plain averages over ``batches`` augmented batches."""
    norms = [module for module in net.modules() if isinstance(module, torch.nn.BatchNorm2d)]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # a plain average
    net.train()
    with torch.no_grad():
        for step, (planes, queries) in enumerate(islice(augmented_batches(packs, config, seed=seed), batches), 1):
            net.of_both(planes, queries)
            report(step)
    for norm in norms:
        norm.momentum = 0.1
    net.eval()


def _log_scale(run: Path) -> torch.Tensor:
    scale: torch.Tensor = read_checkpoint(run, "cpu")["log_scale"]
    return scale
