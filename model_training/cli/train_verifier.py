"""``streetfix train-verifier``."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from model_training.cli.progress import bars
from model_training.stock import ENCODER
from model_training.verification.examples import Examples, make_examples
from model_training.verification.plans import MOST_CITIES
from model_training.verification.train import VerifierTraining, export_verifier, train_verifier
from service.errors import DatasetError


def command(
    out: Annotated[Path, typer.Option(help="ONNX file to write.")],
    work: Annotated[Path, typer.Option(help="Folder that keeps the examples of each city.")] = Path("data/verifier"),
    encoder: Annotated[
        Path | None, typer.Option(help="ONNX file of `streetfix export`.  [default: the stock encoder]")
    ] = None,
    cities: Annotated[int, typer.Option(help="Number of training cities.", min=1, max=MOST_CITIES)] = 60,
    epochs: Annotated[int, typer.Option(help="Passes over all examples.", min=1, max=1000)] = 10,
    rate: Annotated[float, typer.Option(help="Highest learning rate.", min=1e-8, max=1)] = 2e-3,
    seed: Annotated[int, typer.Option(help="Seed of all random draws of the training.", min=0)] = 0,
) -> None:
    """Train the verifier: the network that says from a comparison of image and map whether a pose is right.

    A city takes about four minutes on one core. After Ctrl-C the same command goes on with the next city. The training
    itself starts again. It holds all examples in memory, up to 0.1 GB for each city. The service uses the file
    `service/scoring/verifier.onnx`. After a change of this file, fit the calibration again (`streetfix calibrate`).

    \b
    Example:
      streetfix train-verifier --out service/scoring/verifier.onnx
    """
    if not out.parent.is_dir():  # said before the work, not after it
        raise DatasetError(f"--out: folder {out.parent} not found; create it first", field="out")
    with bars() as report:
        files = list(make_examples(work, encoder or ENCODER, cities, report=report))
        net, loss = train_verifier(
            [Examples.read(file) for file in files],
            VerifierTraining(epochs=epochs, rate=rate, seed=seed),
            report=report,
        )
    difference = export_verifier(net, out)
    Console().print(
        f"{out}: {out.stat().st_size / 1e6:.1f} MB, loss of the last epoch {loss:.4f}, at most {difference:.1e} from torch"
    )
