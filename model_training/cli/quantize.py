"""``streetfix quantize``."""

from itertools import islice
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from model_training.cli.progress import bars
from model_training.training.encoder_net import EncoderShape
from model_training.training.loop import TrainingConfig
from model_training.training.packs import make_packs
from model_training.training.quantise import Views, quantise
from model_training.training.recipe import stock_plans
from model_training.training.sampling import augmented_batches
from service.imaging.view_grid import ViewGrid
from service.retrieval.encoder import Encoder

RANGES, CHECKS = 8, 4  # batches


def command(
    encoder: Annotated[Path, typer.Argument(help="ONNX file of `streetfix export`.")],
    out: Annotated[Path, typer.Option(help="ONNX file to write.")],
    packs: Annotated[Path, typer.Option(help="Folder of the simulated training cities.")] = Path("runs/packs"),
    cities: Annotated[
        int,
        typer.Option(
            help="Training cities that the views come from. The command creates missing ones.", min=1, max=1000
        ),
    ] = 2,
    pairs: Annotated[int, typer.Option(help="Pairs of views per batch.", min=2, max=2048)] = 128,
    seed: Annotated[int, typer.Option(help="Seed of the views.", min=0)] = 0,
) -> None:
    """Quantise an encoder to eight bits.

    The result has a quarter of the size. It needs less than half of the time.
    The command checks it against the original.

    \b
    Example:
      streetfix quantize runs/stock/encoder.onnx --out encoder.onnx
    """
    read = Encoder.open(encoder)  # said before cities are simulated, not after it
    config = TrainingConfig(pairs=pairs, encoder=EncoderShape(rows=read.rows, columns=read.columns))
    with bars() as report:
        grid = ViewGrid(rows=read.rows, columns=read.columns)
        folders = make_packs(stock_plans(cities), packs, grid, report=report)
        drawn = (
            Views(np.ascontiguousarray(planes.numpy()), queries)
            for planes, queries in augmented_batches(folders, config, seed=seed)
        )
        # Views of the checks come after those of the ranges, of the same cities.
        agreement = quantise(encoder, out, islice(drawn, RANGES), islice(drawn, CHECKS))
    Console().print(
        f"{out}: {out.stat().st_size / 1e6:.1f} MB; cosine to the float32 descriptors: mean {agreement.mean:.4f}, 1st "
        f"percentile {agreement.of_hundred:.4f} ({agreement.views} views)"
    )
