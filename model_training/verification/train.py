"""Train the verifier on examples of many cities, and export it."""

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import binary_cross_entropy_with_logits

from model_training.verification.augment import augmented
from model_training.verification.examples import ANSWER, STEPS, Examples
from model_training.verification.net import VerifierNet
from service.errors import DatasetError, EncoderError
from service.maps.calibration import RIGHT_M
from service.scoring.comparison import COLUMNS, PLANES, ROWS
from service.scoring.verifier import Verifier

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]
#: Greatest difference of the log odds between torch and ONNX Runtime.
TOLERANCE = 1e-3
#: Weight of examples that are no answers. The verifier is asked about answers first.
_OTHERS = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class VerifierTraining:
    """Settings of a training.

    Attributes:
        epochs: passes over all examples.
        batch: examples of a step.
        rate: highest learning rate (AdamW, one cycle).
        weight_decay: of AdamW.
        seed: seed of all random draws.
    """

    epochs: int = 10
    batch: int = 64
    rate: float = 2e-3
    weight_decay: float = 1e-2
    seed: int = 0


def train_verifier(
    cities: Sequence[Examples], settings: VerifierTraining, *, report: Report = lambda *_: None
) -> tuple[VerifierNet, float]:
    """Train on the examples of cities.

    Args:
        cities: examples of each city.
        settings: of the training.
        report: called after every step.

    Raises:
        DatasetError: the examples lack right or wrong poses, or are fewer than a batch.

    Returns:
        The network in evaluation mode, and the mean loss of the last epoch.
    """
    city, row = (np.concatenate(each) for each in zip(*_places_of(cities), strict=True))
    right = np.concatenate([each.error_m <= RIGHT_M for each in cities])
    weight = np.concatenate([np.where(each.origin == ANSWER, 1.0, _OTHERS) for each in cities]).astype(np.float32)
    if right.all() or not right.any() or len(right) < settings.batch:
        raise DatasetError("the verifier needs right and wrong poses; use more cities", field="cities")
    torch.manual_seed(settings.seed)
    random, order = torch.Generator().manual_seed(settings.seed), np.random.default_rng(settings.seed)
    net = VerifierNet().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    steps = len(right) // settings.batch
    optimiser = torch.optim.AdamW(net.parameters(), lr=settings.rate, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, settings.rate, total_steps=settings.epochs * steps)
    loss = 0.0
    for epoch in range(settings.epochs):
        chosen, losses = order.permutation(len(right))[: steps * settings.batch].reshape(steps, -1), []
        for step, batch in enumerate(chosen, 1):
            planes = np.stack([cities[c].planes[r] for c, r in zip(city[batch], row[batch], strict=True)])
            inputs = augmented(torch.from_numpy(planes.astype(np.float32) / STEPS), random)
            odds = net(inputs.contiguous(memory_format=torch.channels_last))
            found = binary_cross_entropy_with_logits(
                odds, torch.from_numpy(right[batch].astype(np.float32)), torch.from_numpy(weight[batch])
            )
            optimiser.zero_grad()
            found.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            schedule.step()
            losses.append(float(found.detach()))
            report(f"epoch {epoch + 1} of {settings.epochs}", step, steps)
        loss = float(np.mean(losses))
    return net.eval(), loss


def _places_of(cities: Sequence[Examples]) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Return for each city the indices of the city and of the rows of its examples."""
    return [(np.full(len(each.error_m), k), np.arange(len(each.error_m))) for k, each in enumerate(cities)]


def export_verifier(net: VerifierNet, out: Path) -> float:
    """Write a verifier as ONNX, and check that it gives the same log odds.

    Args:
        net: the network; left in evaluation mode.
        out: file to write; renamed when it is complete.

    Returns:
        The greatest difference between torch and ONNX Runtime.

    Raises:
        EncoderError: that difference exceeds ``TOLERANCE`` or is no number; nothing is written.
    """
    net.eval()
    example, buffer = torch.rand(2, len(PLANES), ROWS, COLUMNS) * 2 - 1, io.BytesIO()
    with torch.no_grad():
        torch.onnx.export(
            net,
            (example,),
            buffer,  # type: ignore[arg-type]  # the tracing exporter writes to buffers too
            input_names=["comparison"],
            output_names=["log_odds"],
            opset_version=17,
            dynamo=False,
            dynamic_axes={"comparison": {0: "batch"}, "log_odds": {0: "batch"}},
        )
        net.eval()  # the tracing exporter leaves the module in training mode
        expected = net(example).numpy()
    data = buffer.getvalue()
    difference = float(np.abs(Verifier.open(data).log_odds(list(example.numpy())) - expected).max())
    if not difference <= TOLERANCE:  # also refuses NaN
        raise EncoderError(
            f"ONNX and torch differ by {difference:.2e}, more than {TOLERANCE:.0e}; nothing was written; train again with another --rate",
            field="verifier",
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    part = out.with_name(out.name + ".part")
    part.write_bytes(data)
    part.rename(out)
    return difference
