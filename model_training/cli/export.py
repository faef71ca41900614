"""``streetfix export``."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from model_training.training.export import export
from model_training.training.loop import load_run, trained_on


def command(
    run: Annotated[Path, typer.Argument(help="Folder of a training run.")],
    out: Annotated[Path, typer.Option(help="ONNX file to write.")],
) -> None:
    """Export a trained encoder to ONNX.

    The command checks the ONNX file against torch.

    \b
    Example:
      streetfix export runs/stock --out encoder.onnx
    """
    difference = export(load_run(run), out, trained_on=trained_on(run))
    Console().print(f"{out}: {out.stat().st_size / 1e6:.1f} MB; differs from torch by at most {difference:.1e}")
