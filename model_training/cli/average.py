"""``streetfix average``."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from model_training.cli.progress import bars
from model_training.training.average import BATCHES, average
from service.errors import DatasetError


def command(
    first: Annotated[Path, typer.Argument(help="Folder of a training run.")],
    second: Annotated[Path, typer.Argument(help="Folder of the run that started from the first run.")],
    run: Annotated[Path, typer.Option(help="Folder of the run to write.")],
    share: Annotated[float, typer.Option(help="Weight of the second run in the mean.", min=0, max=1)] = 0.5,
    packs: Annotated[Path, typer.Option(help="Folder of the simulated training cities.")] = Path("runs/packs"),
) -> None:
    """Average the weights of two training runs.

    The mean keeps the gain of the second run. It loses less of what only the first run learnt.

    \b
    Example:
      streetfix average runs/stock runs/second --run runs/mean && streetfix export runs/mean --out encoder.onnx
    """
    folders = sorted(folder for folder in packs.glob("*-city-1*") if folder.is_dir())
    if not folders:
        raise DatasetError(f"--packs: {packs} has no training cities; streetfix train creates them", field="packs")
    with bars() as report:
        average(first, second, folders, run, share=share, report=lambda done: report("statistics", done, BATCHES))
    Console().print(f"averaged: {run}; next: streetfix export {run} --out encoder.onnx")
