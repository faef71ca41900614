"""``streetfix calibrate``."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from model_training.calibration.make import calibrate
from model_training.cli.progress import bars
from model_training.stock import CALIBRATION, ENCODER
from service.errors import DatasetError


def command(
    encoder: Annotated[
        Path, typer.Option(help="ONNX file of `streetfix export`.  [default: the stock encoder]", show_default=False)
    ] = ENCODER,
    out: Annotated[
        Path,
        typer.Option(help="Calibration file to write, JSON.  [default: beside the stock encoder]", show_default=False),
    ] = CALIBRATION,
    work: Annotated[Path, typer.Option(help="Folder that keeps cities, maps and answers.")] = Path("data/calibration"),
    anew: Annotated[bool, typer.Option(help="Send all queries again, even if their answers are stored.")] = False,
) -> None:
    """Fit the confidence of an encoder on calibration cities.

    The command simulates these cities. It takes about half an hour.

    \b
    Example:
      streetfix calibrate --encoder runs/mine/encoder.onnx --out runs/mine/calibration.json
      streetfix build-map data/site --encoder runs/mine/encoder.onnx --calibration runs/mine/calibration.json --out maps/site
    """
    if not out.parent.is_dir():  # said before the work, not after it
        raise DatasetError(f"--out: folder {out.parent} not found; create it first", field="out")
    console = Console(highlight=False)
    with bars() as report:
        calibration, checks = calibrate(work, encoder, anew=anew, report=report)
    for line in checks:
        console.print(line, soft_wrap=True)
    part = out.with_name(out.name + ".part")
    part.write_text(calibration.model_dump_json(indent=1) + "\n")
    part.rename(out)
    console.print(f"written: {out}")
