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
        Path, typer.Option(help="ONNX file of `streetfix export` [default: the stock encoder]")
    ] = ENCODER,
    out: Annotated[Path, typer.Option(help="the calibration, JSON [default: beside the stock encoder]")] = CALIBRATION,
    work: Annotated[Path, typer.Option(help="where cities, maps and answers are kept")] = Path("data/calibration"),
    anew: Annotated[bool, typer.Option(help="ask all queries again, though their answers are kept")] = False,
) -> None:
    """Fit confidence for an encoder on simulated cities of their own; some half an hour.

    \b
    Example:
      streetfix calibrate --encoder runs/mine/encoder.onnx --out runs/mine/calibration.json
      streetfix build-map data/site --encoder runs/mine/encoder.onnx --calibration runs/mine/calibration.json --out maps/site
    """
    if not out.parent.is_dir():  # said before the work, not after it
        raise DatasetError(f"--out: there is no folder {out.parent}; make it first", field="out")
    console = Console(highlight=False)
    with bars() as report:
        calibration, checks = calibrate(work, encoder, anew=anew, report=report)
    for line in checks:
        console.print(line, soft_wrap=True)
    part = out.with_name(out.name + ".part")
    part.write_text(calibration.model_dump_json(indent=1) + "\n")
    part.rename(out)
    console.print(f"written: {out}")
